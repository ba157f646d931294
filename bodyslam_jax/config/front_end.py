"""From images to cameras up to scale: people found, points followed, structure."""

import dataclasses
import math

from bodyslam_jax.config.check import NOT_NEGATIVE, SHARE, check


@dataclasses.dataclass(frozen=True)
class Detect:
    """Finding people and keypoints in the images, for who has no keypoints."""

    search_interval: float = 0.33
    """Time between two searches of the whole image by the networks that ship, s; in
    between they look where people are expected."""
    min_height: float = 50.0
    """Height of people in the image below which they are masked, not estimated, px."""
    detector: str | None = None
    """For `yolox`: an own YOLOX, an ONNX file; by default YOLOX-S, fetched once."""
    pose: str | None = None
    """For `yolox`: an own RTMPose; by default DWPose-L 384x288, fetched once."""
    min_score: float = 0.5
    """For `yolox`: score of people that are looked at."""
    max_overlap: float = 0.45
    """For `yolox`: overlap of two boxes above which they are the same person."""
    max_people: int = 8
    """The largest ones in an image that are looked at."""

    def __post_init__(self):
        check(
            self,
            {"min_score": SHARE, "max_overlap": SHARE, "min_height": NOT_NEGATIVE},
        )


@dataclasses.dataclass(frozen=True)
class Association:
    """Which detections in successive frames are the same person."""

    max_people: int = 8
    """People kept, those that fill most of the video first."""
    min_duration: float = 0.4
    """Time that a person must be seen for, s; at most all of the video, and unless
    nobody would be left."""
    max_gap: float = 0.7
    """Time that a person may be unseen and still be recognised, s."""

    def __post_init__(self):
        check(self, {"min_duration": NOT_NEGATIVE, "max_gap": NOT_NEGATIVE})


@dataclasses.dataclass(frozen=True)
class Tracking:
    """Points followed through the video (BRISK, KLT, RANSAC)."""

    num_points: int = 200
    """Points followed at any time."""
    threshold: int = 20
    """BRISK's smallest contrast of a corner, grey levels."""
    octaves: int = 3
    """BRISK's pyramid, octaves."""
    cells: int = 8
    """Cells along the longer side of the image, over which points are spread."""
    window: int = 21
    """Side of the window that is followed, px."""
    max_epipolar: float = 1.5
    """Distance from the epipolar line beyond which a point is dropped, px."""
    keyframe_gap: int = 10
    """Frames over which a point must fit one rigid motion."""
    person_margin: float = 0.06
    """Width added around people's keypoints, of the person's height."""

    def __post_init__(self):
        least = {"octaves": 0, "person_margin": 0, "threshold": 0, "window": 3}
        check(self, {name: (value, math.inf) for name, value in least.items()})


@dataclasses.dataclass(frozen=True)
class Structure:
    """Cameras and map up to scale, from tracks (structure from motion)."""

    max_error: float = 2.0
    """Reprojection error beyond which an observation is an outlier, px."""
    min_angle: float = 0.5
    """Smallest angle between the rays of a point, degrees; less is tried where cameras
    cannot be located with it."""
    max_first_pairs: int = 4
    """Pairs of frames that are tried for the start."""
    keyframe_motion: float = 0.03
    """Motion of points between keyframes, of the image's longer side."""
    static_motion: float = 0.6
    """Motion of points below which the camera stands still, px."""
    rotation_error: float = 1.0
    """Error of a pure rotation below which there is no parallax to use, px."""
    min_baseline: float = 0.08
    """Extent of the path below which a camera only turns, of the distance of points."""
    join_tracks: bool = True
    """Whether tracks that turn out to be of one point become one landmark."""
    landmark_span: int = 90
    """Frames that a landmark of the graph may span: longer tracks are several. A step
    of the solver costs as much as the square of that."""
    min_shared: int = 12
    """Points that two successive frames must share, or there is a cut."""
    focal_sigma: float = 0.2
    """How wrong a guessed focal length may be: standard deviation, of the guess."""
    focal_accuracy: float = 0.08
    """Standard deviation, of the focal length, above which the guess is kept."""
    focal_runs: float = 30.0
    """Observations of a track that count for one, as its errors last."""

    def __post_init__(self):
        free = (
            "keyframe_motion static_motion rotation_error min_baseline focal_accuracy"
        )
        ranges = dict.fromkeys(free.split(), NOT_NEGATIVE)
        ranges |= {"landmark_span": (2, math.inf)}
        check(self, ranges, infinite=("focal_accuracy",))
