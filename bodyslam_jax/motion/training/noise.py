"""Simulates estimated postures: true ones with slowly varying errors.

Regressors err by 10 to 20 degrees. Almost all of the error varies slowly (AR(1), rho
0.9 to 0.97 at 30 fps); white noise adds a few tenths of a degree.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from bodyslam_jax.body.skeleton import ANKLES, FEET, HANDS, WRISTS
from bodyslam_jax.geometry import so3

CORRELATION = 0.96
"""Correlation of the slow error between successive frames at 30 fps."""

_EXTREMITIES = (*ANKLES, *FEET, *WRISTS, *HANDS)
JOINT_FACTOR = np.where(np.isin(np.arange(24), _EXTREMITIES), 1.5, 1.0)
"""Factor on the error of each joint: 1.5 at hands and feet, else 1."""


def drift(
    key: PRNGKeyArray, frames: int, sigma: Float[Array, ""], white: Float[Array, ""]
) -> Float[Array, "{frames} 24 3"]:
    """Draws a stationary AR(1) error of every joint angle plus white noise.

    `sigma` and `white` are standard deviations per axis, in the unit of the result.
    """
    slow, fast = jax.random.split(key)
    dtype = sigma.dtype
    innovation = jax.random.normal(slow, (frames, 24, 3), dtype)
    rest = jnp.asarray(np.sqrt(1 - CORRELATION**2), dtype)
    innovation = innovation.at[1:].multiply(rest)
    # x_k = sum_i rho^(k-i) e_i as one product: cheaper than a scan, and exact
    lag = np.arange(frames)[:, None] - np.arange(frames)
    decay = np.where(lag >= 0, CORRELATION ** np.maximum(lag, 0), 0.0)
    walk = jnp.tensordot(jnp.asarray(decay, dtype), innovation, 1)
    noise = sigma * walk + white * jax.random.normal(fast, (frames, 24, 3), dtype)
    return noise * jnp.asarray(JOINT_FACTOR, dtype)[:, None]


def disturb(
    poses: Float[Array, "*b 24 3"], noise: Float[Array, "*b 24 3"]
) -> Float[Array, "*b 24 3"]:
    """Rotates each joint by a further small rotation in its own frame (rad)."""
    return so3.compose(poses, noise)
