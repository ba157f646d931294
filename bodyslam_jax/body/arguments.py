"""Shapes of poses, shapes and translations, refused by the argument's name."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from bodyslam_jax.config.errors import InputError

_TAILS = {
    "body_pose": ((23, 3), "axis-angle of joints 1 to 23, without the root"),
    "pose": ((72,), "axis-angle of 24 joints, root first, in one axis"),
    "shape": ((10,), "SMPL β"),
    "trans": ((3,), "a translation, m"),
}
"""Last axes of each argument, and what they are."""


def batch_of(function: str, **arguments: Array) -> tuple[int, ...]:
    """The shape to which the leading axes of the arguments broadcast.

    **Raises:** `InputError` naming the argument whose last axes are others than its
    own, or all leading axes if they do not broadcast.
    """
    leads = {}
    for name, x in arguments.items():
        tail, meaning = _TAILS[name]
        shape = jnp.shape(x)
        if shape[-len(tail) :] != tail:
            expected = ", ".join(map(str, tail))
            raise InputError(
                f"{function}: `{name}` has shape {shape}, expected (..., {expected}): "
                f"{meaning}."
            )
        leads[name] = shape[: -len(tail)]
    try:
        return np.broadcast_shapes(*leads.values())
    except ValueError:
        found = ", ".join(f"`{name}` {lead}" for name, lead in leads.items())
        raise InputError(
            f"{function}: leading axes {found}, expected axes that broadcast."
        ) from None
