"""How a motion model is trained."""

import dataclasses
from typing import Literal

from bodyslam_jax.config.check import NOT_NEGATIVE, SHARE, check

_SHARES = "future averaging clean_share"
_MAY_BE_0 = (
    "weight_decay slope_weight segment_weight drift_deg white_deg root_drift "
    "shape_sigma run_weight other_weight"
)


@dataclasses.dataclass(frozen=True)
class MotionTraining:
    """How a motion model is trained; `MotionTraining.paper()` is section 3.4."""

    network: Literal["metric", "paper"] = "metric"
    """Metric joint positions over a window, or the paper's network on joint angles."""
    past: int = 16
    """Frames before the predicted one that a window holds."""
    future: int = 1
    """1 if displacement may depend on the posture of the frame it leads to, else 0."""
    width: tuple[int, ...] = (320, 256, 256)
    """Units of the hidden layers."""
    members: int = 1
    """Networks of which displacement is the mean."""
    seed: int = 0
    """Initial weights and every random choice follow from it."""
    epochs: int = 80
    """Each has as many windows as the data have: one for every 120 Hz starting point,
    or as many as do not overlap."""
    validate_every: int = 1
    """Epochs from one look at the validation subjects to the next."""
    segments: int = 128
    """Segments in a batch; each is of another person, speed and noise level."""
    steps: int = 16
    """Successive windows of a segment."""
    learning_rate: float = 1.5e-3
    """Adam's at the start; falls to nothing along a cosine if `decay`."""
    decay: bool = True
    """Whether the learning rate falls."""
    weight_decay: float = 1e-4
    """AdamW's."""
    clip: float | None = 1.0
    """Largest entry of a gradient; not limited without it."""
    averaging: float = 0.998
    """Share that the running mean of weights, which is kept, has of itself; 0: none."""
    slope_weight: float = 2.0
    """Penalty on the squared bias of displacement per noise level: bias is scale."""
    segment_weight: float = 0.5
    """Penalty on the mean error over a segment, beside that of single steps."""
    drift_deg: float = 10.0
    """Largest standard deviation of the slow error of joint angles, degrees."""
    white_deg: float = 0.6
    """Largest standard deviation of the white error of joint angles, degrees."""
    root_drift: float = 1.0
    """Largest error of the root's rotation as a share of the joints'."""
    clean_share: float = 0.3
    """Share of segments without slow errors."""
    shape_sigma: float = 1.0
    """Standard deviation of each component of β."""
    strides: tuple[int, ...] = (3, 4, 4, 4, 5)
    """Steps through 120 Hz data, one drawn per segment: 4 is real speed."""
    run_weight: float = 2.0
    """How often a window of running is drawn beside one of walking: runs are few."""
    other_weight: float = 0.15
    """The same for all other motion, most of which is slow; 0 leaves it out."""
    mirror: bool = True
    """Whether half of the segments are mirrored."""
    sliding: bool = True
    """Whether windows may overlap; the paper's do not. Each is then drawn by itself:
    successive windows of a segment (`steps`) share frames."""

    def __post_init__(self):
        ranges = dict.fromkeys(_SHARES.split(), SHARE)
        ranges |= dict.fromkeys(_MAY_BE_0.split(), NOT_NEGATIVE)
        # What a random key is made of.
        check(self, ranges | {"seed": (-(2**63), 2**63 - 1)})
        if not self.sliding and self.steps > 1:
            raise ValueError(
                f"steps: found {self.steps}, expected 1 where windows may not overlap "
                "(`sliding` false): those of a segment do."
            )

    @staticmethod
    def paper() -> "MotionTraining":
        """Section 3.4 of the paper: two frames of exact joint angles, plain Adam."""
        return MotionTraining(
            network="paper",
            past=2,
            width=(1024,),
            epochs=100,
            learning_rate=1e-3,
            segments=4096,
            steps=1,
            decay=False,
            weight_decay=0.0,
            clip=None,
            averaging=0.0,
            drift_deg=0.0,
            white_deg=0.0,
            root_drift=0.0,
            clean_share=0.0,
            strides=(4,),
            run_weight=1.0,
            other_weight=0.0,
            mirror=False,
            sliding=False,
        )
