"""The rotation group SO(3) in JAX: exponential, logarithm, composition, interpolation.

A rotation is a matrix R or its rotation vector θ (axis times angle, rad), `R = Exp(θ)`.
Values and derivatives are finite and correct at every angle, also at 0 and at π, where
a person who stands upright before an OpenCV camera is; types are kept (float32 or
float64). `so3_numpy` has the same functions for stages that work in NumPy.
"""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
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
    squared = _squared(vector)
    small = squared < _SMALL_SQUARED_ANGLE
    safe = jnp.where(small, 1.0, squared)
    half = 0.5 * jnp.sqrt(safe)
    sine, cosine = jnp.sin(half), jnp.cos(half)
    s = squared
    # Taylor series in s of a,
    a_series = 1 - s / 6 * (1 - s / 20 * (1 - s / 42 * (1 - s / 72)))
    # and of b.
    b_series = 0.5 * (1 - s / 12 * (1 - s / 30 * (1 - s / 56 * (1 - s / 90))))
    a = jnp.where(small, a_series, sine * cosine / half)
    b = jnp.where(small, b_series, 2 * sine * sine / safe)
    a, b = a[..., None, None], b[..., None, None]
    eye = jnp.eye(3, dtype=vector.dtype)
    return (1 - b * s[..., None, None]) * eye + (a * _skew(vector) + b * _outer(vector))


def log(rotation: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3"]:
    """Converts rotation matrices to rotation vectors, at most π long.

    At π, where the vector jumps to its opposite, the derivative is that of the returned
    branch.
    """
    return _log_quaternion(_quaternion_of_matrix(rotation))


def compose(
    first: Float[Array, "*#b 3"], second: Float[Array, "*#b 3"]
) -> Float[Array, "*b 3"]:
    """Returns `Log(Exp(first) Exp(second))`, with `second` in the rotated frame."""
    if first.shape == second.shape:
        both = _quaternion(jnp.stack([first, second]))
        return _log_quaternion(_product(both[0], both[1]))
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
    squared = _squared(vector)
    small = squared < 1e-4
    safe = jnp.where(small, 1.0, squared)
    half = 0.5 * jnp.sqrt(safe)
    factor = (1 - half * jnp.cos(half) / jnp.sin(half)) / safe
    # Bernoulli numbers: 1 / 12 + s / 720 + ...
    factor = jnp.where(small, 1 / 12 + squared / 720, factor)
    along = (1 - factor * squared)[..., None, None]
    eye = jnp.eye(3, dtype=vector.dtype)
    bent = 0.5 * _skew(vector) + factor[..., None, None] * _outer(vector)
    return along * eye + bent


# Sums of products with constants, not stacks of entries: XLA makes one loop of a sum,
# and one of each entry of a stack.

_SKEW = -np.array(
    [
        [[0, 0, 0], [0, 0, 1], [0, -1, 0]],
        [[0, 0, -1], [0, 0, 0], [1, 0, 0]],
        [[0, 1, 0], [-1, 0, 0], [0, 0, 0]],
    ]
)
"""`[e_i]x` of the three axes."""


def _skew(vector: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Returns `[θ]x`."""
    basis = jnp.asarray(_SKEW, vector.dtype)
    x, y, z = (vector[..., i, None, None] * basis[i] for i in range(3))
    return x + y + z


def _outer(vector: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Returns `θ θ^T`, which is `[θ]x² + |θ|² I`."""
    return vector[..., :, None] * vector[..., None, :]


def _squared(vector: Float[Array, "*b 3"]) -> Float[Array, "*b"]:
    return vector[..., 0] ** 2 + vector[..., 1] ** 2 + vector[..., 2] ** 2


def _quaternion(vector: Float[Array, "*b 3"]) -> Float[Array, "*b 4"]:
    """Converts rotation vectors to unit quaternions (w, x, y, z), `w = cos(|θ| / 2)`
    and `(x, y, z) = sin(|θ| / 2) θ / |θ|`."""
    s = _squared(vector)
    small = s < _SMALL_SQUARED_ANGLE
    half = 0.5 * jnp.sqrt(jnp.where(small, 1.0, s))
    # Taylor series of the cosine of half the angle,
    w_series = 1 - s / 8 * (1 - s / 48 * (1 - s / 120))
    # and of its sine over the angle.
    share_series = 0.5 - s / 48 * (1 - s / 80 * (1 - s / 168))
    w = jnp.where(small, w_series, jnp.cos(half))
    share = jnp.where(small, share_series, 0.5 * jnp.sin(half) / half)
    return jnp.concatenate([w[..., None], share[..., None] * vector], axis=-1)


def _coefficients() -> Float[np.ndarray, "9 16"]:
    """Returns the coefficients of the entries of R in `4 q q^T - I`."""
    found = np.zeros((3, 3, 4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        x, y = 1 + i, 1 + j
        found[i, i] = np.diag([1.0 if n in (0, x) else -1.0 for n in range(4)])
        # R_kj - R_jk = 4 w q_i and R_ij + R_ji = 4 q_i q_j
        found[k, j, [0, x], [x, 0]], found[j, k, [0, x], [x, 0]] = 1.0, -1.0
        found[i, j, [x, y], [y, x]] = found[j, i, [x, y], [y, x]] = 1.0
    return found.reshape(9, 16)


_COEFFICIENTS = _coefficients()


def _quaternion_of_matrix(R: Float[Array, "*b 3 3"]) -> Float[Array, "*b 4"]:
    """Converts rotation matrices to unit quaternions (w, x, y, z) of either sign.

    The entries of `4 q q^T` are linear in those of R; the quaternion is the row with
    the largest entry on the diagonal, divided by its root (Shepperd, 1978).
    """
    linear = jnp.asarray(_COEFFICIENTS, R.dtype)
    flat = R.reshape(*R.shape[:-2], 9)
    outer = jnp.matmul(flat, linear, precision=jax.lax.Precision.HIGHEST)
    eye = jnp.eye(4, dtype=R.dtype)
    outer = outer.reshape(*R.shape[:-2], 4, 4) + eye
    square = jnp.sum(outer * eye, axis=-1)
    picked = jnp.arange(4) == jnp.argmax(square, axis=-1)[..., None]
    row = jnp.sum(jnp.where(picked[..., None], outer, 0.0), axis=-2)
    square = jnp.sum(jnp.where(picked, square, 0.0), axis=-1)
    return 0.5 * row / jnp.sqrt(square)[..., None]


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
    w, v = wxyz[..., 0], wxyz[..., 1:]
    sign = jnp.where(w < 0, -1.0, 1.0).astype(w.dtype)
    w, squared = sign * w, _squared(v)
    small = squared < _SMALL_SQUARED_SINE
    size = jnp.sqrt(jnp.where(small, 1.0, squared))
    near = jnp.maximum(w, 0.5)  # w is about 1 where the series is used
    series = 2 / near - 2 * squared / (3 * near**3)
    share = sign * jnp.where(small, series, 2 * jnp.arctan2(size, w) / size)
    return share[..., None] * v
