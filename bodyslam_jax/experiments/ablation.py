"""Computes the rows of `bodyslam experiment ablation`: the effect of each part of the
estimate.

The input is a `Case` with its prepared problem; the output are the errors against the
truth, and the solver's status, steps and time.

A variant is a joint problem with factors disabled or added, or variables held constant
(`VARIANTS`).

`landmark_ablation` computes the rows of `bodyslam experiment landmarks`: the effect of
structural landmarks (appendix C). Its inputs are a `Case` and the seed of the
perturbation; the outputs are C-ATE, m, of the perturbed cameras and after optimisation
with and without landmarks.
"""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from bodyslam_jax import graph, motion
from bodyslam_jax.config import Config, GraphWeights
from bodyslam_jax.experiments.scenario import NAMES, score_of, with_scale, without_map
from bodyslam_jax.pipeline.case import Case
from bodyslam_jax.pipeline.joint_problem import Prepared, solve_stage

INDEPENDENT_ERRORS = {
    "motion_correlation": 0.0,
    "posture_correlation": 0.0,
    "root_correlation": 0.0,
}
"""Weights that model the errors of different frames as independent."""
SETTINGS: dict[str, GraphWeights] = {
    "errors of frames independent": dataclasses.replace(
        GraphWeights(), **INDEPENDENT_ERRORS
    ),
    "β measured anew in every frame": GraphWeights(shape_each_frame=True),
    "the paper's weights": GraphWeights.paper(),
}
"""Alternative weights, with which scale and bodies are initialised, too."""
PUBLISHED = "as published"
"""Label of the paper's weights, motion network and first-order schedule together."""
_SCALE_FACTORS = (
    graph.HumanMotion,
    graph.RootSmoothness,
    graph.GroundContact,
)
"""Factors that relate the map's unit to metres."""
Start = tuple[graph.Problem, graph.State]
Variant = Callable[[graph.Problem, graph.State], Start]
SHIFT_M, TURN_RAD = 0.1, 0.01
"""The paper's bounds of the uniform perturbation of each coordinate."""


def ablate(case: Case, prepared: Prepared, variant: str) -> dict[str, float | str]:
    """Returns the errors (m) of one of `VARIANTS`, solved from the start of the full
    problem.

    If the problem lacks the factor, nothing is solved, and `status` is `no such term`.
    """
    problem, start = VARIANTS[variant](prepared.problem, prepared.state)
    if variant == FULL:
        return _past(case.config) | _solved(case, prepared, case.config)
    if problem is prepared.problem:
        return {"status": "no such term"}
    return _solved(case, prepared, case.config, (problem, start))


def with_weights(case: Case, weights: GraphWeights) -> dict[str, float | str]:
    """Returns the errors (m) with other weights in all stages."""
    config = dataclasses.replace(case.config, weights=weights)
    return _solved(case, case.prepare(config), config)


def with_motion_model(case: Case, file: str) -> dict[str, float | str]:
    """Returns the errors (m) with another motion model, such as one with fewer past
    frames."""
    config = dataclasses.replace(case.config, motion_model=file)
    return _past(config) | _solved(case, case.prepare(config), config)


