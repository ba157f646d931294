"""Rotation matrices and vectors, NumPy in and out, for what is done once per clip."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float

from bodyslam_jax.geometry.so3 import log


def matrices(vectors: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """Of axis-angle vectors, rad."""
    return np.asarray(_exp(jnp.asarray(vectors)), float)


def vectors(rotations: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b 3"]:
    """Axis-angle of rotation matrices, rad."""
    return np.asarray(_log(jnp.asarray(rotations)), float)


def slerp(
    a: Float[np.ndarray, "*b 3 3"],
    b: Float[np.ndarray, "*b 3 3"],
    share: Float[np.ndarray, "*b"],
) -> Float[np.ndarray, "*b 3 3"]:
    """From `a` (share 0) to `b` (share 1) the short way round."""
    whole = vectors(np.swapaxes(a, -1, -2) @ b)
    return a @ matrices(share[..., None] * whole)


_exp = jax.jit(lambda v: jaxlie.SO3.exp(v).as_matrix())
_log = jax.jit(log)
