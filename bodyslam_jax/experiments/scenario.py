"""Simulations of an experiment, and errors of states on a simulated case."""

import zlib
from collections.abc import Sequence as Ordered

import numpy as np

from bodyslam_jax import graph
from bodyslam_jax.config import Experiment, Simulation
from bodyslam_jax.experiments.scoring import score
from bodyslam_jax.pipeline.case import Case


def score_of(case: Case, state: graph.State, present: np.ndarray) -> dict[str, float]:
    """Errors of a state against the truth: `scoring.NAMES`, m."""
    return score(state, case.truth, case.body, present, case.cameras.registered)


def simulations(
    experiment: Experiment, sequences: Ordered[str], families: Ordered[str]
) -> list[Simulation]:
    """Simulations of an experiment: its default sequences unless others are requested.

    A seed that is given changes every sequence differently, as it is combined with the
    sequence's name.
    """
    chosen = dict.fromkeys(experiment.sequences or sequences)  # each once
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
