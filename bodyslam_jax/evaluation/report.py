"""Formats errors as rows, a table or JSON, and describes what was compared."""

import json
import math
from typing import Any

import numpy as np
from jaxtyping import Array

from bodyslam_jax.evaluation.errors import (
    NOBODY,
    STRAIGHT_PATH_RMS_M,
    Evaluation,
    Scope,
)

_MIN_ALIGNED_POSES = 3
"""Number of poses from which an alignment leaves errors that mean something."""

_MM, _PERCENT, _DEGREES = 1e3, 100.0, 180 / math.pi
ROWS: tuple[tuple[str, str, str, float], ...] = (
    ("c_ate_se3", "C-ATE, SE(3)", "mm", _MM),
    ("c_ate_sim3", "C-ATE, Sim(3)", "mm", _MM),
    ("h_ate_se3", "H-ATE, SE(3)", "mm", _MM),
    ("h_ate_sim3", "H-ATE, Sim(3)", "mm", _MM),
    ("j_ate_se3", "J-ATE, SE(3)", "mm", _MM),
    ("j_ate_sim3", "J-ATE, Sim(3)", "mm", _MM),
    ("scale", "scale (best 1)", "", 1.0),
    ("scale_error", "|1 - scale|", "%", _PERCENT),
    ("h_ate_a2", "H-ATE, A2 camera's alignment", "mm", _MM),
    ("c_ate_a3", "C-ATE, A3 joint alignment", "mm", _MM),
    ("h_ate_a3", "H-ATE, A3 joint alignment", "mm", _MM),
    ("c_ate_a4", "C-ATE, A4 first camera pose", "mm", _MM),
    ("h_ate_a4", "H-ATE, A4 first camera pose", "mm", _MM),
    ("rpe_translation", "RPE translation, 1 frame", "mm", _MM),
    ("rpe_rotation", "RPE rotation, 1 frame", "deg", _DEGREES),
    ("w_mpjpe", "W-MPJPE 100", "mm", _MM),
    ("wa_mpjpe", "WA-MPJPE 100", "mm", _MM),
    ("w_mpjpe_tram", "W-MPJPE 100, TRAM chunks", "mm", _MM),
    ("wa_mpjpe_tram", "WA-MPJPE 100, TRAM chunks", "mm", _MM),
    ("rte", "RTE", "%", _PERCENT),
    ("ate_s", "ATE-S", "mm", _MM),
    ("mpjpe", "MPJPE", "mm", _MM),
    ("pa_mpjpe", "PA-MPJPE", "mm", _MM),
    ("acceleration_error", "acceleration error", "m/s²", 1.0),
    ("jitter", "jitter", "10 m/s³", 0.1),
    ("jitter_of_truth", "jitter of the truth", "10 m/s³", 0.1),
    ("foot_sliding", "foot sliding per frame", "mm", _MM),
    ("gravity_error", "gravity error", "deg", _DEGREES),
    *(
        (f"{name}{of}", f"{label}{whose}", unit, factor)
        for name, label, unit, factor in (
            ("foot_speed", "standing foot's speed, median", "m/s", 1.0),
            ("feet_low", "feet over the ground, 5th percentile", "mm", _MM),
            ("feet_high", "feet over the ground, 95th percentile", "mm", _MM),
            ("joint_acceleration", "joints' acceleration, median", "m/s²", 1.0),
            ("knee", "knees' bend", "deg", _DEGREES),
            ("straighter_knee", "straighter knee's bend", "deg", _DEGREES),
        )
        for of, whose in (("", ""), ("_of_truth", ", truth"))
    ),
)
"""Rows of the report: name, label, unit, and factor from SI to that unit."""


