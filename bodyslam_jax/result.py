"""What comes out: cameras, people and map in one metric world frame.

Plain NumPy; the fields are those of `result.npz`.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float


@dataclasses.dataclass(frozen=True)
class Result:
    """An estimate (or a ground truth) for `t` frames, `h` people, `l` landmarks."""

    timestamps: Float[np.ndarray, " t"]
    """s"""
    T_WC: Float[np.ndarray, "t 4 4"]
    """Camera to world, m."""
    scale: float
    """Metres per unit of the up-to-scale reconstruction."""
    intrinsics: Float[np.ndarray, " i"]
    """`fx fy cx cy` px, then `k1 k2 p1 p2` if distorted."""
    landmarks: Float[np.ndarray, "l 3"]
    """m, world."""
    poses: Float[np.ndarray, "h t 72"]
    """Axis-angle, rad; the root turns the body into the world frame."""
    trans: Float[np.ndarray, "h t 3"]
    """m: pelvis joint minus `J_0(β)`."""
    betas: Float[np.ndarray, "h 10"]
    joints: Float[np.ndarray, "h t 24 3"]
    """m, world."""
    present: Bool[np.ndarray, "h t"]
    """Whether the person is there; rows where not are finite fill, not estimates."""
    summary: dict = dataclasses.field(default_factory=dict)
    """What goes to `summary.json`."""

    @property
    def located(self) -> Bool[np.ndarray, " t"]:
        """Frames whose camera is an estimate: `frames_used` of the summary, first and
        last, if it says so. Beyond a cut poses are finite fill."""
        frames = np.arange(len(self.timestamps))
        used = self.summary.get("frames_used")
        if not (isinstance(used, list) and len(used) == 2):
            return np.ones(len(frames), bool)
        return (frames >= used[0]) & (frames <= used[1])
