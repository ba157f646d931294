"""Settings of the stages before the joint estimate.

They are detection and association of people, their bodies, tracking of points, and
structure from motion.
"""

import dataclasses
import math
from typing import Literal

from bodyslam_jax.config.errors import NOT_NEGATIVE, Range, check


@dataclasses.dataclass(frozen=True)
class Detect:
    """Detection of people in the images, where no keypoints are given."""

    networks: Literal["fast", "best"] = "fast"
    """`best`: where a wrist is hidden, blurred or guessed, the larger BlazePose looks
    for it, too. Takes 55 ms more for each such person and image. Ignored by `live`."""
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
    """Largest number of people that are kept; those that fill most of the video come
    first."""
    min_duration: float = 0.4
    """Shortest time for which a person must be visible, s; at most the whole video.
    Ignored if nobody would be left."""
    max_gap: float = 0.7
    """Longest time after which a person who was not visible is recognised, s."""

    def __post_init__(self):
        check(self, {"min_duration": NOT_NEGATIVE, "max_gap": NOT_NEGATIVE})


@dataclasses.dataclass(frozen=True)
class PeopleFit:
    """Fitting of bodies to keypoints, and smoothing of regressed bodies over time."""

    max_gap: float = 0.3
    """Longest gap that is filled from the surrounding frames, s."""
    lifter: Literal["everybody", "held-out"] = "everybody"
    """Network that predicts postures: trained on everybody of the motion data, or
    without the people whose motion simulated people have, so that errors on simulated
    people are those on people who were not learnt from."""
    lift_scale: float = 1.0
    """Scale of the robust loss on postures that the lifting network predicts, in
    standard deviations of each component. 0: predictions are initial values only."""
    lift_correlation: float = 0.2
    """Correlation time of the errors of predicted postures, s."""
    limit_sigma: float = 0.05
    """Standard deviation beyond a joint's limits, rad."""
    shape_frames: float = 1.0
    """Number of frames whose keypoints count as evidence on shape in a whole clip:
    keypoint bias is the same in all frames, so that evidence does not accumulate."""
    regressor_shape_gain: float | None = None
    """Factor on the β of given bodies. Without it, 1.2 for regressed β, which shrink to
    the mean, and 1 for β that were measured or optimised (AMASS, SLAHMR, or a
    `bodies.npz` whose `shapes_regressed` is false)."""

    def __post_init__(self):
        free: dict[str, Range] = dict.fromkeys(
            ("max_gap", "lift_scale", "lift_correlation"), NOT_NEGATIVE
        )
        check(self, free, infinite=("limit_sigma", "lift_scale"))


@dataclasses.dataclass(frozen=True)
class Tracking:
    """Tracking of static points through the video (BRISK, Lucas-Kanade, RANSAC)."""

    num_points: int = 200
    """Number of points tracked at any time."""

    def __post_init__(self):
        check(self)


@dataclasses.dataclass(frozen=True)
class Structure:
    """Structure from motion: cameras and a map up to scale, from tracks."""

    join_tracks: bool = True
    """Whether tracks of one point become one landmark, which closes loops."""
    landmark_span: int = 90
    """Largest number of frames that a landmark of the graph spans; a longer track
    becomes several landmarks. The cost of a solver step grows with its square."""
    focal_sigma: float = 0.2
    """Standard deviation of a guessed focal length, relative."""
    focal_accuracy: float = 0.08
    """Largest relative standard deviation of an estimated focal length that replaces
    the guess."""
    focal_runs: float = 30.0
    """Number of observations of a track that count as one for the focal length's
    standard deviation, because errors within a track are correlated."""

    def __post_init__(self):
        ranges = {"focal_accuracy": NOT_NEGATIVE, "landmark_span": (2, math.inf)}
        check(self, ranges, infinite=("focal_accuracy",))
