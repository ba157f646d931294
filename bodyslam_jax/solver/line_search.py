"""Line search along a step, on the true robust cost.

A trial rejects the updates of landmarks whose cost they would increase, so that a few
bad points do not hold up the step of all others.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from bodyslam_jax.graph import Problem, Reprojection, State
from bodyslam_jax.solver.retriangulation import cost_by_landmark, tracks_of


def search(problem, state, move, slope, predicted, terms):
    """Evaluates the full step and the minimum of a parabola through its cost.

    Robust losses have more curvature than `J^T J`, so that full steps overshoot to and
    fro. The second evaluation costs a few per cent of an iteration. Returns the better
    state, which landmarks rejected their update, the share of the step, the cost by
    factor there, and actual over predicted decrease of the full step.
    """
    known = jnp.sum(terms)

    def one(carry, _):
        share, place, rejected, best, best_terms, full = carry
        moved = state.retract(jax.tree.map(lambda x: share * x, move))
        moved, off, new = _settle(problem, state, moved)
        cost = jnp.sum(new)
        cost = jnp.where(jnp.isfinite(cost), cost, jnp.inf)
        better = cost < jnp.sum(best_terms)
        best = jnp.where(better, share, best)
        best_terms = jnp.where(better, new, best_terms)
        place = jax.tree.map(lambda a, b: jnp.where(better, a, b), moved, place)
        rejected = jnp.where(better, off, rejected)
        full = jnp.where(jnp.isnan(full), cost, full)
        # cost(a) = known - slope a + bend a^2, through the full step
        bend = full - known + slope
        vertex = slope / jnp.where(bend > 0, 2 * bend, 1.0)
        vertex = jnp.where(bend > 0, vertex, 2.0)
        share = jnp.clip(vertex, 0.1, 2.0)
        return (share, place, rejected, best, best_terms, full), None

    one_ = jnp.ones_like(known)
    none = jnp.zeros(len(state.landmarks), bool)
    start = (one_, state, none, one_, terms, jnp.nan * one_)
    found, _ = jax.lax.scan(one, start, length=2)
    _, place, rejected, best, best_terms, full = found
    gain = (known - full) / jnp.where(predicted > 0, predicted, 1.0)
    return place, rejected, best, best_terms, jnp.clip(gain, -1.0, 2.0)


def _settle(
    problem: Problem, state: State, moved: State
) -> tuple[State, Bool[Array, " l"], Float[Array, " k"]]:
    """Returns the moved state without those updates of landmarks that increase their
    cost, the mask of these landmarks, and the cost by factor.

    A point that few frames see, or that an outlier pulls, may be sent behind the
    cameras. Given the cameras, landmarks are independent: rejecting one does not affect
    the step of the others.
    """
    tracks = tracks_of(problem)
    keep = jnp.zeros(len(state.landmarks), bool)
    of_tracks = jnp.zeros_like(state.scale)
    if tracks is not None:
        # One `vmap` over both, so that cameras are gathered once for all observations.
        both = jnp.stack([state.landmarks, moved.landmarks])
        at = lambda x: eqx.tree_at(lambda s: s.landmarks, moved, x)
        found = jax.vmap(lambda x: cost_by_landmark(problem, tracks, at(x)))(both)
        here, there = zip(*found, strict=True)
        keep = ~(there[0] + there[1] <= here[0] + here[1])
        landmarks = jnp.where(keep[:, None], state.landmarks, moved.landmarks)
        moved = eqx.tree_at(lambda s: s.landmarks, moved, landmarks)
        of_tracks = 0.5 * jnp.sum(jnp.where(keep, here[0], there[0]))
    costs = [
        of_tracks if isinstance(f, Reprojection) else f.cost(moved)
        for f in problem.factors
    ]
    return moved, keep, jnp.stack(costs)
