"""Solves a problem once, logs it and describes it for the report."""

import dataclasses
import logging
import time

from bodyslam_jax import graph, solver
from bodyslam_jax.config import Config

log = logging.getLogger(__name__)

COST_ATOL = 0.005
"""Decrease of the cost below which the solver stops. The cost is a negative
log-likelihood, in which one standard deviation of one residual is 0.5. Without this
bound, a few landmarks with little parallax keep moving for dozens of steps, with no
effect on the rest of the state."""


def solve_stage(
    problem: graph.Problem, state: graph.State, config: Config, name: str
) -> tuple[solver.Solution, dict]:
    """Solves the problem and returns the solution and the stage's entry for the report.

    The stage named `joint` follows the schedule of the paper, any other only its last
    step.
    """
    start = time.perf_counter()
    schedule = schedule_of(config)
    schedule = schedule if name == "joint" else schedule[-1:]
    # Covariances that follow are of factors in double precision: one program is enough.
    solution = solver.solve(
        problem,
        state,
        solver=config.solver,
        schedule=schedule,
        mixed_precision=False,
    )
    before, after = float(solution.first_cost), float(solution.cost)
    steps = sum(int(n) for n in solution.num_steps)
    status = solution.status
    log.info(
        "%s: cost %.4g -> %.4g in %d steps, %s", name, before, after, steps, status
    )
    return solution, {
        "name": name,
        "cost_before": before,
        "cost_after": after,
        "iterations": steps,
        "seconds": round(time.perf_counter() - start, 2),
        "status": status,
    }


def schedule_of(config: Config) -> tuple[solver.Stage, ...]:
    """Returns the stages of the joint solve, which stop by `COST_ATOL`."""
    schedule = solver.paper_schedule(config.solver)
    return tuple(dataclasses.replace(stage, atol=COST_ATOL) for stage in schedule)