def to_rows(evaluation: Evaluation) -> list[tuple[str, str, str, str]]:
    """Returns label, mean, RMSE and unit, as text, of every error that exists."""

    def cell(name: str, factor: float) -> str:
        value = float(evaluation[name]) * factor if name in evaluation else math.nan
        return "–" if math.isnan(value) else f"{value:.4g}"

    more = {"foot_sliding": f" of {evaluation.feet}"}
    rows = [
        (
            label + more.get(name, ""),
            cell(name, factor),
            cell(f"{name}_rmse", factor),
            unit,
        )
        for name, label, unit, factor in ROWS
    ]
    return [row for row in rows if row[1] != "–"]


def to_table(evaluation: Evaluation) -> str:
    """Returns the errors as aligned text: mean and RMSE, in mm and degrees where
    customary, below a line on what was compared, if that is known."""
    rows = [("", "mean", "RMSE", "unit"), *to_rows(evaluation)]
    width = max(len(row[0]) for row in rows)
    lines = [f"{a:<{width}}  {b:>9}  {c:>9}  {d}".rstrip() for a, b, c, d in rows]
    scope = [] if evaluation.scope is None else [describe(evaluation.scope), ""]
    return "\n".join([*scope, lines[0], "-" * (width + 31), *lines[1:]])


def describe(scope: Scope) -> str:
    """Returns a line on what was compared: frames of the camera, and pairs of
    people."""
    parts = [f"cameras in {scope.cameras} of {scope.of_cameras} frames"]
    if not scope.of_cameras:
        parts = ["no true cameras"]
    for pair in scope.people:
        found = (
            "not found"
            if pair.estimate == NOBODY
            else f"(here {pair.estimate}) in {pair.frames} of {pair.of_frames} frames"
        )
        parts.append(f"person {pair.truth} {found}")
    if scope.others:
        parts.append(f"{scope.others} more found who are not in the ground truth")
    return "Compared: " + ", ".join(parts) + "."


def gaps(scope: Scope, least: float = 0.9) -> list[str]:
    """Returns warnings about parts of the truth that the errors leave out.

    `least` is the share of frames below which a comparison is incomplete.
    """
    found = []
    if scope.cameras < least * scope.of_cameras:
        found.append(
            f"cameras are compared in {scope.cameras} of {scope.of_cameras} frames of "
            "the ground truth only."
        )
    if 0 < scope.cameras < _MIN_ALIGNED_POSES:
        found.append(
            f"cameras are compared in {scope.cameras} frames only, which alignment "
            "brings together: their errors are meaningless."
        )
    found += [
        f"person {pair.truth} goes along a line, to {100 * STRAIGHT_PATH_RMS_M:.0f} "
        "cm: alignment A1 does not determine the rotation about it, on which J-ATE "
        "depends."
        for pair, straight in zip(scope.people, scope.straight)
        if straight
    ]
    for pair in scope.people:
        if pair.estimate == NOBODY:
            found.append(f"person {pair.truth} of the ground truth is not found.")
        elif pair.frames < least * pair.of_frames:
            found.append(
                f"person {pair.truth} is compared in {pair.frames} of "
                f"{pair.of_frames} frames of the ground truth only."
            )
    return found


def _compared(scope: Scope) -> dict[str, Any]:
    """Returns the scope as dictionaries; the index of a person who is not found is
    `None`."""
    people = [
        {**vars(pair), "estimate": None if pair.estimate == NOBODY else pair.estimate}
        for pair in scope.people
    ]
    return {**vars(scope), "people": people}


def to_json(evaluation: Evaluation) -> str:
    """Returns the errors as JSON in SI units; `null` where an error does not exist."""

    def plain(value: Array) -> Any:
        array = np.asarray(value, np.float64)
        listed = [x if math.isfinite(x) else None for x in array.ravel().tolist()]
        return listed if array.ndim else listed[0]

    found: dict[str, Any] = {name: plain(x) for name, x in evaluation.items()}
    found["people"] = {name: plain(x) for name, x in evaluation.people.items()}
    if evaluation.scope is not None:
        found["compared"] = _compared(evaluation.scope)
    return json.dumps(found, indent=2)
