"""Fits of single frames from many initial values.

The heading and the order of limbs in depth are ambiguous in one view, and the cost has
several local minima. So every few frames the body is fitted from each of eight headings
with a few typical postures, and from the lifted posture (`lift`); `hypotheses` chooses
the sequence among the minima.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bodyslam_jax.geometry import so3
from bodyslam_jax.geometry.camera import unproject
from bodyslam_jax.people.costs import (
    DEPTH_FLOOR,
    Fit,
    Lifted,
    Scene,
    cost,
    joints_about_pelvis,
    linearise,
)
from bodyslam_jax.people.skeleton import NUM_SHAPE, place_points

NUM_HEADINGS = 8
_POSTURES_PER_HEADING = 2
_KEPT = 6
_SAME = 0.06
"""m, root mean square of joints: fits that are closer are the same minimum."""
_FIRST_STEPS, _LAST_STEPS = 5, 10
_FRAME_BATCH, _DESCENT_BATCH = 32, 256


def fit_frames(
    scene: Scene,
    uv: Float[np.ndarray, "f 25 2"],
    sigma: Float[np.ndarray, "f 25"],
    lifted: Lifted,
) -> tuple[Fit, Float[np.ndarray, "f s"], Float[np.ndarray, "f s 24 3"]]:
    """Fits each frame by itself, β = 0, from all starts; the best few ends of each.

    **Returns:** the fits with leading axes (frame, start), their costs, and their
    joints relative to the pelvis, in C; NumPy.
    """
    frames = len(uv)
    starts, value = _batched(_all_starts, _FRAME_BATCH, scene, uv, sigma, lifted)
    # The best postures of every heading: diversity where it matters; and the guess.
    by_heading = value[:, :-1].reshape(frames, NUM_HEADINGS, -1)
    best = np.argsort(by_heading, axis=2)[..., :_POSTURES_PER_HEADING]
    best = best + by_heading.shape[2] * np.arange(NUM_HEADINGS)[:, None]
    guess = np.full((frames, 1), value.shape[1] - 1)
    fits = _take(starts, np.concatenate([best.reshape(frames, -1), guess], axis=1))
    for steps, same in ((_FIRST_STEPS, 2 * _SAME), (_LAST_STEPS, _SAME)):
        count = fits.latent.shape[1]
        flat = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), fits)
        repeated = jax.tree.map(
            lambda a: np.repeat(a, count, axis=0), (uv, sigma, lifted)
        )
        limit = jnp.asarray(steps)
        flat, value, joints = _batched(
            _descend, _DESCENT_BATCH, (scene, limit), flat, *repeated
        )
        fits = jax.tree.map(lambda a: a.reshape(frames, count, *a.shape[1:]), flat)
        value, joints = (
            a.reshape(frames, count, *a.shape[1:]) for a in (value, joints)
        )
        chosen = _best_distinct(value, joints, same)
        fits, value, joints = _take((fits, value, joints), chosen)
    return fits, value, joints


def _best_distinct(
    value: Float[np.ndarray, "f n"], joints: Float[np.ndarray, "f n 24 3"], same: float
) -> Int[np.ndarray, "f s"]:
    """The best distinct minima of each frame, cheapest first, repeated if there are
    fewer than wanted."""
    row = np.arange(len(value))
    chosen = []
    again = np.zeros(value.shape, int)  # how often an end like this has been chosen
    for _ in range(_KEPT):
        best = np.lexsort((value, again), axis=1)[:, 0]
        away = np.mean(np.sum((joints - joints[row, best][:, None]) ** 2, -1), -1)
        again = again + (away < same**2)
        again[row, best] = _KEPT + 1
        chosen.append(best)
    order = np.stack(chosen, axis=1)
    cheapest = np.argsort(np.take_along_axis(value, order, axis=1), axis=1)
    return np.take_along_axis(order, cheapest, axis=1)


def _batched(function: Callable[..., Any], size: int, shared: Any, *rows: Any) -> Any:
    """`function(shared, *rows)` on `size` rows at a time, the last batch filled up: one
    shape to compile, whatever the number of frames."""
    total = len(jax.tree.leaves(rows)[0])
    dtype = jax.tree.leaves(shared)[0].dtype
    parts = []
    for first in range(0, total, size):
        index = np.resize(np.arange(first, min(first + size, total)), size)
        batch = jax.tree.map(lambda a: jnp.asarray(a[index], dtype), rows)
        parts.append(jax.tree.map(np.asarray, function(shared, *batch)))
    return jax.tree.map(lambda *p: np.concatenate(p)[:total], *parts)


def _take(tree: Any, index: Int[np.ndarray, "f s"]) -> Any:
    """Rows `index[f]` of every frame f."""
    return jax.tree.map(lambda a: a[np.arange(len(index))[:, None], index], tree)


@eqx.filter_jit
def _all_starts(
    scene: Scene,
    uv: Float[Array, "f 25 2"],
    sigma: Float[Array, "f 25"],
    lifted: Lifted,
) -> tuple[Fit, Float[Array, "f s"]]:
    """All starts of each frame and their costs."""

    def one(uv: Array, sigma: Array, lifted: Lifted) -> tuple[Fit, Array]:
        starts = _frame_starts(scene, uv, sigma, lifted)
        shape = jnp.zeros(NUM_SHAPE, uv.dtype)
        value = jax.vmap(lambda fit: cost(scene, fit, shape, uv, sigma, lifted))(starts)
        return starts, value + 0.5 * jnp.sum(starts.latent**2, -1)

    return jax.vmap(one)(uv, sigma, lifted)


def _frame_starts(
    scene: Scene,
    uv: Float[Array, "25 2"],
    sigma: Float[Array, " 25"],
    lifted: Lifted,
) -> Fit:
    """Every heading with every typical posture, placed by the keypoints; the last is
    the lifted posture."""
    dtype = uv.dtype
    angles = jnp.arange(NUM_HEADINGS, dtype=dtype) * (2 * jnp.pi / NUM_HEADINGS)
    # Upright before the camera, facing it: H's y up is C's y down.
    facing = jnp.diag(jnp.array([1.0, -1.0, -1.0], dtype))
    turned = so3.exp(angles[:, None] * jnp.array([0.0, 1.0, 0.0], dtype))
    orientation = jnp.concatenate(
        [_roll(uv, sigma) @ facing @ turned, lifted.orientation[None]]
    )
    latent = jnp.concatenate([scene.prior.typical, lifted.latent[None]])
    shape = jnp.zeros(NUM_SHAPE, dtype)
    local = jax.vmap(
        lambda z: place_points(scene.skeleton, scene.prior.angles(z), shape)[1]
    )(latent)
    count = len(scene.prior.typical)
    heading = np.append(np.repeat(np.arange(NUM_HEADINGS), count), NUM_HEADINGS)
    posture = np.append(np.tile(np.arange(count), NUM_HEADINGS), count)
    orientation, latent = orientation[heading], latent[posture]
    rotated = jnp.einsum("sij,skj->ski", orientation, local[posture])
    rays = unproject(scene.intrinsics, uv)
    position = jax.vmap(lambda x: _place(x, rays, sigma))(rotated)
    return Fit(orientation, position, latent)


def _roll(uv: Array, sigma: Array) -> Float[Array, "3 3"]:
    """Turn about the optical axis, for who is lying or upside down: from the torso's
    direction if it is more than 60 degrees from upright, none otherwise."""
    torso = uv[1] - uv[8]
    detected = (sigma[1] < jnp.inf) & (sigma[8] < jnp.inf)
    safe = jnp.where(detected, torso, jnp.array([0.0, -1.0], torso.dtype))
    angle = jnp.arctan2(safe[0], -safe[1])
    angle = jnp.where(jnp.abs(angle) > jnp.pi / 3, angle, 0.0)
    return so3.exp(angle * jnp.array([0.0, 0.0, 1.0], angle.dtype))


def _place(
    points: Float[Array, "25 3"], rays: Float[Array, "25 3"], sigma: Float[Array, " 25"]
) -> Float[Array, " 3"]:
    """The translation that puts points on rays best, by linear least squares."""
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
    # A negative or tiny depth means points that no body of this posture makes.
    depth = jnp.maximum(found[2], 2 * DEPTH_FLOOR)
    return jnp.where(found[2] < depth, depth * rays[8], found)


@eqx.filter_jit
def _descend(
    shared: tuple[Scene, Int[Array, ""]],
    fits: Fit,
    uv: Float[Array, "m 25 2"],
    sigma: Float[Array, "m 25"],
    lifted: Lifted,
) -> tuple[Fit, Float[Array, " m"], Float[Array, "m 24 3"]]:
    """Levenberg--Marquardt on each of `m` fits, all the same number of steps.

    **Returns:** the fits, their costs, and their joints about the pelvis, in C.
    """
    scene, steps = shared
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

    # The first normal equations are those of a step that is always accepted.
    blank = (
        jnp.tile(jnp.eye(size, dtype=uv.dtype), (len(uv), 1, 1)),
        jnp.zeros((len(uv), size), uv.dtype),
        jnp.full(len(uv), jnp.inf, uv.dtype),
    )
    carry = (fits, blank, jnp.full(len(uv), 0.5, uv.dtype))
    fits, normal, _ = jax.lax.fori_loop(0, steps + 1, step, carry)
    joints = jax.vmap(joints_about_pelvis, in_axes=(None, 0, None))(scene, fits, shape)
    return fits, normal[2], joints
