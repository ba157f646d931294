"""Triangulates diverged landmarks anew.

While cameras are still wrong, a point may fit best at infinity, or very near, where its
cost is so flat that no step brings it back. Given the cameras, landmarks are
independent: a better position of one lowers the total cost.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.geometry.camera import unproject
from bodyslam_jax.graph import (
    LandmarkPrior,
    Problem,
    Reprojection,
    State,
    residual_of,
    squared_norm,
)

_NUM_PASSES = 5
"""Number of passes; weights follow from the pass before, at first all are 1."""
_MIN_RELATIVE_DEPTH = 0.1
"""Least depth that is divided by, as a share of that in the reference camera."""


def tracks_of(problem: Problem) -> Reprojection | None:
    """Returns the factor of landmark observations, if there is one."""
    return next((f for f in problem.factors if isinstance(f, Reprojection)), None)


def cost_by_landmark(
    problem: Problem, tracks: Reprojection, state: State
) -> tuple[Float[Array, " l"], Float[Array, " l"]]:
    """Returns twice the cost of each landmark's observations, and of its priors."""
    rho = lambda f: f.loss.rho(squared_norm(residual_of(f, state)))
    none = jnp.zeros(len(state.landmarks), state.scale.dtype)
    known = none
    for factor in problem.factors:
        if isinstance(factor, LandmarkPrior):
            known = known + rho(factor)
    return none.at[tracks.landmark].add(rho(tracks)), known


def triangulate_anew(
    problem: Problem,
    state: State,
    terms: Float[Array, " k"],
    least: float | Float[Array, ""],
) -> tuple[State, Float[Array, " k"]]:
    """Triangulates all landmarks from their observations, and moves those that fit
    better there; returns the state and its cost by factor.

    Args:
        terms: cost by factor at `state`.
        least: least decrease of a landmark's cost for which it is moved.
    """
    tracks = tracks_of(problem)
    if tracks is None:
        return state, terms
    at = lambda x: eqx.tree_at(lambda s: s.landmarks, state, x)
    free = (problem.free.landmarks > 0).all(axis=-1)
    reference = jnp.zeros(len(state.landmarks), tracks.frame.dtype)
    reference = state.cameras[reference.at[tracks.landmark].max(tracks.frame)]
    rows = _sightings(tracks, state, reference[tracks.landmark])
    first = cost_by_landmark(problem, tracks, state)

    def once(carry, _):
        weight, place, best = carry
        found, known = _meeting(rows, weight, tracks.landmark, len(place))
        depth = 1 / jnp.where(known, found[:, 2], 1.0)
        ray = depth[:, None] * found.at[:, 2].set(1.0)
        moved = reference[:, :3, 3] + jnp.einsum(
            "lij,lj->li", reference[:, :3, :3], ray
        )
        moved = jnp.where(known[:, None], moved, state.landmarks)
        costs = cost_by_landmark(problem, tracks, at(moved))
        better = free & (sum(costs) < jnp.minimum(sum(best), sum(first) - 2 * least))
        place = jnp.where(better[:, None], moved, place)
        best = tuple(jnp.where(better, a, b) for a, b in zip(costs, best, strict=True))
        return (_weight(rows, found[tracks.landmark], tracks, state), place, best), None

    alike = jnp.isfinite(tracks.sigma).astype(state.scale.dtype)
    start = (alike, state.landmarks, first)
    (_, place, best), _ = jax.lax.scan(once, start, length=_NUM_PASSES)
    costs = {
        Reprojection: 0.5 * jnp.sum(best[0]),
        LandmarkPrior: 0.5 * jnp.sum(best[1]),
    }
    new = [
        costs[type(f)] if type(f) in costs else old
        for f, old in zip(problem.factors, terms, strict=True)
    ]
    return at(place), jnp.stack(new)


def _sightings(tracks, state, reference):
    """Returns the matrix `A` and the ray `(u, v, 1)` of each observation, such that a
    landmark at `(a, b, 1) / ρ` in its reference camera has `A (a, b, ρ, 1)` along the
    ray."""
    camera = state.cameras[tracks.frame]
    ray = unproject(state.intrinsics, tracks.pixel)
    turned = jnp.einsum("mki,mkj->mij", camera[:, :3, :3], reference[:, :3, :3])
    away = reference[:, :3, 3] - camera[:, :3, 3]
    shift = jnp.einsum("mki,mk->mi", camera[:, :3, :3], away)
    parts = [turned[:, :, :2], shift[:, :, None], turned[:, :, 2:]]
    return jnp.concatenate(parts, axis=-1), ray


def _meeting(rows, weight, landmark, count):
    """Returns the least-squares `(a, b, ρ)` of each landmark, and whether such a point
    exists in front of the reference camera.

    In inverse depth the estimate has no bias towards the cameras, unlike the point of
    closest approach of the rays.
    """
    seen, ray = rows
    sums = 0.0
    for i in range(2):
        x, y, z, rest = (seen[:, i, j] - ray[:, i] * seen[:, 2, j] for j in range(4))
        products = [x * x, x * y, x * z, y * y, y * z, z * z, -x * rest, -y * rest]
        sums = sums + jnp.stack([*products, -z * rest], axis=-1)
    sums = jnp.zeros((count, 9), seen.dtype).at[landmark].add(weight[:, None] * sums)
    xx, xy, xz, yy, yz, zz, *right = (sums[:, i] for i in range(9))
    stack = lambda *x: jnp.stack(x, axis=-1)
    first, second, third = stack(xx, xy, xz), stack(xy, yy, yz), stack(xz, yz, zz)
    b = stack(*right)
    dot = lambda u, v: jnp.sum(u * v, axis=-1)
    normal = jnp.cross(second, third)
    volume = dot(first, normal)
    known = volume > 100 * jnp.finfo(seen.dtype).eps * xx * yy * zz
    found = stack(
        dot(b, normal),
        dot(first, jnp.cross(b, third)),
        dot(first, jnp.cross(second, b)),
    )
    found = found / jnp.where(known, volume, 1.0)[:, None]
    return found, known & (found[:, 2] > 0)


def _weight(rows, found, tracks, state):
    """Returns weights that turn algebraic squares into squared pixel errors, and into
    absolute ones above one sigma, so that one outlier does not carry a point away."""
    seen, ray = rows
    p_C = jnp.einsum("mij,mj->mi", seen[..., :3], found) + seen[..., 3]
    depth = jnp.where(
        jnp.abs(p_C[:, 2]) > _MIN_RELATIVE_DEPTH, p_C[:, 2], _MIN_RELATIVE_DEPTH
    )
    sigma = tracks.sigma / jnp.mean(state.intrinsics[:2])
    error = squared_norm(p_C[:, :2] / depth[:, None] - ray[:, :2]) / sigma**2
    return 1 / (sigma**2 * depth**2 * jnp.sqrt(jnp.maximum(error, 1.0)))
