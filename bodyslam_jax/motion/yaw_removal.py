"""Removes steady yaw from the orientations that are input to the motion model.

Training data are mostly straight walks; on curves the network underestimates
displacements by some per cent. A curve changes the direction of later steps, which
does not matter in the frame of the previous pose, in which displacement is predicted.
So the slowly varying yaw rate about the body's up axis is removed, and the oscillation
with each stride is kept.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax.geometry import so3

_SIGMA_FRAMES = 15
"""Standard deviation of the smoothing kernel, frames at 30 fps: about half a stride."""


def turning_rate(
    orientation: Float[Array, "t 3 3"], present: Bool[Array, " t"]
) -> Float[Array, " t"]:
    """Returns the low-pass filtered yaw about the body's y axis from frame k-1 to k,
    rad, in row k.

    `orientation` rotates H into any fixed frame: the result depends neither on its
    heading nor on its up axis. Frames that are not `present` have no weight.
    """
    step = so3.log(so3.inverse(orientation[:-1]) @ orientation[1:])[:, 1]
    weight = (present[:-1] & present[1:]).astype(step.dtype)
    reach = min(3 * _SIGMA_FRAMES, len(orientation))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / _SIGMA_FRAMES) ** 2)
    kernel = jnp.asarray(kernel, step.dtype)
    smooth = lambda x: jnp.convolve(x, kernel, "full")[reach : reach + len(x)]
    rate = smooth(jnp.where(weight > 0, step, 0)) / jnp.maximum(smooth(weight), 1e-3)
    return jnp.concatenate([jnp.zeros_like(rate[:1]), rate])


def straightened(
    orientation: Float[Array, "t 3 3"], rate: Float[Array, " t"]
) -> Float[Array, "t 3 3"]:
    """Subtracts `rate` from the relative rotations: `C'_k = C'_{k-1} Y(-rate) ΔC_k`."""
    up = jnp.array([0.0, 1.0, 0.0], rate.dtype)
    step = so3.inverse(orientation[:-1]) @ orientation[1:]
    step = so3.exp(-rate[1:, None] * up) @ step
    products = jnp.concatenate([orientation[:1], step])
    frame = jnp.arange(len(products))

    # Each pass doubles the number of factors. `associative_scan` would put every pass
    # into the program, which takes longer to compile than to run.
    def double(level, products):
        back = frame - jnp.left_shift(jnp.ones_like(frame), level.astype(frame.dtype))
        longer = products[jnp.maximum(back, 0)] @ products
        return jnp.where((back >= 0)[:, None, None], longer, products)

    passes = (len(products) - 1).bit_length()
    return jax.lax.fori_loop(0, passes, double, products)