def as_published(case: Case) -> dict[str, float | str]:
    """Returns the errors (m) with the paper's weights, network and schedule; NaN for a
    body that the network was not trained on.

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


def _past(config: Config) -> dict[str, float | str]:
    """Returns the number of past frames that the motion model reads."""
    return {"past": float(motion.load_motion_model(config.motion_model).past)}


def _solved(
    case: Case,
    prepared: Prepared,
    config: Config,
    start: tuple[graph.Problem, graph.State] | None = None,
) -> dict[str, float | str]:
    """Returns the row of a solution from `start`, by default that of the prepared
    problem."""
    problem, state = start or (prepared.problem, prepared.state)
    solution, stage = solve_stage(problem, state, config, "joint")
    return _row(case, prepared, solution.state, stage)


def _row(case, prepared, state, stage):
    found = score_of(case, state, prepared.roots.present)
    row = {**found, "radius": case.radius, "scale_ratio": 1 / found["scale"]}
    names = ("status", "iterations", "seconds", "cost_after")
    status, steps, taken, cost = (stage[name] for name in names)
    return row | {
        "status": status,
        "steps": float(steps),
        "seconds": float(taken),
        "cost": float(cost),
    }


def without(*kinds: type[graph.Factor]) -> Variant:
    """Returns the variant without these factors; s is held if no remaining factor
    determines it.

    A problem that has no such factors is returned unchanged.
    """

    def variant(problem: graph.Problem, state: graph.State) -> Start:
        disabled = graph.disable(problem, *kinds)
        if eqx.tree_equal(disabled, problem):
            return problem, state
        remaining = [f for f in problem.factors if isinstance(f, _SCALE_FACTORS)]
        if all(isinstance(f, kinds) for f in remaining):
            disabled = dataclasses.replace(
                disabled, free=graph.set_constant(disabled.free, "scale")
            )
        return disabled, state

    return variant


def held(*names: str) -> Variant:
    """Returns the variant that holds these groups of variables at their start
    values."""

    def variant(problem: graph.Problem, state: graph.State) -> Start:
        free = graph.set_constant(problem.free, *names)
        return dataclasses.replace(problem, free=free), state

    return variant


def without_landmarks(problem: graph.Problem, state: graph.State) -> Start:
    """Returns the problem without observations of landmarks: landmarks are held, as no
    factor determines them, and cameras are free."""
    return held("landmarks")(
        *without(graph.Reprojection, graph.LandmarkPrior)(problem, state)
    )


def with_regressed_shape(problem: graph.Problem, state: graph.State) -> Start:
    """Returns the problem with β held at the regressor's value."""
    (prior,) = (f for f in problem.factors if isinstance(f, graph.ShapePrior))
    valid = jnp.isfinite(prior.sigma)
    count = valid.sum(axis=1, dtype=prior.shape.dtype)
    mean = jnp.where(valid, prior.shape, 0.0).sum(axis=1) / jnp.maximum(count, 1)
    shapes = jnp.where(valid.any(axis=1), mean, state.shapes)
    return held("shapes")(problem, dataclasses.replace(state, shapes=shapes))


FULL = "full"
VARIANTS: dict[str, Variant] = {
    FULL: lambda problem, state: (problem, state),
    "no motion model": without(graph.HumanMotion),
    "no ground": without(graph.GroundContact),
    "nothing that sees scale": without(
        graph.HumanMotion, graph.RootSmoothness, graph.GroundContact
    ),
    "no smooth path": without(graph.RootSmoothness),
    "no landmarks": without_landmarks,
    "no places seen again": without(graph.LandmarkPrior),
    "no keypoints": without(graph.KeypointReprojection),
    "no regressed postures": without(graph.BodyPosePrior),
    "no regressed orientation": without(graph.RootOrientation),
    "no steady turning": without(graph.AngularAccelerationPrior),
    "no regressed shape": without(graph.ShapePrior),
    "β held at the regressor's": with_regressed_shape,
    "cameras and map held": held("cameras", "landmarks"),
}
"""The variants of `ablation`, solved from the start of the full problem."""


def shake(
    state: graph.State,
    free: graph.Step,
    key: PRNGKeyArray,
    *,
    shift: float = SHIFT_M,
    turn: float = TURN_RAD,
) -> graph.State:
    """Moves every camera by up to `shift` m and `turn` rad in each coordinate.

    Coordinates that fix the gauge are unchanged; the state's s converts `shift` from
    metres.
    """
    low, high = -jnp.ones(6), jnp.ones(6)
    draw = jax.random.uniform(
        key, state.cameras.shape[:1] + (6,), minval=low, maxval=high
    )
    size = jnp.concatenate([jnp.full(3, turn), jnp.ones(3) * shift / state.scale])
    moved = graph.retract_pose(state.cameras, draw * size * free.cameras)
    return graph.State(**{**vars(state), "cameras": moved})


def landmark_ablation(case: Case, *, seed: int = 0) -> dict[str, float | str]:
    """Returns the C-ATE, m, of the perturbed cameras, and after optimisation with and
    without landmarks.

    `original` is that of bundle adjustment in the map's own unit (the paper's first
    column, of arbitrary scale); all others have s from the motion model.
    """
    prepared = case.prepare()
    problem, state = prepared.problem, prepared.state
    shaken = shake(state, problem.free, jax.random.key(seed))
    bare, bare_state = without_map(problem, shaken, hold_cameras=False)
    with_map, stage = solve_stage(problem, shaken, case.config, "joint")
    without, stage_bare = solve_stage(bare, bare_state, case.config, "joint")
    row: dict[str, float | str] = {
        "status": stage["status"],
        "status_no_landmarks": stage_bare["status"],
        "radius": case.radius,
    }
    states = {
        "original": with_scale(state, 1.0),
        "start": state,
        "perturbed": shaken,
        "no_landmarks": without.state,
        "landmarks": with_map.state,
    }
    for name, one in states.items():
        found = score_of(case, one, prepared.roots.present)
        row[name] = found["c_ate_se3"]
        row[f"{name}/sim3"] = found["c_ate_sim3"]
        row[f"{name}/scale"] = found["scale"]
    return row
