"""The logarithm of rotations, and the product of quaternions.

Both are jaxlie's but for what it does not do: its logarithm is constant near half a
turn, so that derivatives lose what turns further about the axis, and a person who
stands upright before OpenCV's camera is half a turn away from it; its products mix
integers in, which strict types forbid.
"""

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

_SMALL = 1e-8
"""Squared sine of half the angle, below which a series is as exact as the quotient."""


def log(rotation: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3"]:
    """The rotation vector of a rotation matrix, rad, of half a turn at most.

    Its derivative is right at every angle; at half a turn, where the vector jumps to
    its opposite, it is that of the branch.
    """
    return log_of(jaxlie.SO3.from_matrix(rotation))


def log_of(rotation: jaxlie.SO3) -> Float[Array, "*b 3"]:
    """`2 atan2(|v|, w) v / |v|` of the quaternion (w, v), w not negative; as `log`."""
    q = rotation.wxyz
    q = jnp.where(q[..., :1] < 0, -q, q)
    w, v = q[..., :1], q[..., 1:]
    squared = jnp.sum(v**2, axis=-1, keepdims=True)
    small = squared < _SMALL
    size = jnp.sqrt(jnp.where(small, 1.0, squared))
    near = jnp.maximum(w, 0.5)  # it is 1 where it is used
    series = 2 / near - 2 * squared / (3 * near**3)
    return v * jnp.where(small, series, 2 * jnp.arctan2(size, w) / size)


def compose(first: jaxlie.SO3, second: jaxlie.SO3) -> jaxlie.SO3:
    """Hamilton's product."""
    a, b, c, d = (first.wxyz[..., i] for i in range(4))
    w, x, y, z = (second.wxyz[..., i] for i in range(4))
    return jaxlie.SO3(
        jnp.stack(
            [
                a * w - b * x - c * y - d * z,
                a * x + b * w + c * z - d * y,
                a * y - b * z + c * w + d * x,
                a * z + b * y - c * x + d * w,
            ],
            axis=-1,
        )
    )
