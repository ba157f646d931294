"""Weights learnt on some sequences, judged on others."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.experiments._case import Case
from bodyslam_jax.experiments._weights import (
    Trial,
    learn_weights,
    make_trial,
    outcome,
    training_error,
)


@eqx.filter_jit
def judge(
    trial: Trial, names: tuple[str, ...], log: Float[Array, " w"]
) -> dict[str, Float[Array, ""]]:
    """Errors under these weights, and the training error made of them."""
    _, _, found = outcome(trial, names, log)
    return found | {"error": training_error(found)}


def learn_and_test(
    training: Sequence[Case],
    test: Sequence[Case],
    *,
    hold_cameras: bool = True,
    steps: int = 12,
) -> dict[str, Any]:
    """Learns on `training`, and measures before and after on both sets.

    With `hold_cameras`, cameras and map stay as bundle adjustment left them, which
    takes landmarks out of the problem: what is learnt is how people are weighed.
    """
    make = lambda case: make_trial(case, case.prepare(), hold_cameras=hold_cameras)
    known, unknown = [make(case) for case in training], [make(case) for case in test]
    learned = learn_weights(known, steps=steps)
    rows = []
    for group, cases, trials in (
        ("training", training, known),
        ("test", test, unknown),
    ):
        for case, trial in zip(cases, trials, strict=True):
            row: dict[str, Any] = {"sequence": case.name, "set": group}
            for when, log in (
                ("before", np.zeros_like(learned.log)),
                ("after", learned.log),
            ):
                found = judge(trial, learned.names, jnp.asarray(log))
                row |= {f"{when}/{k}": float(v) for k, v in found.items()}
            rows.append(row)
    return {
        "names": list(learned.names),
        "log": learned.log.tolist(),
        "factor": np.exp(learned.log).tolist(),
        "history": learned.history.tolist(),
        "path": learned.path.tolist(),
        "rows": rows,
    }
