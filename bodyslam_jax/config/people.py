"""Settings of the bodies before the joint estimate."""

import dataclasses

from bodyslam_jax.config.check import NOT_NEGATIVE, Range, check


@dataclasses.dataclass(frozen=True)
class PeopleFit:
    """Bodies fitted to keypoints, and regressed bodies made consistent over time."""

    max_gap: float = 0.3
    """Longest gap that is filled from the frames around it, s."""
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
