"""Rows of `bodyslam experiment weights`: learnt weights, and errors with them."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.experiments.weights import (
    Learned,
    Trial,
    outcome,
    training_error,
)


def described(learned: Learned) -> dict[str, Any]:
    """Names, logarithms and factors of the weights, and the history of learning."""
    return {
        "names": list(learned.names),
        "log": learned.log.tolist(),
        "factor": np.exp(learned.log).tolist(),
        "history": learned.history.tolist(),
        "path": learned.path.tolist(),
    }


def judge(trial: Trial, learned: Learned) -> dict[str, float]:
    """Errors with the original and the learnt weights: `before/scale` and so on."""
    row = {}
    for when, log in (
        ("before", np.zeros_like(learned.log)),
        ("after", learned.log),
    ):
        found = _errors(trial, learned.names, jnp.asarray(log))
        row |= {f"{when}/{name}": float(value) for name, value in found.items()}
    return row


@eqx.filter_jit
def _errors(
    trial: Trial, names: tuple[str, ...], log: Float[Array, " w"]
) -> dict[str, Float[Array, ""]]:
    """Errors under these weights, and the training error made of them."""
    _, _, found = outcome(trial, names, log)
    return found | {"error": training_error(found)}
