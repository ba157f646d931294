"""`solve` minimises the cost of a problem from a first state.

It is given a solver by its name, and a schedule of stages (`Stage`), each of which says
which variables are free.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx

from bodyslam_jax.geometry.lengths import is_alone, is_traced
from bodyslam_jax.graph import VARIABLES, Problem, State, check_state
from bodyslam_jax.solver import baselines
from bodyslam_jax.solver.batching import sequential_vmap
from bodyslam_jax.solver.compilation import (
    compiled,
    in_full_precision,
    rejoin_bodies,
    separate_bodies,
)
from bodyslam_jax.solver.implicit import cotangent_of_problem
from bodyslam_jax.solver.levenberg_marquardt import (
    Final,
    StructuredLevenbergMarquardt,
    lifted,
)
from bodyslam_jax.solver.padding import pad, unpad
from bodyslam_jax.solver.solution import Solution, only, outcome

HISTORY_LENGTH_UNIT = 64
"""Number of rows of a history is a multiple of this: schedules share a compilation."""
MIN_MIXED_FRAMES = 61
"""Number of frames from which on the steps of a problem without people are found in
single precision by default: below, they take milliseconds. It is just above a common
size (`geometry/lengths.py`), so that no size has two programs."""
Solver = Literal["structured", "adam", "optimistix_lm", "jaxopt_lm"]


@dataclasses.dataclass(frozen=True)
class Stage:
    """One run of the solver with some groups of variables free."""

    free: tuple[str, ...] = VARIABLES
    """Groups among the fields of `State`; what the problem holds stays held."""
    max_steps: int = 50
    rtol: float = 1e-8
    """Relative decrease of the cost below which the stage ends."""
    atol: float = 0.0
    """Absolute decrease likewise; a residual of one standard deviation costs a half."""

    def __post_init__(self):
        check_names(self.free)
        if self.max_steps < 0:
            raise ValueError(f"max_steps: {self.max_steps}, expected 0 or more.")
        for name in ("rtol", "atol"):
            # This refuses NaN as well.
            if not getattr(self, name) >= 0:
                found = getattr(self, name)
                raise ValueError(f"{name}: {found}, expected 0 or more.")


def check_names(free: Iterable[str]) -> None:
    if isinstance(free, str):
        raise ValueError(f"free: found {free!r}, expected a tuple of names.")
    unknown = sorted(set(free) - set(VARIABLES))
    if unknown:
        raise ValueError(f"free: {unknown}, expected names among {list(VARIABLES)}.")


def solve(
    problem: Problem,
    state: State,
    *,
    solver: Solver = "structured",
    schedule: tuple[Stage, ...] = (Stage(),),
    damping: float = 1e-4,
    mixed_precision: bool | None = None,
) -> Solution:
    """Minimises the cost of a problem from a first state.

    - `solver`: `structured` is the one for real videos. `adam` takes first-order steps,
      as many as a stage has. `optimistix_lm` and `jaxopt_lm` are dense
      Levenberg-Marquardt, for small problems: larger ones are refused.
    - `schedule`: stages one after another, each with its free variables, maximum number
      of steps and tolerances; `PAPER_SCHEDULE` is the paper's.
    - `damping`: Marquardt's damping of the first step of each stage, as a share of the
      diagonal of `J^T J`; later steps adapt it. Near convergence the Hessian includes
      the second-order term Σ rᵢ ∇²rᵢ of the keypoint factors (`second_order.py`). 0 is
      Gauss-Newton: full steps of `J^T J`, as long as they lower the cost. Baselines
      have dampings of their own.
    - `mixed_precision`: `structured` solves for its steps in single precision, which
      takes two thirds to four fifths of the time; residuals, gradients, costs and
      landmarks' own blocks, and so the minimum, keep the precision of `state`. By
      default those without people, of more than 60 frames, do. Covariances are of
      factors in double precision, which is another program to compile.

    Pure: jits, differentiates, and maps over problems or states of one shape: one after
    another on a CPU, which is no slower there, at once elsewhere; `vmap_over_devices`
    gives each device a share. Threads may solve at the same time.

    `structured` differentiates `state` and `cost` with respect to all of `problem`, by
    the implicit function theorem; a solution does not depend on where it started. What
    the last stage holds counts as given, also where an earlier one moved it. The
    derivatives are NaN where their equations could not be solved.

    **Raises:** `ValueError` if `state` does not have the sizes and the precision the
    problem was made for, is not finite, or has poses that are not rigid, if there is no
    factor, or no stage that takes a step, if `damping` is negative, or if a baseline is
    to mix precisions. Failure to converge is a `status`, and so is what is not finite
    within `jit`.
    """
    check_schedule(solver, schedule)
    check_start(problem, state, damping)
    if solver != "structured":
        if mixed_precision:
            raise ValueError(f"mixed_precision: {solver} has one precision only.")
        baselines.check_size(solver, problem, state)
        return _solve_baseline(problem, state, solver, schedule)
    padded, start = pad(problem, jax.lax.stop_gradient(state))
    given = padded, start, schedule, damping, is_mixed(mixed_precision, state)
    solution = _differentiable(*given, is_alone())
    sizes = len(state.cameras), len(state.landmarks)
    return eqx.tree_at(lambda s: s.state, solution, unpad(solution.state, *sizes))


def is_mixed(mixed_precision: bool | None, state: State) -> bool:
    """Returns whether steps are found in single precision: as asked for, else without
    people from `MIN_MIXED_FRAMES` on."""
    if mixed_precision is not None:
        return mixed_precision
    return not len(state.roots) and len(state.cameras) >= MIN_MIXED_FRAMES


def check_start(problem: Problem, state: State, damping: float = 0.0) -> None:
    """Refuses a problem that measures nothing, and a state that does not fit.

    **Raises:** `ValueError` that says where, what was found and what was expected.
    """
    if not is_traced(damping) and not 0 <= damping < np.inf:
        raise ValueError(f"damping: {damping}, expected 0 or more, and finite.")
    if not problem.factors:
        raise ValueError("problem.factors: found none, expected one or more.")
    check_state(state, problem.free)


def method_of(
    schedule: tuple[Stage, ...],
    damping: float,
    dtype,
    *,
    keep: bool = False,
    mixed: bool = False,
) -> StructuredLevenbergMarquardt:
    """Returns the solver of a schedule, padded with idle stages to at least two, so
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
        length=HISTORY_LENGTH_UNIT * max(1, -(-longest // HISTORY_LENGTH_UNIT)),
        dtype=np.dtype(np.float32 if mixed else dtype),
    )


def run(
    problem: Problem,
    state: State,
    method: StructuredLevenbergMarquardt,
    *,
    alone: bool = False,
) -> tuple[Solution, Final]:
    """Runs all stages on a padded problem; returns the solution
    and the final equations.

    `alone` is the value of `is_alone()` before anything was traced.
    """
    given = *separate_bodies(problem), state, method
    if is_traced(given):
        return sequential_vmap(_program(False), _program(True))(*given)
    return _program(alone)(*given)


@functools.cache
def _program(alone: bool) -> Callable[..., tuple[Solution, Final]]:
    return compiled(_run) if alone else eqx.filter_jit(_run)


@in_full_precision
def _run(problem, bodies, state, method):
    problem = rejoin_bodies(problem, bodies)
    found = optx.least_squares(
        lifted, method, state, problem, max_steps=None, throw=False
    )
    return outcome(state, found.value, found.result, found.stats)


@eqx.filter_custom_vjp
def _differentiable(problem, state, schedule, damping, mixed, alone):
    return _solve(problem, state, schedule, damping, mixed, alone)


def _solve(problem, state, schedule, damping, mixed, alone):
    method = method_of(schedule, damping, state.scale.dtype, mixed=mixed)
    solution, _ = run(restrict_to_all(problem, schedule), state, method, alone=alone)
    return only(solution, len(schedule))


@_differentiable.def_fwd
def _forward(perturbed, problem, state, schedule, damping, mixed, alone):
    solution = _solve(problem, state, schedule, damping, mixed, alone)
    return solution, solution.state


@_differentiable.def_bwd
def _backward(
    found, cotangent, perturbed, problem, state, schedule, damping, mixed, alone
):
    arrive = cotangent.state
    full = jax.tree.map(
        lambda c, x: jnp.zeros_like(x) if c is None else c,
        arrive,
        found,
        is_leaf=lambda x: x is None,
    )
    # The last stage with steps decides which variables were free.
    taken = [stage for stage in schedule if stage.max_steps] or schedule
    now = restrict(problem, taken[-1].free)
    given = cotangent_of_problem(now, found, full)
    given = dataclasses.replace(given, variables=problem.variables)
    if cotangent.cost is not None:
        # At a minimum the derivative of the cost by the state is 0.
        arrays, static = eqx.partition(problem, eqx.is_inexact_array)
        by_cost = jax.grad(lambda a: eqx.combine(a, static).cost(found))
        more = by_cost(arrays)
        given = jax.tree.map(lambda a, b: a + cotangent.cost * b, given, more)
    return given


def restrict(problem: Problem, free: tuple[str, ...]) -> Problem:
    """Returns the problem with only these groups of variables free.

    **Raises:** `ValueError` for a name that is not among `VARIABLES`.
    """
    check_names(free)
    variables = tuple(name for name in problem.variables if name in free)
    return dataclasses.replace(problem, variables=variables)


def restrict_to_all(problem: Problem, schedule: tuple[Stage, ...]) -> Problem:
    """Returns the problem with only those groups free that some stage moves."""
    return restrict(problem, tuple(name for stage in schedule for name in stage.free))


def _solve_baseline(problem, state, solver, schedule):
    program = _baseline(is_alone() and not is_traced((problem, state)))
    first = cost = _cost(problem, state)
    counts, result = [], optx.RESULTS.successful
    for stage in schedule:
        if not stage.max_steps:
            counts.append(jnp.array(0))
            continue
        held = restrict(problem, stage.free)
        state, cost, count, result = program(solver, held, state, stage)
        counts.append(count)
    return Solution(state, result, cost, (), tuple(counts), first)


@functools.cache
def _baseline(alone: bool) -> Callable[..., Any]:
    run = baselines.run
    return compiled(run) if alone else eqx.filter_jit(run)


@eqx.filter_jit
def _cost(problem, state):
    return problem.cost(state)


def check_schedule(solver: Any, schedule: Any) -> None:
    """Refuses an unknown solver, and a schedule that takes no step.

    **Raises:** `ValueError` that says what was found and what was expected.
    """
    if solver not in get_args(Solver):
        raise ValueError(
            f"solver: {solver!r}, expected one of {list(get_args(Solver))}."
        )
    stages = isinstance(schedule, Sequence)
    if not stages or not all(isinstance(stage, Stage) for stage in schedule):
        raise ValueError(
            f"schedule: found {schedule!r:.60}, expected a tuple of `Stage`."
        )
    if not schedule:
        raise ValueError("schedule: no stage, expected one or more.")
    if not any(stage.max_steps for stage in schedule):
        raise ValueError(
            "schedule: every stage has max_steps=0, nothing to solve; "
            "`problem.cost(state)` is the cost."
        )


PAPER_SCHEDULE = (
    Stage(("scale", "cameras", "roots", "landmarks"), max_steps=20, rtol=1e-4),
    Stage(),
)
"""Section 3.6: first scale, cameras, roots and landmarks, then all variables."""
PAPER_STEPS = (200, 100)
"""The paper's number of first-order steps in each stage."""


def paper_schedule(solver: Solver) -> tuple[Stage, ...]:
    """Returns `PAPER_SCHEDULE`, with the paper's numbers of steps for `adam`."""
    if solver != "adam":
        return PAPER_SCHEDULE
    return tuple(
        dataclasses.replace(stage, max_steps=count)
        for stage, count in zip(PAPER_SCHEDULE, PAPER_STEPS, strict=True)
    )
