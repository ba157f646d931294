"""What the terms of the graph are trusted to."""

import dataclasses

from bodyslam_jax.config.check import NOT_NEGATIVE, check

_CORRELATED = 0.999999
"""Errors that last for ever would not be told from what is measured."""


@dataclasses.dataclass(frozen=True)
class GraphWeights:
    """What each measurement is trusted to: standard deviations, and losses in them.

    The defaults are inverse covariances of what is measured, with errors that last
    taken for what they are. `GraphWeights.paper()` has the paper's λ's.
    """

    pixel_sigma: float | None = None
    """Static points in the joint graph, px. Without it, what bundle adjustment found
    of the tracks at hand."""
    landmark_loss: float = 1.5
    """Cauchy scale, in standard deviations of a static point."""
    keypoint_sigma: float | None = None
    """Keypoints of confidence 1, px; divided by the confidence. Without it, the
    detector's usual error in metres of the body, as it appears at its distance."""
    keypoint_inflation: float = 2.5
    """Factor on the detector's usual error at 30 fps; grows with the root of the frame
    rate. Errors last for about 0.15 s: taken for independent, keypoints stretch the
    body by some per cent."""
    keypoint_loss: float = 4.0
    """Geman-McClure scale, in standard deviations of one keypoint, before the
    inflation. With `keypoint_sigma` in those of a keypoint of confidence 1, for all
    keypoints: the same distance in px, as in Bogo et al. (100 px)."""
    step_error: float = 0.05
    """Error that all of a person's steps share, as a share of them: people differ, and
    postures are wrong for seconds. Without it steps would outvote the body's size."""
    fitted_step_error: float = 0.25
    """The same where bodies are fitted to keypoints: one view hardly shows legs that
    swing towards it, and steps come out short."""
    motion_sigma: float | None = None
    """Instead of the motion model's own covariance, m a frame."""
    motion_in_legs: bool = True
    """Whether displacements are compared in lengths of the person's leg. In metres a
    smaller person in a smaller world has smaller errors, and the estimate shrinks."""
    motion_correlation: float = 0.8
    """Of the motion model's errors in successive frames."""
    posture_sigma: float = 0.2
    """Regressed joint rotations, stationary, rad per axis (published: 19 to 20 degrees
    in all three)."""
    posture_correlation: float = 0.99
    """Of their errors in successive frames at 30 fps: much of an error stays for the
    whole video, and what changes lasts for seconds. Published errors of joints, 98 mm
    and 19.9 m/s² (HMR2 on EMDB), go with 0.987."""
    posture_predicted: bool = False
    """Whether postures are held to the motion model's prediction instead, in frames
    that have one."""
    shape_sigma: float = 0.4
    """Regressed β; one measurement a person, as the regressor errs alike in all. Where
    bodies are fitted to keypoints it holds β to the fit, and errors are those of 1."""
    shape_each_frame: bool = False
    """Whether each frame counts as a measurement of β of its own."""
    orientation_sigma: float | None = None
    """The motion model's prediction of how far the person turns in a frame of 1/30 s,
    rad per axis; not used without it."""
    root_sigma: float | None = 0.12
    """Regressed orientation, stationary, rad per axis; not used without it."""
    root_correlation: float = 0.99
    """Of its errors in successive frames at 30 fps."""
    root_direction: float = 0.015
    """Regressed place of the person across the line of sight, of the distance; used
    where there are no keypoints. Errors last as those of orientation do."""
    root_depth: float = 0.07
    """The same along the line of sight."""
    root_turning: float | None = 0.015
    """Change of the person's turning in a frame of 1/30 s, rad; free without it."""
    upright_sigma: float | None = None
    """How far the trunk of somebody on their feet leans from where it points on
    average, rad in a frame of 1/30 s; free without it. 0.1 suits people who walk:
    their pelvises sway by 0.05, for some five frames at a time."""
    root_smoothness: float | None = 0.02
    """Change of the pelvis' step in a frame of 1/30 s, m; free without it. Real ones
    are of 0.006 m; held to that, a camera that goes with the person would be thought to
    move less, and the world to be smaller."""
    ground_sigma: float | None = 0.04
    """How far the map's ground may be from what people stand on, m: one error for the
    whole sequence. Without it, people need not stand on anything."""

    def __post_init__(self):
        ranges = {
            name: (0, _CORRELATED) for name in vars(self) if "correlation" in name
        }
        free = ("step_error", "fitted_step_error")
        # Deviations say nothing then; losses, factors and shares would be no numbers.
        never = ("correlation", "inflation", "loss", "error", "each", "predicted")
        never += ("legs",)
        silent = [x for x in vars(self) if not any(word in x for word in never)]
        check(self, ranges | dict.fromkeys(free, NOT_NEGATIVE), infinite=silent)

    @classmethod
    def paper(cls) -> "GraphWeights":
        """λ_lm = 64/b² with b = 2.25 px, λ_mm = 100, λ_posture = λ_shape = 1.

        Its joint weight is read as confidence squared (SMPLify), in px^-2, outside the
        robust loss; the scale of its Cauchy loss is not stated, and is that of OKVIS,
        whose λ_lm it has. What else differs: docs/differences_from_the_paper.md.
        """
        return cls(
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
            ground_sigma=None,
        )
