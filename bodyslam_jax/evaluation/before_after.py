"""Errors of a run before and after the joint optimisation.

Before it, structure from motion has cameras of arbitrary scale; after it, everything is
in metres.
"""

import dataclasses

import numpy as np

from bodyslam_jax import evaluation
from bodyslam_jax.body import BodyModel
from bodyslam_jax.types import Result, SfmResult

ALONE = "cameras alone, arbitrary scale"
JOINT = "joint estimate, in metres"
_WITHOUT_SCALE = ("c_ate_sim3", "rpe_rotation")
"""Errors, and their RMSE, of cameras whose scale means nothing."""
_HEADLINE = ("c_ate_se3", "c_ate_sim3", "h_ate_se3", "scale")


def errors(
    result: Result, cameras: SfmResult, truth: Result, body: BodyModel
) -> dict[str, dict[str, float | str]]:
    """The errors of `bodyslam evaluate` before and after the joint optimisation.

    Cameras alone have those errors that need neither scale nor people, if they moved;
    for others a word names what is missing. Without people there are no others.
    """
    after = evaluation.evaluate(result, truth, body)
    found: dict[str, dict[str, float | str]] = {}
    # With the same people, so that the same compiled program is used.
    unscaled = dataclasses.replace(result, T_WC=cameras.T_WC)
    before = evaluation.evaluate(unscaled, truth, body)
    if cameras.kind == "moving" and np.isfinite(before["c_ate_sim3"]):
        found[ALONE] = {
            key: "no people" if key in after.people else "no scale" for key in after
        }
        for name in _WITHOUT_SCALE:
            for key in (name, f"{name}_rmse"):
                found[ALONE][key] = float(before[key])
    if result.present.any() or ALONE not in found:
        found[JOINT] = {k: float(v) for k, v in after.items()}
    return found


def headline(errors: dict[str, dict[str, float | str]]) -> list[str]:
    """The main errors, a line for each column of `errors`."""
    lines = []
    for name, found in errors.items():
        parts = [
            f"{label} {factor * value:.4g} {unit}".rstrip()
            for key, label, unit, factor in evaluation.ROWS
            if key in _HEADLINE
            and isinstance(value := found.get(key), float)
            and np.isfinite(value)
        ]
        if parts:
            lines.append(f"error of {name}: {'; '.join(parts)}")
    return lines
