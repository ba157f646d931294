"""How far off a run is: cameras alone with arbitrary scale, then all of it in metres.

The difference is what people are for: the first has no unit until the truth lends it.
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
    """What `bodyslam evaluate` says, before and after the joint estimate.

    Cameras alone are judged, if they moved, by what needs neither scale nor people; for
    all else a word says what is missing. Without people that is all there is to say.
    """
    after = evaluation.evaluate(result, truth, body)
    found: dict[str, dict[str, float | str]] = {}
    # The people stay, unheeded: with them it is the same program.
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
    """A line for each column of `errors`: what is first looked at."""
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
