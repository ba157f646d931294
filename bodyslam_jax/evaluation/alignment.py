"""Least-squares alignment of point sets, and the four alignments of the paper.

`y ≈ s R x + t` with target `y` (the truth) and source `x` (the estimate). Umeyama,
"Least-squares estimation of transformation parameters between two point patterns"
(TPAMI 1991) gives the optimum; the rotation is found by Davenport's q-method (Horn,
JOSA A 1987), whose quaternion can never be a reflection and which still answers when
points are collinear or coincide.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3

Alignment = Literal["A1", "A2", "A3", "A4"]
"""Alignments of the paper's appendix: A1 aligns camera and person independently (the
paper's tables), A2 applies the camera's alignment to both, A3 is one alignment for
camera and person together, A4 sets the first camera pose to the truth (shows drift)."""


class Similarity(eqx.Module):
    """Similarity `x -> s R x + t`, from the estimate's world to the truth's."""

    scale: Float[Array, "*b"]
    """Scale of the truth relative to the estimate; 1 in SE(3)."""
    rotation: Float[Array, "*b 3 3"]
    translation: Float[Array, "*b 3"]
    """Translation, m."""

    def apply(self, points: Float[Array, "*p 3"]) -> Float[Array, "*p 3"]:
        """Transforms points by a single similarity (`*b` empty)."""
        return self.scale * points @ self.rotation.T + self.translation


@jax.custom_jvp
def nearest_rotation(matrix: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3 3"]:
    """Returns the rotation `R` that maximises `tr(Rᵀ M)`; one of the maximisers if
    there are several.

    The derivative is that of the optimality condition (`Rᵀ M` is symmetric), damped
    along rotations that `M` does not determine, hence finite everywhere.
    """
    m = jnp.swapaxes(matrix, -1, -2)
    xx, xy, xz = m[..., 0, 0], m[..., 0, 1], m[..., 0, 2]
    yx, yy, yz = m[..., 1, 0], m[..., 1, 1], m[..., 1, 2]
    zx, zy, zz = m[..., 2, 0], m[..., 2, 1], m[..., 2, 2]
    # Order x y z w: with equal eigenvalues, the last eigenvector is the identity.
    davenport = jnp.stack(
        [
            jnp.stack([xx - yy - zz, xy + yx, zx + xz, yz - zy], -1),
            jnp.stack([xy + yx, yy - xx - zz, yz + zy, zx - xz], -1),
            jnp.stack([zx + xz, yz + zy, zz - xx - yy, xy - yx], -1),
            jnp.stack([yz - zy, zx - xz, xy - yx, xx + yy + zz], -1),
        ],
        -2,
    )
    _, vectors = jnp.linalg.eigh(davenport)
    return so3.from_quaternion(vectors[..., -1])


@nearest_rotation.defjvp
def _nearest_rotation_jvp(primals, tangents):
    (matrix,), (matrix_dot,) = primals, tangents
    rotation = nearest_rotation(matrix)
    transposed = jnp.swapaxes(rotation, -1, -2)
    stretch = transposed @ matrix
    turned = transposed @ matrix_dot
    eye = jnp.eye(3, dtype=matrix.dtype)
    trace = jnp.trace(stretch, axis1=-2, axis2=-1)[..., None, None]
    size = jnp.where(trace > 0, trace, 1.0)
    # dR = R [w]ₓ keeps RᵀM symmetric where (tr(P) I - P) w = vee(RᵀdM - (RᵀdM)ᵀ).
    curvature = eye * trace - (stretch + jnp.swapaxes(stretch, -1, -2)) / 2
    curvature = curvature / size
    skew = (turned - jnp.swapaxes(turned, -1, -2)) / size
    vee = jnp.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1)
    damped = curvature @ curvature + jnp.finfo(matrix.dtype).eps * eye
    w = jnp.linalg.solve(damped, curvature @ vee[..., None])[..., 0]
    zero = jnp.zeros_like(w[..., 0])
    cross = jnp.stack(
        [
            jnp.stack([zero, -w[..., 2], w[..., 1]], -1),
            jnp.stack([w[..., 2], zero, -w[..., 0]], -1),
            jnp.stack([-w[..., 1], w[..., 0], zero], -1),
        ],
        -2,
    )
    return rotation, rotation @ cross


def similarity_from_moments(
    target_mean: Float[Array, "*b 3"],
    source_mean: Float[Array, "*b 3"],
    covariance: Float[Array, "*b 3 3"],
    variance: Float[Array, "*b"],
    with_scale: bool,
) -> Similarity:
    """Returns Umeyama's solution from centred moments.

    `covariance` is the mean of `(y - μ_y)(x - μ_x)ᵀ`, `variance` that of `|x - μ_x|²`;
    source points that coincide leave the scale at 1.
    """
    rotation = nearest_rotation(covariance)
    if with_scale:
        explained = jnp.sum(rotation * covariance, (-2, -1))  # tr(D S)
        one = is_point(variance, source_mean)
        scale = jnp.where(one, 1, explained / jnp.where(one, 1, variance))
    else:
        scale = jnp.ones_like(variance)
    moved = (rotation @ source_mean[..., None])[..., 0]
    return Similarity(scale, rotation, target_mean - scale[..., None] * moved)


def is_point(
    variance: Float[Array, "*b"], mean: Float[Array, "*b 3"]
) -> Bool[Array, "*b"]:
    """Returns whether points with this variance about their mean coincide, that is,
    whether the variance may be rounding of the mean."""
    info = jnp.finfo(variance.dtype)
    rounding = (32 * float(info.eps)) ** 2 * jnp.sum(
        jax.lax.stop_gradient(mean) ** 2, -1
    )
    return variance <= jnp.maximum(rounding, float(info.tiny))  # false for NaN


def umeyama(
    target: Float[Array, "*b n 3"],
    source: Float[Array, "*b n 3"],
    weights: Float[Array, "*b n"] | None = None,
    with_scale: bool = False,
) -> Similarity:
    """Returns the SE(3), or with `with_scale` the Sim(3), that minimises
    `Σ w |y - s R x - t|²`.

    Points of weight zero are ignored, even if they are NaN. With fewer than three
    points, or collinear ones, it is one of many minimisers; if all weights are zero,
    rotation and scale are those of the identity. The gradient is finite in all of these
    cases.
    """
    if weights is None:
        weights = jnp.ones_like(target[..., 0])
    exists = weights[..., None] != 0
    target, source = jnp.where(exists, target, 0), jnp.where(exists, source, 0)
    total = jnp.sum(weights, -1, keepdims=True)
    w = (weights / jnp.where(total > 0, total, 1))[..., None]
    target_mean, source_mean = jnp.sum(w * target, -2), jnp.sum(w * source, -2)
    y, x = target - target_mean[..., None, :], source - source_mean[..., None, :]
    covariance = jnp.swapaxes(w * y, -1, -2) @ x
    variance = jnp.sum(w * x**2, (-2, -1))
    return similarity_from_moments(
        target_mean, source_mean, covariance, variance, with_scale
    )


def align_first(
    target: Float[Array, "t 4 4"],
    source: Float[Array, "t 4 4"],
    valid: Float[Array, " t"],
) -> Similarity:
    """Returns the SE(3) that maps the first valid camera pose onto the truth (A4)."""
    first = jnp.argmax(valid > 0)
    rotation = target[first, :3, :3] @ source[first, :3, :3].T
    translation = target[first, :3, 3] - rotation @ source[first, :3, 3]
    return Similarity(jnp.ones_like(translation[0]), rotation, translation)


def align(
    alignment: Alignment,
    true_cameras: Float[Array, "t 4 4"],
    cameras: Float[Array, "t 4 4"],
    camera_weights: Float[Array, " t"],
    true_centres: Float[Array, "t 3"],
    centres: Float[Array, "t 3"],
    centre_weights: Float[Array, " t"],
    with_scale: bool = False,
) -> tuple[Similarity, Similarity]:
    """Aligns the camera trajectory, and the centres of one person, to the truth.

    `alignment` is `"A1"` to `"A4"`, methods 1 to 4 of Henning et al., ECCV 2022,
    appendix B. Frames of weight 0 are ignored; the others have weight 1. A4 aligns a
    single pose, which does not determine a scale.

    **Raises:** `InputError` for A4 with scale and for any other name.
    """
    if alignment == "A4":
        if with_scale:
            raise InputError("Alignment A4 sets one pose, which fixes no scale.")
        both = align_first(true_cameras, cameras, camera_weights)
        return both, both
    y, x = true_cameras[:, :3, 3], cameras[:, :3, 3]
    if alignment == "A3":
        both = umeyama(
            jnp.concatenate([y, true_centres]),
            jnp.concatenate([x, centres]),
            jnp.concatenate([camera_weights, centre_weights]),
            with_scale,
        )
        return both, both
    camera = umeyama(y, x, camera_weights, with_scale)
    if alignment == "A2":
        return camera, camera
    if alignment == "A1":
        return camera, umeyama(true_centres, centres, centre_weights, with_scale)
    raise InputError(f"Alignment {alignment!r}, not one of A1, A2, A3, A4.")
