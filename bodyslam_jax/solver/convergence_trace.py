"""Solves that record a function of the state after each iteration."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

from bodyslam_jax.geometry.lengths import is_traced
from bodyslam_jax.graph import Problem, State
from bodyslam_jax.solver.batching import sequential_vmap
from bodyslam_jax.solver.compilation import in_full_precision
from bodyslam_jax.solver.levenberg_marquardt import lifted
from bodyslam_jax.solver.padding import pad, unpad
from bodyslam_jax.solver.solve import (
    Stage,
    check_schedule,
    check_start,
    is_mixed,
    method_of,
    restrict,
)


def trace(
    problem: Problem,
    state: State,
    observe: Callable[[State], Any],
    *,
    schedule: tuple[Stage, ...] = (Stage(),),
    damping: float = 1e-4,
    mixed_precision: bool | None = None,
) -> tuple[State, Any]:
    """Runs each stage for all of its `max_steps` and notes `observe(state)` each time.

    The steps are those of `solve`; after convergence the state stays. Returns the last
    state and the notes, of `1 + Σ max_steps` rows: the first state's, then one an
    iteration. Pure; costs the same whatever the states are; maps as `solve` does.

    **Raises:** `ValueError` as `solve`.
    """
    _check(problem, state, schedule, damping)
    settings = observe, schedule, damping, is_mixed(mixed_precision, state)
    watched = lambda problem, state: _trace(problem, state, *settings)
    return (sequential_vmap(watched) if is_traced(state) else watched)(problem, state)


def _check(problem, state, schedule, damping):
    check_schedule("structured", schedule)
    check_start(problem, state, damping)


def _trace(problem, state, observe, schedule, damping, mixed):
    t, l = len(state.cameras), len(state.landmarks)
    problem, state = pad(problem, state)
    see = lambda y: observe(unpad(y, t, l))
    notes = [jax.tree.map(lambda x: x[None], see(state))]
    for stage in schedule:
        held = restrict(problem, stage.free)
        state, seen = _stage(held, state, see, stage, damping, mixed)
        notes.append(seen)
    joined = jax.tree.map(lambda *x: jnp.concatenate(x), *notes)
    return unpad(state, t, l), joined


@in_full_precision
def _stage(problem, state, see, stage, damping, mixed):
    method = method_of((stage,), damping, state.scale.dtype, mixed=mixed)
    start = method.init(_residuals, state, problem, {}, None, None, frozenset())
    arrays, static = eqx.partition(start, eqx.is_array)

    def one(carry, _):
        y, arrays, stopped = carry
        loop = eqx.combine(arrays, static)
        moved, following, _ = method.step(_residuals, y, problem, {}, loop, frozenset())
        keep = lambda new, old: jnp.where(stopped, old, new)
        y = jax.tree.map(keep, moved, y)
        after = jax.tree.map(keep, eqx.filter(following, eqx.is_array), arrays)
        done, result = method.terminate(
            _residuals, y, problem, {}, eqx.combine(after, static), frozenset()
        )
        ended = stopped | done | (result != optx.RESULTS.successful)
        return (y, after, ended), see(y)

    carry = state, arrays, jnp.array(False)
    (state, _, _), seen = jax.lax.scan(one, carry, length=stage.max_steps)
    return state, seen


def _residuals(state, problem):
    """Returns residuals and no auxiliary output, the signature optimistix expects."""
    return lifted(state, problem), None
