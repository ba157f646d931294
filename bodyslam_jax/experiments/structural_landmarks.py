"""Computes the rows of `bodyslam experiment landmarks`: the effect of structural
landmarks (appendix C).

The inputs are a `Case` and the seed of the perturbation; the output are C-ATE, m, of
the perturbed cameras and after optimisation with and without landmarks.
"""

import jax
import jax.numpy as jnp
from jaxtyping import PRNGKeyArray

from bodyslam_jax import graph
from bodyslam_jax.experiments.problems import with_scale, without_map
from bodyslam_jax.experiments.scenario import score_of
from bodyslam_jax.pipeline.case import Case
from bodyslam_jax.pipeline.solve_stage import solve_stage

SHIFT_M, TURN_RAD = 0.1, 0.01
"""The paper's bounds of the uniform perturbation of each coordinate."""


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
