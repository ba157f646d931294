"""Settings of the training of motion models and of the contact network."""

import dataclasses
from typing import Literal

from bodyslam_jax.config.errors import NOT_NEGATIVE, SHARE, InputError, check

_SHARE_FIELDS = "future averaging clean_share"
_NOT_NEGATIVE_FIELDS = (
    "weight_decay slope_weight segment_weight drift_deg white_deg root_drift "
    "shape_sigma run_weight other_weight"
)


@dataclasses.dataclass(frozen=True)
class MotionTraining:
    """Training of a motion model; `MotionTraining.paper()` is section 3.4."""

    network: Literal["metric", "paper"] = "metric"
    """`metric`: network on joint positions in metres over a window; `paper`: the
    paper's network on joint angles."""
    past: int = 16
    """Number of past frames in a window."""
    future: int = 1
    """1 if the window includes the frame that the displacement leads to, else 0."""
    width: tuple[int, ...] = (320, 256, 256)
    """Number of units of each hidden layer."""
    members: int = 1
    """Number of networks whose mean predicts displacement."""
    seed: int = 0
    """Random seed of initial weights and of all random choices."""
    epochs: int = 80
    """Epochs; each draws as many windows as the data have 120 Hz starting points, or as
    many as do not overlap (`sliding`)."""
    validate_every: int = 1
    """Epochs between two evaluations on the validation subjects."""
    segments: int = 128
    """Number of segments in a batch, each with its own person, speed and noise
    level."""
    steps: int = 16
    """Number of successive windows in a segment."""
    learning_rate: float = 1.5e-3
    """Initial learning rate of Adam."""
    decay: bool = True
    """Whether the learning rate decays to 0 along a cosine."""
    weight_decay: float = 1e-4
    """Weight decay of AdamW."""
    clip: float | None = 1.0
    """Largest magnitude of a gradient's entry. Without it, gradients are not
    clipped."""
    averaging: float = 0.998
    """Decay of the exponential moving average of the weights, which is saved; 0: no
    average."""
    slope_weight: float = 2.0
    """Penalty on the squared bias of displacement per noise level, as a biased
    displacement biases the scale."""
    segment_weight: float = 0.5
    """Penalty on the mean error over a segment, beside that of single steps."""
    drift_deg: float = 10.0
    """Largest standard deviation of the correlated error of joint angles, degrees."""
    white_deg: float = 0.6
    """Largest standard deviation of the white error of joint angles, degrees."""
    root_drift: float = 1.0
    """Largest error of the root's rotation as a share of the joints'."""
    clean_share: float = 0.3
    """Share of segments without correlated errors, 0 to 1."""
    shape_sigma: float = 1.0
    """Standard deviation of each component of random β."""
    strides: tuple[int, ...] = (3, 4, 4, 4, 5)
    """Steps through 120 Hz data, one drawn per segment: 4 is real speed."""
    run_weight: float = 2.0
    """Weight with which windows of running are drawn, relative to walking; they are
    rare."""
    other_weight: float = 0.15
    """The same for all other motion, most of which is slow; 0 excludes it."""
    mirror: bool = True
    """Whether half of the segments are mirrored."""
    sliding: bool = True
    """Whether windows may overlap; the paper's do not. Windows that do not overlap are
    drawn one by one (`steps` 1)."""

    def __post_init__(self):
        ranges = dict.fromkeys(_SHARE_FIELDS.split(), SHARE)
        ranges |= dict.fromkeys(_NOT_NEGATIVE_FIELDS.split(), NOT_NEGATIVE)
        # The range of JAX's random keys.
        check(self, ranges | {"seed": (-(2**63), 2**63 - 1)})
        if not self.sliding and self.steps > 1:
            raise InputError(
                f"steps: found {self.steps}, expected 1 where windows may not overlap "
                "(`sliding` false): those of a segment do."
            )

    @staticmethod
    def paper() -> "MotionTraining":
        """Returns the settings of section 3.4 of the paper: two frames of exact joint
        angles, plain Adam."""
        return MotionTraining(
            network="paper",
            past=2,
            width=(1024,),
            epochs=100,
            learning_rate=1e-3,
            # The batch of section 3.4.
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


@dataclasses.dataclass(frozen=True)
class ContactTraining:
    """Training of the contact network."""

    half: int = 8
    """Number of frames before, and after, the classified frame."""
    width: tuple[int, ...] = (256, 128)
    """Number of units of each hidden layer."""
    updates: int = 4000
    """Number of steps of the optimiser."""
    segments: int = 64
    """Number of segments in a batch, each with its own person, speed and noise
    level."""
    steps: int = 12
    """Number of successive windows in a segment."""
    learning_rate: float = 2e-3
    """Learning rate of Adam after warm-up; it decays to 0 along a cosine."""
    drift_deg: float = 10.0
    """Largest standard deviation of the correlated error of joint angles, degrees."""
    clean_share: float = 0.2
    """Share of segments without correlated errors, 0 to 1."""
    run_weight: float = 2.0
    """Weight with which windows of running are drawn, relative to walking."""
    other_weight: float = 0.3
    """The same for all other motion."""
    seed: int = 0
    """Random seed."""

    def __post_init__(self):
        ranges = {"clean_share": SHARE, "seed": (-(2**63), 2**63 - 1)}
        ranges |= dict.fromkeys(
            ("drift_deg", "run_weight", "other_weight"), NOT_NEGATIVE
        )
        check(self, ranges)
