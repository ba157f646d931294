"""Operations on joint problems and states: without map, rescaled, stacked."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax import graph


def rebuild(
    problem: graph.Problem,
    state: graph.State,
    factors: list[graph.Factor],
    free: graph.Step | None = None,
) -> graph.Problem:
    """Returns a problem with other `factors` and the motion predictor of this one."""
    return graph.make_problem(
        factors,
        state,
        motion=problem.motion,
        free=free or problem.free,
        named=problem.globals,
    )


def without_map(
    problem: graph.Problem, state: graph.State, *, hold_cameras: bool
) -> tuple[graph.Problem, graph.State]:
    """Returns the problem without landmarks, their factors, and ground contact, which
    depends on them; with `hold_cameras` the cameras move through s only.

    Section 4.2 of the paper: people alone determine scale or cameras.
    """
    bare = eqx.tree_at(lambda s: s.landmarks, state, state.landmarks[:0])
    free = dataclasses.replace(problem.free, landmarks=problem.free.landmarks[:0])
    if hold_cameras:
        free = graph.set_constant(free, "cameras")
    of_map = (graph.Reprojection, graph.LandmarkPrior, graph.GroundContact)
    kept = [f for f in problem.factors if not isinstance(f, of_map)]
    return rebuild(problem, bare, kept, free), bare


def with_scale(state: graph.State, scale: Float[Array, ""] | float) -> graph.State:
    """Returns the state with scale s replaced."""
    return eqx.tree_at(lambda s: s.scale, state, jnp.asarray(scale, state.scale.dtype))


def stacked(states: list[graph.State]) -> graph.State:
    """Returns states of equal shapes stacked along a new leading axis."""
    return jax.tree.map(lambda *x: jnp.stack(x), *states)
