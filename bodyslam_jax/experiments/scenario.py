"""Simulations of an experiment, errors of states on them, and variants of their joint
problems: without map, at another scale, stacked.
"""

import dataclasses
import zlib
from collections.abc import Sequence as Ordered

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax import graph
from bodyslam_jax.config import Experiment, Simulation
from bodyslam_jax.experiments.scoring import score
from bodyslam_jax.pipeline.case import Case


def score_of(case: Case, state: graph.State, present: np.ndarray) -> dict[str, float]:
    """Returns the errors (m) of a state against the truth, by `scoring.NAMES`."""
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
