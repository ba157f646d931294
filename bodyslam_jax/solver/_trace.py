"""A solve that is watched: what it is asked for, after every iteration."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx

from bodyslam_jax.graph import Problem, State
from bodyslam_jax.solver._levenberg_marquardt import lifted
from bodyslam_jax.solver._padding import pad, unpad
from bodyslam_jax.solver._solve import Stage, method_of, restrict


def trace(
    problem: Problem,
    state: State,
    observe: Callable[[State], Any],
    *,
    schedule: tuple[Stage, ...] = (Stage(),),
    damping: float = 1e-4,
) -> tuple[State, Any]:
    """Runs each stage for all of its `max_steps` and notes `observe(state)` each time.

    The steps are those of `solve`; after convergence the state stays. Returns the last
    state and the notes, of `1 + Σ max_steps` rows: the first state's, then one an
    iteration. Pure; mapped over states, it costs the same whatever they are.
    """
    t, l = len(state.cameras), len(state.landmarks)
    problem, state = pad(problem, state)
    see = lambda y: observe(unpad(y, t, l))
    notes = [jax.tree.map(lambda x: x[None], see(state))]
    for stage in schedule:
        state, seen = _stage(restrict(problem, stage.free), state, see, stage, damping)
        notes.append(seen)
    joined = jax.tree.map(lambda *x: jnp.concatenate(x), *notes)
    return unpad(state, t, l), joined


def _stage(problem, state, see, stage, damping):
    method = method_of((stage,), damping, state.scale.dtype)
    start = method.init(lifted, state, problem, {}, None, None, frozenset())
    arrays, static = eqx.partition(start, eqx.is_array)

    def one(carry, _):
        y, arrays, stopped = carry
        loop = eqx.combine(arrays, static)
        moved, following, _ = method.step(lifted, y, problem, {}, loop, frozenset())
        keep = lambda new, old: jnp.where(stopped, old, new)
        y = jax.tree.map(keep, moved, y)
        after = jax.tree.map(keep, eqx.filter(following, eqx.is_array), arrays)
        done, result = method.terminate(
            lifted, y, problem, {}, eqx.combine(after, static), frozenset()
        )
        ended = stopped | done | (result != optx.RESULTS.successful)
        return (y, after, ended), see(y)

    carry = state, arrays, jnp.array(False)
    (state, _, _), seen = jax.lax.scan(one, carry, length=stage.max_steps)
    return state, seen
