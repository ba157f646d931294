"""`solve`: a problem and a first state in, the best state and how it was found out."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from bodyslam_jax.compilation import is_alone, is_traced, quick_options
from bodyslam_jax.graph import VARIABLES, Problem, State
from bodyslam_jax.kept import kept
from bodyslam_jax.solver import _baselines
from bodyslam_jax.solver._implicit import cotangent_of_problem
from bodyslam_jax.solver._levenberg_marquardt import (
    StructuredLevenbergMarquardt,
    lifted,
)
from bodyslam_jax.solver._loop import Final, History
from bodyslam_jax.solver._mapping import in_turn
from bodyslam_jax.solver._padding import pad, unpad

Solver = Literal["structured", "optimistix", "jaxopt_lm", "jaxopt_gn", "adam"]


@dataclasses.dataclass(frozen=True)
class Stage:
    """One run of the solver with some groups of variables free."""

    free: tuple[str, ...] = VARIABLES
    """Among the fields of `State`; what the problem holds stays held."""
    max_steps: int = 50
    rtol: float = 1e-8
    """Relative decrease of the cost at which to stop."""
    atol: float = 0.0
    """The same in units of the cost: a half is what a standard deviation is worth."""


PAPER_SCHEDULE = (
    Stage(("scale", "cameras", "roots", "landmarks"), max_steps=20, rtol=1e-4),
    Stage(),
)
"""Section 3.6: first where cameras and people are, then everything."""


HISTORY = 64
"""The length of a history is a multiple of this: schedules share a compilation."""


class Solution(eqx.Module):
    """The best state found. What failed says so in `status`; a state is never NaN."""

    state: State
    result: optx.RESULTS
    cost: Float[Array, ""]
    """Negative log-likelihood at `state`."""
    histories: tuple[History, ...]
    """Of each stage."""
    num_steps: tuple[Array, ...]
    """Iterations of each stage, accepted or not."""
    first_cost: Float[Array, ""]
    """Negative log-likelihood at the start, with the motion predicted there."""

    @property
    def status(self) -> str:
        """`converged`, or what kept it from that."""
        if self.result == optx.RESULTS.successful:
            return "converged"
        if self.result == optx.RESULTS.nonlinear_max_steps_reached:
            return "ran out of steps"
        if self.result == optx.RESULTS.nonfinite:
            return "cost is not finite"
        return "no step lowers the cost"


def solve(
    problem: Problem,
    state: State,
    *,
    solver: Solver = "structured",
    schedule: tuple[Stage, ...] = (Stage(),),
    damping: float = 1e-4,
) -> Solution:
    """Minimises the cost of a problem from a first state.

    `structured` is the solver for real videos; the others are baselines for small
    problems. Pure: jits, differentiates with respect to everything in `problem`, and
    maps over problems or states of one shape: one after another on a CPU, which is no
    slower there, at once elsewhere; `over_devices` gives each device a share. Threads
    may solve at the same time.

    **Raises:** `ValueError` if `state` does not have the sizes the problem was made
    for. Failure to converge is a `status`.
    """
    expected = problem.free.cameras.shape[0], problem.free.landmarks.shape[0]
    found = state.cameras.shape[0], state.landmarks.shape[0]
    if found != expected:
        raise ValueError(
            f"state: {found[0]} frames and {found[1]} landmarks, expected "
            f"{expected[0]} and {expected[1]} as in the problem."
        )
    if solver != "structured":
        return _solve_baseline(problem, state, solver, schedule)
    padded, start = pad(problem, state)
    solution = _differentiable(padded, start, schedule, damping, is_alone())
    return eqx.tree_at(
        lambda s: s.state,
        solution,
        unpad(solution.state, *found),
    )


def method_of(
    schedule: tuple[Stage, ...], damping: float, dtype, *, keep: bool = False
) -> StructuredLevenbergMarquardt:
    """The solver of a schedule: of two stages at least, of which one may be idle, so
    that one stage, two, and none (for covariances) are the same program."""
    idle = Stage(max_steps=0)
    stages = (*schedule, *(idle,) * (2 - len(schedule)))
    longest = max(stage.max_steps for stage in stages)
    return StructuredLevenbergMarquardt(
        free=jnp.asarray([[v in s.free for v in VARIABLES] for s in stages], dtype),
        limit=jnp.asarray([s.max_steps for s in stages]),
        rtol=jnp.asarray([s.rtol for s in stages], dtype),
        atol=jnp.asarray([s.atol for s in stages], dtype),
        damping=jnp.asarray(damping, dtype),
        keep=jnp.asarray(keep),
        length=HISTORY * max(1, -(-longest // HISTORY)),
    )


def run(
    problem: Problem,
    state: State,
    method: StructuredLevenbergMarquardt,
    *,
    alone: bool = False,
) -> tuple[Solution, Final]:
    """All stages on a padded problem, and the equations where they end.

    `alone` is what `is_alone()` said before anything was traced.
    """
    given = problem, state, method
    if is_traced(given):
        return in_turn(_program(False))(*given)
    return _program(alone)(*given)


@functools.cache
def _program(alone: bool) -> Callable[..., tuple[Solution, Final]]:
    return kept(_run, quick_options) if alone else eqx.filter_jit(_run)


def _run(problem, state, method):
    found = optx.least_squares(
        lifted, method, state, problem, max_steps=None, throw=False
    )
    return outcome(state, found.value, found.result, found.stats)


def outcome(start, best, result, stats) -> tuple[Solution, Final]:
    """What the loop leaves behind, as a solution; the start, if no cost was finite."""
    better = jnp.isfinite(stats["cost"])
    best = jax.tree.map(lambda new, old: jnp.where(better, new, old), best, start)
    stages = range(len(stats["steps"]))
    histories = tuple(jax.tree.map(lambda x: x[i], stats["history"]) for i in stages)
    counts = tuple(stats["steps"][i] for i in stages)
    solution = Solution(
        state=best,
        result=result,
        cost=stats["cost"],
        histories=histories,
        num_steps=counts,
        first_cost=stats["first_cost"],
    )
    return solution, stats["final"]


@eqx.filter_custom_vjp
def _differentiable(problem, state, schedule, damping, alone):
    return _solve(problem, state, schedule, damping, alone)


def _solve(problem, state, schedule, damping, alone):
    method = method_of(schedule, damping, state.scale.dtype)
    solution, _ = run(restrict_to_all(problem, schedule), state, method, alone=alone)
    return only(solution, len(schedule))


def only(solution: Solution, count: int) -> Solution:
    """Without the idle stages that make all schedules one program."""
    return dataclasses.replace(
        solution,
        histories=solution.histories[:count],
        num_steps=solution.num_steps[:count],
    )


@_differentiable.def_fwd
def _forward(perturbed, problem, state, schedule, damping, alone):
    solution = _solve(problem, state, schedule, damping, alone)
    return solution, solution.state


@_differentiable.def_bwd
def _backward(found, cotangent, perturbed, problem, state, schedule, damping, alone):
    arrive = cotangent.state
    full = jax.tree.map(
        lambda c, x: jnp.zeros_like(x) if c is None else c,
        arrive,
        found,
        is_leaf=lambda x: x is None,
    )
    now = restrict(problem, schedule[-1].free)
    given = cotangent_of_problem(now, found, full)
    if cotangent.cost is not None:
        # At a minimum the state's own share of the cost's derivative is 0.
        arrays, static = eqx.partition(problem, eqx.is_inexact_array)
        by_cost = jax.grad(lambda a: eqx.combine(a, static).refresh(found).cost(found))
        more = by_cost(arrays)
        given = jax.tree.map(lambda a, b: a + cotangent.cost * b, given, more)
    return given


def restrict(problem: Problem, free: tuple[str, ...]) -> Problem:
    """The same problem with only these groups free."""
    variables = tuple(name for name in problem.variables if name in free)
    return dataclasses.replace(problem, variables=variables)


def restrict_to_all(problem: Problem, schedule: tuple[Stage, ...]) -> Problem:
    """The same problem with only the groups free that some stage moves."""
    return restrict(problem, tuple(name for stage in schedule for name in stage.free))


def _solve_baseline(problem, state, solver, schedule):
    run, first = getattr(_baselines, solver), problem.follow(state).cost(state)
    counts = []
    result = optx.RESULTS.successful
    for stage in schedule:
        state, count, result = run(restrict(problem, stage.free), state, stage)
        counts.append(count)
    cost = problem.follow(state).cost(state)
    return Solution(state, result, cost, (), tuple(counts), first)
