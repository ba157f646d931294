"""Settings of detection, tracking and structure from motion."""

import dataclasses
import math

from bodyslam_jax.config.check import NOT_NEGATIVE, check


@dataclasses.dataclass(frozen=True)
class Detect:
    """Detection of people in the images, where no keypoints are given."""

    min_height: float = 50.0
    """Height of people in the image below which they are masked but not estimated,
    px."""
    detector: str | None = None
    """For `--detect yolox`: a YOLOX detector (ONNX file). Without it YOLOX-S is
    downloaded once."""
    pose: str | None = None
    """For `--detect yolox`: an RTMPose network (ONNX file). Without it DWPose-L 384x288
    is downloaded once."""

    def __post_init__(self):
        check(self, {"min_height": NOT_NEGATIVE})


@dataclasses.dataclass(frozen=True)
class Association:
    """Association of the detections in successive frames to people."""

    max_people: int = 8
    """Most people that are kept; those that fill most of the video come first."""
    min_duration: float = 0.4
    """Shortest time for which a person must be visible, s; at most the whole video.
    Ignored if nobody would be left."""
    max_gap: float = 0.7
    """Longest time after which a person who was not visible is recognised, s."""

    def __post_init__(self):
        check(self, {"min_duration": NOT_NEGATIVE, "max_gap": NOT_NEGATIVE})


@dataclasses.dataclass(frozen=True)
class Tracking:
    """Tracking of static points through the video (BRISK, Lucas-Kanade, RANSAC)."""

    num_points: int = 200
    """Points that are tracked at any time."""

    def __post_init__(self):
        check(self)


@dataclasses.dataclass(frozen=True)
class Structure:
    """Structure from motion: cameras and a map up to scale, from tracks."""

    join_tracks: bool = True
    """Whether tracks of one point become one landmark, which closes loops."""
    landmark_span: int = 90
    """Most frames that a landmark of the graph spans; a longer track becomes several
    landmarks. The cost of a solver step grows with the square of it."""
    focal_sigma: float = 0.2
    """Standard deviation of a guessed focal length, relative."""
    focal_accuracy: float = 0.08
    """Largest relative standard deviation of an estimated focal length that replaces
    the guess."""
    focal_runs: float = 30.0
    """Observations of a track that count as one for the focal length's standard
    deviation, because errors within a track are correlated."""

    def __post_init__(self):
        ranges = {"focal_accuracy": NOT_NEGATIVE, "landmark_span": (2, math.inf)}
        check(self, ranges, infinite=("focal_accuracy",))
