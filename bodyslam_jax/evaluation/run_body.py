"""The body model of a run, which its summary names but which only the user may give."""

import jax.numpy as jnp
import numpy as np

from bodyslam_jax.body import BodyModel, joints, load_body_model
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.types import Result

_MAX_OFFSET_M = 0.01
"""Distance between a result's joints and those of a body model, m, from which the model
cannot be the one that the result was estimated with."""


def body_of_run(result: Result) -> BodyModel:
    """The body model that this machine has, if it is the one of the result.

    The file that `settings.body_model` of the summary names is not opened: a run folder
    may come from anybody, and name any file.

    **Raises:** `InputError`, one line that asks for `--body-model`, if the result is of
    another body model.
    """
    body = load_body_model()
    check_body(result, body)
    return body


def check_body(result: Result, body: BodyModel) -> None:
    """Compares the joints of each person in two frames with those of the result.

    **Raises:** `InputError` if `body` is not the body model of the result.
    """
    for h, there in enumerate(result.present):
        if not there.any():
            continue
        k = np.flatnonzero(there)[[0, -1]]
        cast = lambda x: jnp.asarray(x, body.dtype)
        posed = joints(
            body, *map(cast, (result.poses[h, k], result.betas[h], result.trans[h, k]))
        )
        away = np.linalg.norm(np.asarray(posed) - result.joints[h, k], axis=-1).max()
        if not away < _MAX_OFFSET_M:
            raise InputError(
                f"body model {body.name}: its joints are {100 * away:.0f} cm off the "
                f"run's, expected the body model of the run{_named(result)}; give it "
                "by --body-model."
            )


def _named(result: Result) -> str:
    """What a summary calls the body model, in words; it may name anything."""
    settings = result.summary.get("settings")
    named = settings.get("body_model") if isinstance(settings, dict) else None
    if not isinstance(named, str):
        return ""
    return f" ({named[:200]!r}, which is not opened unless it is given)"
