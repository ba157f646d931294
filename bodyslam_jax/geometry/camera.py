"""Projection and unprojection of pinhole cameras, with or without lens distortion.

Intrinsics are one array of 4 numbers `fx fy cx cy` (px) or 8, with `k1 k2 p1 p2` at the
end. C has x right, y down, z forward; pixel (0, 0) is the top-left pixel's centre.
Distortion: OpenCV's `calib3d` (Brown--Conrady), two radial and two tangential terms.

Every function broadcasts over leading axes. Values and derivatives are finite, also at
and behind the camera plane, where a projection is meaningless.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.geometry.lengths import padded_rows

MIN_DEPTH = 1e-3
"""Lower bound of the depth in divisions, in the unit of the points."""

_MAX_RADIUS_SQUARED = 16.0
"""Squared radius at depth 1 (76 degrees off the axis) from which the radial polynomial
is held constant, unless it stops growing before."""


@jax.jit
def project(
    intrinsics: Float[Array, "*#b i"], p_C: Float[Array, "*#b 3"]
) -> Float[Array, "*_ 2"]:
    """Projects points in the camera frame to pixels (px).

    Depths below `MIN_DEPTH` are raised to it, so that points behind the camera have a
    finite pixel and derivative.
    """
    depth = jnp.maximum(p_C[..., 2:], MIN_DEPTH)
    return _to_pixel(intrinsics, distort(intrinsics, p_C[..., :2] / depth))


def project_rows(
    intrinsics: Float[Array | np.ndarray, " i"], p_C: Float[np.ndarray, "m 3"]
) -> Float[np.ndarray, "m 2"]:
    """Projects a table of points like `project`, and pads it to a power of two rows so
    that few programs are compiled."""
    count = len(p_C)
    rows = np.ones((padded_rows(count), 3))
    rows[:count] = p_C
    intrinsics = jnp.asarray(intrinsics)
    return np.asarray(project(intrinsics, jnp.asarray(rows, intrinsics.dtype)))[:count]


@jax.jit
def unproject(
    intrinsics: Float[Array, "*#b i"], uv: Float[Array, "*#b 2"]
) -> Float[Array, "*_ 3"]:
    """Returns the points at depth 1, in the camera frame, that project to pixels `uv`
    (px): the inverse of `project`."""
    distorted = (uv - intrinsics[..., 2:4]) / intrinsics[..., :2]
    xy = undistort(intrinsics, distorted)
    return jnp.concatenate([xy, jnp.ones_like(xy[..., :1])], axis=-1)


def distort(
    intrinsics: Float[Array, "*#b i"], xy: Float[Array, "*#b 2"]
) -> Float[Array, "*_ 2"]:
    """Applies lens distortion to coordinates on the plane at depth 1.

    Equals OpenCV's model up to the radius where the radial polynomial stops growing.
    Beyond that radius the radial factor is held constant, so that points far outside
    the image are not folded back into it, as they are in OpenCV. Derivatives treat the
    radius as constant although it depends on `k1` and `k2`; beyond it, derivatives with
    respect to these two differ from finite differences.
    """
    if intrinsics.shape[-1] == 4:
        return xy + 0 * intrinsics[..., :2]
    k1, k2, p1, p2 = (intrinsics[..., i] for i in range(4, 8))
    x, y = xy[..., 0], xy[..., 1]
    r2 = x * x + y * y
    held = jnp.minimum(r2, jax.lax.stop_gradient(_turning_point(k1, k2)))
    radial = 1 + held * (k1 + held * k2)
    # Both tangential terms are homogeneous of degree 2: scaling them by held / r2 holds
    # them at the same radius; the double `where` keeps the derivative at r2 = 0.
    inside = held >= r2
    fade = jnp.where(inside, 1.0, held / jnp.where(inside, 1.0, r2))
    dx = fade * (2 * p1 * x * y + p2 * (r2 + 2 * x * x))
    dy = fade * (p1 * (r2 + 2 * y * y) + 2 * p2 * x * y)
    return jnp.stack([x * radial + dx, y * radial + dy], axis=-1)


def undistort(
    intrinsics: Float[Array, "*#b i"], xy: Float[Array, "*#b 2"]
) -> Float[Array, "*_ 2"]:
    """Inverts `distort` by Newton's method, which starts at the distorted point."""
    xy = xy + 0 * intrinsics[..., :2]
    if intrinsics.shape[-1] == 4:
        return xy
    intrinsics = jnp.broadcast_to(intrinsics, (*xy.shape[:-1], 8))
    ex, ey = jnp.zeros_like(xy).at[..., 0].set(1), jnp.zeros_like(xy).at[..., 1].set(1)

    def newton(estimate: Float[Array, "*b 2"]) -> Float[Array, "*b 2"]:
        found, jvp = jax.linearize(lambda p: distort(intrinsics, p), estimate)
        a, b = jvp(ex), jvp(ey)  # columns of the 2x2 Jacobian
        determinant = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
        determinant = jnp.where(determinant > 1e-3, determinant, 1e-3)
        r = found - xy
        step_x = (b[..., 1] * r[..., 0] - b[..., 0] * r[..., 1]) / determinant
        step_y = (a[..., 0] * r[..., 1] - a[..., 1] * r[..., 0]) / determinant
        return estimate - jnp.stack([step_x, step_y], axis=-1)

    # A scan, not an unrolled loop: ten inlined linearisations are slow to compile.
    return jax.lax.scan(lambda p, _: (newton(p), None), xy, length=10)[0]


def _to_pixel(intrinsics: Array, xy: Array) -> Array:
    """Converts distorted coordinates at depth 1 to pixels."""
    return intrinsics[..., :2] * xy + intrinsics[..., 2:4]


def _turning_point(k1: Array, k2: Array) -> Array:
    """Returns the squared radius at which `r (1 + k1 r^2 + k2 r^4)` stops growing.

    It is the smallest positive root of `1 + 3 k1 q + 5 k2 q^2`, written as `2 / (-b +
    sqrt)` so that `k2 = 0` needs no special case.
    """
    # b² - 4ac of that polynomial.
    b, discriminant = 3 * k1, 9 * k1 * k1 - 20 * k2
    real = discriminant >= 0
    denominator = -b + jnp.sqrt(jnp.where(real, discriminant, 0.0))
    # k2 < 0 has one root of each sign; the formula gives the positive one.
    exists = real & (denominator > 2 / _MAX_RADIUS_SQUARED)
    root = 2 / jnp.where(exists, denominator, 1.0)
    return jnp.where(exists, root, _MAX_RADIUS_SQUARED)
