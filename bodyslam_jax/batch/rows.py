"""A row of figures for each run folder, from its `summary.json`."""

import json
import logging
from collections.abc import Collection
from pathlib import Path
from typing import Any

from bodyslam_jax.batch import failures
from bodyslam_jax.batch.inputs import MARK
from bodyslam_jax.batch.table import Column, Row
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.evaluation import ROWS
from bodyslam_jax.evaluation.before_after import JOINT

log = logging.getLogger(__name__)
_ERRORS = (
    *("c_ate_se3", "c_ate_sim3", "h_ate_se3", "j_ate_se3", "scale"),
    *("w_mpjpe", "wa_mpjpe", "pa_mpjpe", "rte", "gravity_error"),
)
ERROR = "error"
"""Status of a clip without a result."""
MISSING = "not run"
"""Status of a clip that a batch has not run yet."""
ORDER = ("ok", "doubtful", "failed", ERROR, MISSING)


def error_columns(names: Collection[str]) -> list[Column]:
    """Columns of errors, by their names in `evaluation`."""
    return [
        Column(
            _error_key(key), f"{label}, {unit}".rstrip(", "), 1 if unit else 3, factor
        )
        for key, label, unit, factor in ROWS
        if key in names
    ]


def columns() -> list[Column]:
    """All columns; errors are against a ground truth, of the joint estimate."""
    return [
        Column("name", "clip"),
        Column("status", "status"),
        Column("frames", "frames"),
        Column("duration", "video, s", 1),
        Column("camera_motion", "camera"),
        Column("camera_path", "camera path, m", 2),
        Column("scale_error", "scale's standard error, %", 1, 100.0),
        Column("people", "people"),
        Column("stature", "stature of the first, cm", 1, 100.0),
        Column("stature_sigma", "its standard error, cm", 1, 100.0),
        Column("speed", "speed of the first, m/s", 2),
        *error_columns(_ERRORS),
        Column("seconds", "computed in, s", 0),
        Column("reasons", "reasons", is_wide=True),
    ]


def _error_key(name: str) -> str:
    """`scale` of the truth per estimate is not the scale of a run."""
    return f"error.{name}"


def read_rows(folder: Path) -> list[Row]:
    """Rows of all clips of a batch, or of all run folders in a folder, by name.

    **Raises:** `InputError` if there are none.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder.")
    found = {}
    for summary in sorted(folder.glob("*/summary.json")):
        row = _row(summary)
        if row is not None:
            found[row["name"]] = row
    for line in failures.read(folder):
        row = {
            "name": line["name"],
            "status": line["status"],
            "reasons": line["message"],
        }
        if line["name"] not in found or line["status"] == ERROR:
            found[line["name"]] = found.get(line["name"], {}) | row
    for name in _planned(folder):
        found.setdefault(name, {"name": name, "status": MISSING})
    if not found:
        raise InputError(f"{folder}: no run folders in it (no */summary.json).")
    return [found[name] for name in sorted(found)]


def _row(file: Path) -> Row | None:
    try:
        summary = json.loads(file.read_text())
        return _figures(file.parent.name, summary)
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        log.warning("%s: not a summary of a run (%s); left out", file, error)
        return None


def _figures(name: str, summary: dict[str, Any]) -> Row:
    source = summary.get("input") or {}
    frames, fps = source.get("frames"), source.get("fps")
    scale = summary.get("scale") or {}
    row: Row = {
        "name": name,
        "status": summary["status"],
        "frames": frames,
        "duration": frames / fps if frames and fps else None,
        "camera_motion": summary.get("camera_motion"),
        "camera_path": summary.get("camera_path_m"),
        "scale": scale.get("value"),
        "seconds": sum((summary.get("durations_s") or {}).values()) or None,
        "reasons": " ".join(
            str(reason.get("message")) for reason in summary.get("reasons") or []
        ),
    }
    if scale.get("sigma") and scale.get("value"):
        row["scale_error"] = scale["sigma"] / scale["value"]
    people = summary.get("people") or []
    row["people"] = len(people)
    if people and people[0].get("status") != "not_measurable":
        row |= {
            "stature": people[0].get("stature_m"),
            "stature_sigma": people[0].get("stature_sigma_m"),
            "speed": people[0].get("speed_m_s"),
        }
    errors = (summary.get("errors") or {}).get(JOINT) or {}
    # A word in place of a number says why there is none.
    numbers = {k: v for k, v in errors.items() if isinstance(v, (int, float))}
    return row | {_error_key(k): v for k, v in numbers.items() if k in _ERRORS}


def _planned(folder: Path) -> list[str]:
    """The names of a batch's clips."""
    try:
        return list(json.loads((folder / MARK).read_text())["clips"])
    except (OSError, ValueError, LookupError, TypeError):
        return []
