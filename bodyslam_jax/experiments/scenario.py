"""Selects the simulations of an experiment, and computes errors of states on them."""

import zlib
from collections.abc import Sequence as Ordered

import numpy as np

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
