"""Simulations of an experiment, errors of states on them, and variants of their joint
problems: without map, at another scale, stacked.

`score` compares a state with the truth.
"""

import dataclasses
import zlib
from collections.abc import Sequence as Ordered

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax import evaluation, graph
from bodyslam_jax.body import BodyModel
from bodyslam_jax.body.skeleton import FEET
from bodyslam_jax.config import Experiment, Simulation
from bodyslam_jax.evaluation import Trajectories
from bodyslam_jax.ground.gravity import level
from bodyslam_jax.pipeline.case import Case, trajectories
from bodyslam_jax.pipeline.to_metric import floor_height

NAMES = (
    "c_ate_se3",
    "c_ate_sim3",
    "h_ate_se3",
    "h_ate_sim3",
    "j_ate_se3",
    "j_ate_sim3",
    "scale",
)
"""Errors of the paper's table 1: mean over frames, m; `scale` is truth per estimate."""
PLAUSIBILITY_FIGURES = (
    "gravity_error",
    *(f"{name}{whose}" for name in evaluation.FIGURES for whose in ("", "_of_truth")),
)
"""Figures of gravity, feet and posture, rad, m, s; without the low-pass filter that is
applied to results."""
_FRAMES_MULTIPLE = 100
"""Numbers of frames are padded to multiples of this, so that lengths share compiled
programs."""


def score_of(case: Case, state: graph.State, present: np.ndarray) -> dict[str, float]:
    """Returns the errors (m) of a state against the truth, by `NAMES`."""
    return score(state, case.truth, case.body, present, case.cameras.registered)


def simulations(
    experiment: Experiment, sequences: Ordered[str], families: Ordered[str]
) -> list[Simulation]:
    """Returns the simulations of an experiment: its default sequences unless others are
    requested.

    A given seed is combined with each sequence's name, so that sequences differ.
    """
    chosen = dict.fromkeys(experiment.sequences or sequences)  # removes duplicates
    kinds = families
    if experiment.family is not None:
        kinds = (
            ("room", "follow") if experiment.family == "both" else (experiment.family,)
        )
    chance = lambda name: (
        None
        if experiment.seed is None
        else zlib.crc32(f"{name}-{experiment.seed}".encode())
    )
    return [
        Simulation(
            # `Simulation` refuses other names.
            sequence=sequence,  # pyright: ignore[reportArgumentType]
            family=family,  # pyright: ignore[reportArgumentType]
            length=experiment.frames,
            seed=chance(f"{sequence}-{family}"),
            motion=experiment.motion,
            noise=experiment.noise,
        )
        for family in kinds
        for sequence in chosen
    ]


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


def errors(estimate: Trajectories, truth: Trajectories) -> dict[str, Float[Array, ""]]:
    """Returns the errors in `NAMES`; people are paired by index."""
    found = evaluation.evaluate_trajectories(estimate, truth)
    return {name: found[name] for name in NAMES}


def score(
    state: graph.State,
    truth: Trajectories,
    body: BodyModel,
    present: Bool[Array | np.ndarray, "h t"],
    registered: Bool[Array | np.ndarray, " t"],
) -> dict[str, float]:
    """Returns `errors` of one state as plain numbers, compiled once for many lengths.

    `leg_ratio`, the estimated over the true leg length of the first person, and the
    figures named in `PLAUSIBILITY_FIGURES` are added.
    """
    frames = -(-len(state.cameras) // _FRAMES_MULTIPLE) * _FRAMES_MULTIPLE
    estimate = trajectories(state, body, present, registered, truth.fps)
    estimate = _upright(estimate, state, body)
    found = _errors(
        evaluation.pad_frames(estimate, frames), evaluation.pad_frames(truth, frames)
    )
    ratio = leg_of(estimate) / leg_of(truth)
    return {name: float(value) for name, value in found.items()} | {
        "leg_ratio": float(ratio)
    }


def leg_of(people: Trajectories) -> Float[Array, ""]:
    """Returns the length from hip over knee to ankle of the first person, m, which is
    independent of pose."""
    first = people.joints[0, 0]
    bones = first[np.array([4, 5, 7, 8])] - first[np.array([1, 2, 4, 5])]
    return jnp.sqrt((bones**2).sum(-1)).sum() / 2


def _upright(
    estimate: Trajectories, state: graph.State, body: BodyModel
) -> Trajectories:
    """Returns the trajectories in a world whose y axis is up and whose floor is at y =
    0."""
    present, fps = np.asarray(estimate.present), float(estimate.fps)
    if not present.any():
        return estimate
    T_WC, joints = np.asarray(estimate.T_WC), np.asarray(estimate.joints)
    turn, _ = level(
        T_WC,
        np.asarray(graph.world_from_root(state))[..., :3, 1],
        joints[:, :, FEET],
        present,
        np.asarray(state.scale * state.landmarks),
        fps,
        np.zeros(len(present), bool),
    )
    at = lambda points: np.asarray(points) @ turn[:3, :3].T + turn[:3, 3]
    floor = floor_height(body, np.asarray(state.shapes), at(joints), present, fps)
    turn[1, 3] -= floor
    return Trajectories(
        T_WC=jnp.asarray(turn @ T_WC),
        camera_valid=estimate.camera_valid,
        joints=jnp.asarray(at(joints)),
        present=estimate.present,
        feet=jnp.asarray(at(estimate.feet)),
        fps=estimate.fps,
    )


@eqx.filter_jit
def _errors(estimate: Trajectories, truth: Trajectories) -> dict[str, Float[Array, ""]]:
    found = evaluation.evaluate_trajectories(estimate, truth)
    return {name: found[name] for name in (*NAMES, *PLAUSIBILITY_FIGURES)}
