"""The rotation group SO(3) in JAX: exponential, logarithm, composition, interpolation.

A rotation is a matrix R or its rotation vector θ (axis times angle, rad), `R = Exp(θ)`.
Values and derivatives are finite and correct at every angle, also at 0 and at π, where
a person who stands upright before an OpenCV camera is; types are kept (float32 or
float64). `so3_numpy` has the same functions for stages that work in NumPy.
"""

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

_SMALL_SQUARED_ANGLE = 1e-3
"""Squared angle below which the series of `exp` are exact to rounding, with two
derivatives, rad²."""
_SMALL_SQUARED_SINE = 1e-8
"""Squared sine of half the angle below which the series of `log` is exact."""


def exp(vector: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Converts rotation vectors to matrices by Rodrigues' formula.

    `R = I + a [θ]x + b [θ]x²` with `a = sin|θ| / |θ|`, `b = (1 - cos|θ|) / |θ|²`.
    """
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    xx, yy, zz = x * x, y * y, z * z
    squared = xx + yy + zz
    small = squared < _SMALL_SQUARED_ANGLE
    safe = jnp.where(small, 1.0, squared)
    half = 0.5 * jnp.sqrt(safe)
    sine, cosine = jnp.sin(half), jnp.cos(half)
    s = squared
    a_series = 1 - s / 6 * (1 - s / 20 * (1 - s / 42 * (1 - s / 72)))
    b_series = 0.5 * (1 - s / 12 * (1 - s / 30 * (1 - s / 56 * (1 - s / 90))))
    a = jnp.where(small, a_series, sine * cosine / half)
    b = jnp.where(small, b_series, 2 * sine * sine / safe)
    xy, xz, yz = b * x * y, b * x * z, b * y * z
    ax, ay, az = a * x, a * y, a * z
    rows = [
        [1 - b * (yy + zz), xy - az, xz + ay],
        [xy + az, 1 - b * (xx + zz), yz - ax],
        [xz - ay, yz + ax, 1 - b * (xx + yy)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def log(rotation: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3"]:
    """Converts rotation matrices to rotation vectors, at most π long.

    At π, where the vector jumps to its opposite, the derivative is that of the returned
    branch.
    """
    return _log_quaternion(jaxlie.SO3.from_matrix(rotation).wxyz)


def compose(
    first: Float[Array, "*#b 3"], second: Float[Array, "*#b 3"]
) -> Float[Array, "*b 3"]:
    """Returns `Log(Exp(first) Exp(second))`, with `second` in the rotated frame."""
    return _log_quaternion(_product(_quaternion(first), _quaternion(second)))


def between(
    first: Float[Array, "*#b 3"], second: Float[Array, "*#b 3"]
) -> Float[Array, "*b 3"]:
    """Returns `Log(Exp(first)ᵀ Exp(second))`, the rotation from `first` to `second` in
    the frame of `first`; at most π long."""
    return compose(-first, second)


def inverse(rotation: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3 3"]:
    """Transposes rotation matrices."""
    return rotation.swapaxes(-1, -2)


def interpolate(
    start: Float[Array, "*#b 3 3"],
    end: Float[Array, "*#b 3 3"],
    share: Float[Array, "*#b"],
) -> Float[Array, "*b 3 3"]:
    """Interpolates along the geodesic from `start` (share 0) to `end` (share 1)."""
    return start @ exp(share[..., None] * log(inverse(start) @ end))


def from_quaternion(xyzw: Float[Array, "*b 4"]) -> Float[Array, "*b 3 3"]:
    """Converts quaternions (x, y, z, w) of any length but 0 to rotation matrices."""
    return jaxlie.SO3.from_quaternion_xyzw(xyzw).as_matrix()


def inverse_right_jacobian(vector: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Returns `d Log(Exp(θ) Exp(δ)) / dδ` at δ = 0; finite for angles below 2π."""
    squared = jnp.sum(vector**2, axis=-1)[..., None, None]
    small = squared < 1e-4
    safe = jnp.where(small, 1.0, squared)
    half = 0.5 * jnp.sqrt(safe)
    factor = (1 - half * jnp.cos(half) / jnp.sin(half)) / safe
    factor = jnp.where(small, 1 / 12 + squared / 720, factor)
    x, y, z = (vector[..., i] for i in range(3))
    zero = jnp.zeros_like(x)
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    skew = jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)
    eye = jnp.eye(3, dtype=vector.dtype)
    return eye + 0.5 * skew + factor * (skew @ skew)


def _quaternion(vector: Float[Array, "*b 3"]) -> Float[Array, "*b 4"]:
    """Converts rotation vectors to unit quaternions (w, x, y, z)."""
    return jaxlie.SO3.exp(vector).wxyz


def _product(
    first: Float[Array, "*#b 4"], second: Float[Array, "*#b 4"]
) -> Float[Array, "*b 4"]:
    """Returns Hamilton's product. That of jaxlie promotes integers, which strict dtype
    promotion forbids."""
    a, b, c, d = (first[..., i] for i in range(4))
    w, x, y, z = (second[..., i] for i in range(4))
    return jnp.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        axis=-1,
    )


def _log_quaternion(wxyz: Float[Array, "*b 4"]) -> Float[Array, "*b 3"]:
    """Returns `2 atan2(|v|, w) v / |v|` for a quaternion (w, v) with w made >= 0.

    The logarithm of jaxlie is constant near π, so that its derivative with respect to a
    further rotation about the axis vanishes there.
    """
    q = jnp.where(wxyz[..., :1] < 0, -wxyz, wxyz)
    w, v = q[..., :1], q[..., 1:]
    squared = jnp.sum(v**2, axis=-1, keepdims=True)
    small = squared < _SMALL_SQUARED_SINE
    size = jnp.sqrt(jnp.where(small, 1.0, squared))
    near = jnp.maximum(w, 0.5)  # w is about 1 where the series is used
    series = 2 / near - 2 * squared / (3 * near**3)
    return v * jnp.where(small, series, 2 * jnp.arctan2(size, w) / size)
