"""Bodies before the graph."""

import dataclasses

from bodyslam_jax.config.check import NOT_NEGATIVE, SHARE, check


@dataclasses.dataclass(frozen=True)
class PeopleFit:
    """Bodies from keypoints, and the cleaning of bodies that a regressor gave."""

    min_keypoints: int = 6
    """Keypoints that a frame must have for its body to be fitted."""
    max_gap: float = 0.3
    """Gaps up to this long are filled from the frames around them, s."""
    start_interval: float = 0.1
    """Distance of the frames that are fitted from many starts, s."""
    max_steps: int = 30
    """Gauss-Newton steps over all frames at most."""
    robust_scale: float = 4.0
    """Scale of the robust loss on keypoints, in their standard deviations."""
    correlation_time: float = 0.15
    """Keypoint errors stay the same for about this long, s."""
    detector_bias: float = 0.0
    """0: keypoints are SMPL's joints; 1: hips, neck and shoulders as COCO has them."""
    lift_scale: float = 1.0
    """Scale of the robust loss on guessed postures, in standard deviations of each
    component; 0: they are places to start from, and say nothing else."""
    lift_correlation: float = 0.2
    """Errors of guessed postures stay the same for about this long, s."""
    limit_sigma: float = 0.05
    """Softness of the joints' limits, rad."""
    upright_sigma: float = 0.4
    """How far bodies lean towards or from the camera, sine of the angle."""
    shape_frames: float = 1.0
    """Frames' worth of evidence on shape in a whole clip: keypoint bias is the same in
    all frames, so they do not add up."""
    motion_scale: float = 2.0
    """How much less predictable than in the motion data people move."""
    depth_jitter: float = 0.005
    """Change of the depth's change from frame to frame at 30 fps, m."""
    position_jitter: float = 0.015
    """The same across the line of sight, m; a shaking camera is in it."""
    turn_jitter: float = 0.03
    """The same for the orientation, rad."""
    depth_error: float = 0.05
    """Error of a regressor's depth, as a share of it."""
    regressor_shape_gain: float | None = None
    """Factor on the β of given bodies, whatever their source. Without it 1.2 for a
    regressor's, which are drawn to the mean, and 1 where β was measured or optimised
    (AMASS, SLAHMR, or `bodies.npz` that says so by `shapes_regressed`)."""

    def __post_init__(self):
        free = dict.fromkeys(
            ("max_gap", "correlation_time", "lift_scale", "lift_correlation"),
            NOT_NEGATIVE,
        )
        silent = ("limit_sigma", "upright_sigma", "depth_error", "lift_scale")
        check(self, free | {"detector_bias": SHARE}, infinite=silent)
