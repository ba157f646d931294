"""Fits bodies to the keypoints of single frames, starting from the lifted posture.

Each fit starts at the output of the lifting network (`lift`), placed by the keypoints,
and is the start of the fit of all frames (`fit`). Other headings and typical postures
converge to the same bodies (`benchmarks/keypoints.md`).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bodyslam_jax.geometry.camera import unproject
from bodyslam_jax.people.costs import MIN_DEPTH_M, Fit, Lifted, Scene, linearise
from bodyslam_jax.people.skeleton import NUM_SHAPE, place_points

_NUM_STEPS = 15
_BATCH_FRAMES = 64


def fit_frames(
    scene: Scene,
    uv: Float[np.ndarray, "f 25 2"],
    sigma: Float[np.ndarray, "f 25"],
    lifted: Lifted,
    steps: int = _NUM_STEPS,
) -> Fit:
    """Fits each frame independently, with β = 0; returns NumPy arrays."""
    parts, dtype, limit = [], scene.intrinsics.dtype, jnp.asarray(steps)
    for first in range(0, len(uv), _BATCH_FRAMES):
        # The last batch is padded, so that one shape is compiled for any number.
        rows = np.resize(
            np.arange(first, min(first + _BATCH_FRAMES, len(uv))), _BATCH_FRAMES
        )
        batch = jax.tree.map(lambda a: jnp.asarray(a[rows], dtype), (uv, sigma, lifted))
        parts.append(_descend(scene, limit, *batch))
    return jax.tree.map(lambda *p: np.concatenate(p)[: len(uv)], *parts)


@eqx.filter_jit
def _descend(
    scene: Scene,
    steps: Int[Array, ""],
    uv: Float[Array, "m 25 2"],
    sigma: Float[Array, "m 25"],
    lifted: Lifted,
) -> Fit:
    """Runs Levenberg--Marquardt from each of `m` initial postures, with the same number
    of steps for all."""
    fits = jax.vmap(first_fit, in_axes=(None, 0, 0, 0))(scene, uv, sigma, lifted)
    shape = jnp.zeros(NUM_SHAPE, uv.dtype)
    size = 6 + fits.latent.shape[-1]
    prior = jnp.concatenate([jnp.zeros(6, uv.dtype), jnp.ones(size - 6, uv.dtype)])

    def evaluate(fit: Fit, *measurements: Any) -> tuple[Array, Array, Array]:
        normal = linearise(scene, fit, shape, *measurements)
        return (
            normal.hessian + jnp.diag(prior),
            normal.gradient.at[6:].add(fit.latent),
            normal.cost + 0.5 * jnp.sum(fit.latent**2),
        )

    def propose(fit: Fit, normal: tuple, damping: Array) -> Fit:
        hessian, gradient, _ = normal
        hessian = hessian + jnp.diag(damping * jnp.diagonal(hessian) + 1e-6)
        factor = jax.scipy.linalg.cho_factor(hessian)
        return fit.moved(-jax.scipy.linalg.cho_solve(factor, gradient))

    def step(_: Array, carry: tuple) -> tuple:
        fits, normal, damping = carry
        proposal = jax.vmap(propose)(fits, normal, damping)
        found = jax.vmap(evaluate)(proposal, uv, sigma, lifted)
        better = found[2] < normal[2]
        choose = lambda a, b: jnp.where(better.reshape(-1, *[1] * (a.ndim - 1)), a, b)
        fits, normal = jax.tree.map(choose, (proposal, found), (fits, normal))
        return fits, normal, jnp.where(better, damping / 5, damping * 5)

    # The first step is always accepted, because its cost is compared with infinity.
    blank = (
        jnp.tile(jnp.eye(size, dtype=uv.dtype), (len(uv), 1, 1)),
        jnp.zeros((len(uv), size), uv.dtype),
        jnp.full(len(uv), jnp.inf, uv.dtype),
    )
    carry = (fits, blank, jnp.full(len(uv), 0.5, uv.dtype))
    return jax.lax.fori_loop(0, steps + 1, step, carry)[0]


def first_fit(
    scene: Scene,
    uv: Float[Array, "25 2"],
    sigma: Float[Array, " 25"],
    lifted: Lifted,
) -> Fit:
    """Returns the lifted posture, placed by the keypoints."""
    shape = jnp.zeros(NUM_SHAPE, uv.dtype)
    angles = scene.prior.angles(lifted.latent)
    _, points = place_points(scene.skeleton, angles, shape)
    rays = unproject(scene.intrinsics, uv)
    position = _place(points @ lifted.orientation.T, rays, sigma)
    return Fit(lifted.orientation, position, lifted.latent)


def _place(
    points: Float[Array, "25 3"], rays: Float[Array, "25 3"], sigma: Float[Array, " 25"]
) -> Float[Array, " 3"]:
    """Returns the translation that best puts points on rays, by linear least
    squares."""
    weight = 1 / sigma**2
    weight = weight / jnp.maximum(jnp.max(weight), jnp.finfo(weight.dtype).tiny)
    x, y = rays[:, 0], rays[:, 1]
    one, zero = jnp.ones_like(x), jnp.zeros_like(x)
    rows = jnp.concatenate(
        [jnp.stack([one, zero, -x], 1), jnp.stack([zero, one, -y], 1)]
    )
    right = jnp.concatenate(
        [x * points[:, 2] - points[:, 0], y * points[:, 2] - points[:, 1]]
    )
    weight = jnp.concatenate([weight, weight])
    normal = (rows * weight[:, None]).T @ rows + 1e-9 * jnp.eye(3, dtype=x.dtype)
    found = jnp.linalg.solve(normal, rows.T @ (weight * right))
    # A negative or tiny depth means points that no body in this posture has.
    depth = jnp.maximum(found[2], 2 * MIN_DEPTH_M)
    return jnp.where(found[2] < depth, depth * rays[8], found)
