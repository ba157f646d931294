"""Standard deviations and robust losses of the factors of the graph."""

import dataclasses

from bodyslam_jax.config.errors import NOT_NEGATIVE, check

_MAX_CORRELATION = 0.999999
"""Largest AR(1) coefficient: constant errors would be indistinguishable from the
measured quantity."""


@dataclasses.dataclass(frozen=True)
class GraphWeights:
    """Standard deviations of the graph's measurements, and scales of robust losses.

    The defaults are measured; temporally correlated errors are modelled as AR(1).
    `GraphWeights.paper()` has the paper's λ's.
    """

    pixel_sigma: float | None = None
    """Standard deviation of static points in the joint graph, px. Without it, the value
    that bundle adjustment estimated from the tracks."""
    landmark_loss: float = 1.5
    """Scale of the Cauchy loss on static points, in standard deviations."""
    keypoint_sigma: float | None = None
    """Standard deviation of a keypoint of confidence 1, px; divided by the confidence.
    Without it, the typical error of detectors in metres on the body, projected at the
    person's depth."""
    keypoint_inflation: float = 2.5
    """Factor on the typical error of detectors at 30 fps; grows with the square root of
    the frame rate. Keypoint errors are correlated over about 0.15 s; modelled as
    independent, they stretch the body by some per cent."""
    keypoint_loss: float = 4.0
    """Scale of the Geman-McClure loss, in standard deviations of a keypoint before the
    inflation. With `keypoint_sigma`, in those of a keypoint of confidence 1 for all
    keypoints: one distance in px, as in Bogo et al. (100 px)."""
    step_error: float = 0.05
    """Standard deviation of the error common to all steps of a person, relative:
    people differ, and posture errors last for seconds. At 0, steps outweigh the
    body's size."""
    fitted_step_error: float = 0.25
    """The same where bodies are fitted to keypoints: one view hardly observes legs that
    swing towards it, so that steps come out short."""
    motion_sigma: float | None = None
    """Standard deviation of a displacement, m per frame of 1/30 s, in place of the
    motion model's own covariance."""
    motion_in_legs: bool = True
    """Whether displacements are compared in lengths of the person's leg. In metres,
    errors shrink with the person and the world, which biases the scale downwards."""
    motion_correlation: float = 0.8
    """AR(1) coefficient of the motion model's errors per frame of 1/30 s."""
    posture_sigma: float = 0.2
    """Stationary standard deviation of regressed joint rotations, rad per axis
    (published: 19 to 20 degrees over all three axes)."""
    posture_correlation: float = 0.99
    """AR(1) coefficient of regressed joint rotations' errors per frame of 1/30 s.
    Published errors of joints, 98 mm and 19.9 m/s² (HMR2 on EMDB), correspond to
    0.987."""
    posture_predicted: bool = False
    """Whether the prior of postures is the motion model's prediction, in frames that
    have one, in place of the regressed posture."""
    shape_sigma: float = 0.4
    """Standard deviation of regressed β, one measurement per person because a
    regressor's error is common to all frames. Where bodies are fitted to keypoints, it
    holds β to the fit, whose reported standard deviation is the prior's, 1."""
    shape_each_frame: bool = False
    """Whether β of each frame is a separate measurement."""
    root_sigma: float | None = 0.12
    """Stationary standard deviation of regressed root orientation, rad per axis.
    Without it, the orientation is not used."""
    root_correlation: float = 0.99
    """AR(1) coefficient of regressed root orientation's and position's errors per frame
    of 1/30 s."""
    root_direction: float = 0.015
    """Standard deviation of the regressed root position across the line of sight,
    relative to the distance; used where there are no keypoints."""
    root_depth: float = 0.07
    """The same along the line of sight."""
    root_turning: float | None = 0.015
    """Standard deviation of a person's angular acceleration, rad per squared frame of
    1/30 s. Without it, turning is not constrained."""
    root_smoothness: float | None = 0.02
    """Standard deviation of the pelvis' acceleration, m per squared frame of 1/30 s;
    not constrained without it. Real ones are 0.006; that tight, a camera that follows
    the person is estimated to move less and the world to be smaller."""
    contact_sigma: float | None = 0.02
    """Standard deviation of the displacement in a frame of 1/30 s of a toe or heel that
    stands, in lengths of the person's leg: four times the true slip (0.005), which is
    correlated over a stance. Without it, standing feet may slide."""
    ground_sigma: float | None = 0.04
    """Standard deviation of the height between the map's ground and the ground that
    people stand on, m: one error for the whole sequence. Without it, people need not
    stand on anything."""

    def __post_init__(self):
        ranges = {
            name: (0, _MAX_CORRELATION) for name in vars(self) if "correlation" in name
        }
        free = ("step_error", "fitted_step_error")
        # An infinite standard deviation disables a term; other infinities are errors.
        never = ("correlation", "inflation", "loss", "error", "each", "predicted")
        never += ("legs",)
        silent = [x for x in vars(self) if not any(word in x for word in never)]
        check(self, ranges | dict.fromkeys(free, NOT_NEGATIVE), infinite=silent)

    @classmethod
    def paper(cls) -> "GraphWeights":
        """Returns λ_lm = 64/b² with b = 2.25 px, λ_mm = 100, λ_posture = λ_shape = 1.

        Its joint weight is interpreted as confidence squared (SMPLify), in px^-2,
        outside the robust loss. The scale of its Cauchy loss is not stated; it is taken
        from OKVIS, which has the same λ_lm. See docs/differences_from_the_paper.md for
        other differences.
        """
        return cls(
            # λ = 64 / b² of the paper, with b = 2.25 px.
            pixel_sigma=2.25 / 8,
            landmark_loss=1.0,
            keypoint_sigma=1.0,
            keypoint_loss=100.0,
            step_error=0.0,
            fitted_step_error=0.0,
            motion_sigma=0.1,
            motion_in_legs=False,
            motion_correlation=0.0,
            posture_sigma=1.0,
            posture_correlation=0.0,
            posture_predicted=True,
            shape_sigma=1.0,
            shape_each_frame=True,
            root_sigma=None,
            root_turning=None,
            root_smoothness=None,
            contact_sigma=None,
            ground_sigma=None,
        )
