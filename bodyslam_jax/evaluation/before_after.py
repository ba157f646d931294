"""Errors of a run before and after the joint optimisation.

Before it, the cameras of structure from motion have an arbitrary scale; after it,
everything is in metres.
"""

import dataclasses

import numpy as np

from bodyslam_jax import evaluation
from bodyslam_jax.body import BodyModel
from bodyslam_jax.types import Result, SfmResult

CAMERAS_ALONE = "cameras alone, arbitrary scale"
JOINT_ESTIMATE = "joint estimate, in metres"
_SCALE_FREE_ERRORS = ("c_ate_sim3", "rpe_rotation")
"""Errors (each with its RMSE) that are defined for cameras of arbitrary scale."""
_HEADLINE_ERRORS = ("c_ate_se3", "c_ate_sim3", "h_ate_se3", "scale")


def errors(
    result: Result, cameras: SfmResult, truth: Result, body: BodyModel
) -> dict[str, dict[str, float | str]]:
    """Returns the errors of `bodyslam evaluate` before and after the joint
    optimisation.

    Cameras alone, if they moved, have the errors that need neither scale nor people;
    the others are replaced by text on what is missing. Errors after the optimisation
    are left out if there are no people and the cameras alone have errors.
    """
    after = evaluation.evaluate(result, truth, body)
    found: dict[str, dict[str, float | str]] = {}
    # The people stay the same, so that the same compiled program is used.
    unscaled = dataclasses.replace(result, T_WC=cameras.T_WC)
    before = evaluation.evaluate(unscaled, truth, body)
    if cameras.kind == "moving" and np.isfinite(before["c_ate_sim3"]):
        found[CAMERAS_ALONE] = {
            key: "no people" if key in after.people else "no scale" for key in after
        }
        for name in _SCALE_FREE_ERRORS:
            for key in (name, f"{name}_rmse"):
                found[CAMERAS_ALONE][key] = float(before[key])
    if result.present.any() or CAMERAS_ALONE not in found:
        found[JOINT_ESTIMATE] = {k: float(v) for k, v in after.items()}
    return found


def headline(errors: dict[str, dict[str, float | str]]) -> list[str]:
    """Returns the main errors, as a line for each entry of `errors`."""
    lines = []
    for name, found in errors.items():
        parts = [
            f"{label} {factor * value:.4g} {unit}".rstrip()
            for key, label, unit, factor in evaluation.ROWS
            if key in _HEADLINE_ERRORS
            and isinstance(value := found.get(key), float)
            and np.isfinite(value)
        ]
        if parts:
            lines.append(f"error of {name}: {'; '.join(parts)}")
    return lines
