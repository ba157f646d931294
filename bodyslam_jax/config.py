"""Every setting, one frozen class per stage; no JAX here, so that `--help` is quick.

The command line and `config.yaml` are generated from these classes.
"""

import dataclasses


@dataclasses.dataclass(frozen=True)
class GraphWeights:
    """What each measurement is trusted to: standard deviations, and losses in them.

    The defaults are inverse covariances of what is measured, with errors that last
    taken for what they are. `GraphWeights.paper()` has the paper's λ's.
    """

    pixel_sigma: float = 1.0
    """Static points, px."""
    landmark_loss: float = 1.5
    """Cauchy scale, in `pixel_sigma`."""
    keypoint_sigma: float = 6.0
    """Keypoints of confidence 1, px; divided by the confidence."""
    keypoint_loss: float = 16.0
    """Geman-McClure scale, in `keypoint_sigma` (Bogo et al.: 100 px)."""
    motion_inflation: float = 1.0
    """Factor on the motion model's own standard deviation, 1."""
    motion_sigma: float | None = None
    """Instead of the motion model's own covariance, m a frame."""
    motion_correlation: float = 0.8
    """Of the motion model's errors in successive frames."""
    posture_sigma: float = 0.18
    """Regressed joint rotations, stationary, rad per axis."""
    posture_correlation: float = 0.96
    """Of their errors in successive frames at 30 fps."""
    posture_predicted: bool = False
    """Whether postures are held to the motion model's prediction instead."""
    shape_sigma: float = 1.0
    """Regressed β; one measurement a person, as the regressor errs alike in all."""
    shape_each_frame: bool = False
    """Whether each frame counts as a measurement of β of its own."""
    orientation_sigma: float | None = None
    """Predicted turns of the person, rad a frame; none without it."""

    @classmethod
    def paper(cls) -> "GraphWeights":
        """λ_lm = 64/b² with b = 2.25 px, λ_mm = 100, λ_posture = λ_shape = 1.

        Its joint weight is read as confidence squared (SMPLify), in px^-2; the scale
        of its Cauchy loss is not stated.
        """
        return cls(
            pixel_sigma=2.25 / 8,
            landmark_loss=1.0,
            keypoint_sigma=1.0,
            keypoint_loss=100.0,
            motion_sigma=0.1,
            motion_correlation=0.0,
            posture_sigma=1.0,
            posture_correlation=0.0,
            posture_predicted=True,
            shape_sigma=1.0,
            shape_each_frame=True,
        )
