"""Rows of `bodyslam experiment ablation`: what each part of the estimate contributes.

Input is a `Case` with its prepared problem; output the errors against the truth, the
solver's status, steps and processor time.
"""

import dataclasses
import time

import equinox as eqx
import jax

from bodyslam_jax import graph, motion, solver
from bodyslam_jax.config import Config, GraphWeights
from bodyslam_jax.experiments.scenario import score_of
from bodyslam_jax.experiments.scoring import NAMES
from bodyslam_jax.experiments.variants import FULL, VARIANTS
from bodyslam_jax.pipeline.case import Case
from bodyslam_jax.pipeline.joint_problem import Prepared
from bodyslam_jax.pipeline.solve_stage import solve_stage

INDEPENDENT = {
    "motion_correlation": 0.0,
    "posture_correlation": 0.0,
    "root_correlation": 0.0,
}
"""Weights that model the errors of different frames as independent."""
SETTINGS: dict[str, GraphWeights] = {
    "errors of frames independent": dataclasses.replace(GraphWeights(), **INDEPENDENT),
    "β measured anew in every frame": GraphWeights(shape_each_frame=True),
    "the paper's weights": GraphWeights.paper(),
}
"""Other weights; scale and bodies are initialised with them, too."""
PUBLISHED = "as published"
"""The paper's weights, its motion network and its first-order schedule together."""
ORDERS = ("second order", "first order, as long", "first order, 200 + 100 steps")
_TRIAL = 20
"""Number of steps over which the time of one is measured."""


def ablate(case: Case, prepared: Prepared, variant: str) -> dict[str, float | str]:
    """Errors of one of `VARIANTS`, solved from the start of the full problem, m.

    Nothing is solved if the problem lacks the factor; `status` then is `no such term`.
    """
    problem, start = VARIANTS[variant](prepared.problem, prepared.state)
    if variant == FULL:
        return _past(case.config) | _solved(case, prepared, case.config)
    if problem is prepared.problem:
        return {"status": "no such term"}
    return _solved(case, prepared, case.config, (problem, start))


def with_weights(case: Case, weights: GraphWeights) -> dict[str, float | str]:
    """Errors with other weights in all stages, m."""
    config = dataclasses.replace(case.config, weights=weights)
    return _solved(case, case.prepare(config), config)


def with_motion_model(case: Case, file: str) -> dict[str, float | str]:
    """Errors with another motion model, such as one with fewer past frames."""
    config = dataclasses.replace(case.config, motion_model=file)
    return _past(config) | _solved(case, case.prepare(config), config)


def as_published(case: Case) -> dict[str, float | str]:
    """Errors with the paper's weights, network and schedule, m; NaN for a body that the
    network was not trained on.

    Cameras, map and regressed bodies are the start values of all methods.
    """
    paper = Config.paper()
    names = ("weights", "motion_model", "motion_coupling", "solver")
    config = dataclasses.replace(case.config, **{n: getattr(paper, n) for n in names})
    model = motion.load_motion_model(config.motion_model)
    if model.body != case.body.kind:
        missing = dict.fromkeys(NAMES, float("nan"))
        return {**missing, "status": f"no network of the paper for {case.body.kind}"}
    return _past(config) | _solved(case, case.prepare(config), config)


def compare_orders(case: Case, prepared: Prepared) -> dict[str, dict[str, float | str]]:
    """The structured solver against Adam: at equal processor time, and as in the paper.

    Times are without compilation. Adam has the same start, the paper's learning rate
    and, at equal time, all variables free from the first step.
    """
    problem, state = prepared.problem, prepared.state
    schedule = solver.PAPER_SCHEDULE
    run = lambda: solver.solve(problem, state, schedule=schedule)
    solution, seconds = _timed(run)
    rows = {ORDERS[0]: _row(case, prepared, solution.state, {}, solution, seconds)}
    per_step = _time_of_gradient(problem, state)
    count = max(int(seconds / per_step), _TRIAL)
    equal = (solver.Stage(max_steps=count),)
    paper = solver.paper_schedule("adam")
    for name, stages in zip(ORDERS[1:], (equal, paper), strict=True):
        found = solver.solve(problem, state, solver="adam", schedule=stages)
        steps = sum(stage.max_steps for stage in stages)
        row = _row(case, prepared, found.state, {}, found, per_step * steps)
        rows[name] = {**row, "steps": float(steps)}
    return rows


def _past(config: Config) -> dict[str, float | str]:
    """Number of past frames that the motion model takes."""
    return {"past": float(motion.load_motion_model(config.motion_model).past)}


def _solved(
    case: Case,
    prepared: Prepared,
    config: Config,
    start: tuple[graph.Problem, graph.State] | None = None,
) -> dict[str, float | str]:
    """The row of a solution from `start`, by default that of the prepared problem."""
    problem, state = start or (prepared.problem, prepared.state)
    solution, stage = solve_stage(problem, state, config, "joint")
    return _row(case, prepared, solution.state, stage)


def _timed(run) -> tuple[solver.Solution, float]:
    """The second run's processor time: the first one compiles."""
    jax.block_until_ready(run())
    start = time.process_time()
    solution = jax.block_until_ready(run())
    return solution, time.process_time() - start


def _time_of_gradient(problem: graph.Problem, state: graph.State) -> float:
    """Processor time of one gradient of the cost, s: what a first-order step takes."""
    zero = state.zero_step()

    @eqx.filter_jit
    def many(problem, state):
        cost = lambda step: problem.cost(state.retract(step))

        def one(step, _):
            gradient = jax.grad(cost)(step)
            return jax.tree.map(lambda x, g: x - 1e-12 * g, step, gradient), None

        return jax.lax.scan(one, zero, length=_TRIAL)[0]

    jax.block_until_ready(many(problem, state))
    start = time.process_time()
    jax.block_until_ready(many(problem, state))
    return (time.process_time() - start) / _TRIAL


def _row(case, prepared, state, stage, solution=None, seconds=None):
    found = score_of(case, state, prepared.roots.present)
    row = {**found, "radius": case.radius, "scale_ratio": 1 / found["scale"]}
    if solution is not None:
        steps = sum(int(n) for n in solution.num_steps)
        costs_of_solve = {
            "status": solution.status,
            "steps": float(steps),
            "seconds": seconds,
        }
        return row | costs_of_solve | {"cost": float(solution.cost)}
    names = ("status", "iterations", "seconds", "cost_after")
    status, steps, taken, cost = (stage[name] for name in names)
    return row | {
        "status": status,
        "steps": float(steps),
        "seconds": float(taken),
        "cost": float(cost),
    }
