"""Bodies as the readers give them: one row each, in no order."""

import dataclasses

import numpy as np
from jaxtyping import Float, Int


@dataclasses.dataclass(frozen=True)
class Rows:
    """`m` bodies in the camera frame."""

    frame: Int[np.ndarray, " m"]
    person: Int[np.ndarray, " m"]
    """Any number that is the same for the same person."""
    poses: Float[np.ndarray, "m 72"]
    """Axis-angle, rad, root first."""
    betas: Float[np.ndarray, "m 10"]
    trans: Float[np.ndarray, "m 3"]
    """m: the pelvis is at `J_0(β) + trans`."""
    shapes_regressed: bool = True
    """As in `Bodies`."""
