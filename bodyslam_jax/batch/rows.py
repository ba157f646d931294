"""Reads a row of figures for each run folder from its `summary.json`."""

import logging
from collections.abc import Collection
from pathlib import Path
from typing import Any

from bodyslam_jax import evaluation
from bodyslam_jax.batch import failures
from bodyslam_jax.batch.inputs import BATCH_FILE, RUNS_FOLDER, is_file_name
from bodyslam_jax.batch.table import Column, Row
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.evaluation import ROWS
from bodyslam_jax.evaluation.before_after import JOINT_ESTIMATE
from bodyslam_jax.io import files

log = logging.getLogger(__name__)
_ERROR_NAMES = (
    *("c_ate_se3", "c_ate_sim3", "h_ate_se3", "j_ate_se3", "scale"),
    *("w_mpjpe", "wa_mpjpe", "pa_mpjpe", "rte", "gravity_error"),
)
ERROR_STATUS = "error"
"""Status of a clip without a result."""
MISSING_STATUS = "not run"
"""Status of a clip that a batch has not run yet."""
STATUS_ORDER = ("ok", "doubtful", "failed", ERROR_STATUS, MISSING_STATUS)


def error_columns(names: Collection[str]) -> list[Column]:
    """Returns the columns of errors, by their names in `evaluation`."""
    return [
        Column(
            _error_key(key), f"{label}, {unit}".rstrip(", "), 1 if unit else 3, factor
        )
        for key, label, unit, factor in ROWS
        if key in names
    ]


def columns() -> list[Column]:
    """Returns all columns; errors are those of the joint estimate against a ground
    truth."""
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
        *error_columns(_ERROR_NAMES),
        Column("seconds", "computed in, s", 0),
        Column("reasons", "reasons", is_wide=True),
    ]


def _error_key(name: str) -> str:
    """Returns the key of an error: `scale` (truth per estimate) must not be confused
    with the scale of a run."""
    return f"error.{name}"


def read_rows(folder: Path) -> list[Row]:
    """Returns the rows of all clips of a batch, or of all run folders in a folder, by
    name.

    **Raises:** `InputError` if there are none.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder.")
    found: dict[str, Row] = {}
    # The run folders of a batch are in a separate folder.
    for home in (folder, folder / RUNS_FOLDER):
        for summary in sorted(home.glob("*/summary.json")):
            row = _row(folder, summary)
            if row is not None:
                found[row["name"]] = row
    for line in failures.read(folder):
        row = {
            "name": line["name"],
            "status": line["status"],
            "reasons": line["message"],
        }
        if line["name"] not in found or line["status"] == ERROR_STATUS:
            found[line["name"]] = found.get(line["name"], {}) | row
    for name in _planned(folder):
        found.setdefault(name, {"name": name, "status": MISSING_STATUS})
    if not found:
        raise InputError(
            f"{folder}: no run folders in it (no */summary.json that can be read)."
        )
    for name, row in found.items():
        row.setdefault("folder", str(Path(RUNS_FOLDER, name)))
    return [found[name] for name in sorted(found)]


def _row(folder: Path, file: Path) -> Row | None:
    """Returns the row of a run, with its path relative to the collected folder."""
    try:
        row = _figures(file.parent.name, evaluation.read_summary(file))
    except InputError as error:
        log.warning("%s It is left out.", error)
        return None
    return row | {"folder": str(file.parent.relative_to(folder))}


def _figures(name: str, summary: dict[str, Any]) -> Row:
    source = summary.get("input") or {}
    source = source if isinstance(source, dict) else {}
    frames, fps = source.get("frames"), source.get("fps")
    scale = summary.get("scale") or {}
    durations = (summary.get("durations_s") or {}).values()
    row: Row = {
        "name": name,
        "status": summary.get("status") or "unknown",
        "frames": frames,
        "duration": frames / fps if frames and fps else None,
        "camera_motion": summary.get("camera_motion"),
        "camera_path": summary.get("camera_path_m"),
        "scale": scale.get("value"),
        "seconds": sum(x for x in durations if x is not None) or None,
        "reasons": " ".join(map(_reason, summary.get("reasons") or [])),
    }
    if scale.get("sigma") and scale.get("value"):
        row["scale_error"] = scale["sigma"] / scale["value"]
    people = [person or {} for person in summary.get("people") or []]
    row["people"] = len(people)
    if people and people[0].get("status") != "not_measurable":
        row |= {
            "stature": people[0].get("stature_m"),
            "stature_sigma": people[0].get("stature_sigma_m"),
            "speed": people[0].get("speed_m_s"),
        }
    errors = (summary.get("errors") or {}).get(JOINT_ESTIMATE) or {}
    # Text in place of a number gives the reason for which there is none.
    numbers = {k: v for k, v in errors.items() if isinstance(v, (int, float))}
    return row | {_error_key(k): v for k, v in numbers.items() if k in _ERROR_NAMES}


def _reason(reason: Any) -> str:
    return str(reason.get("message") if isinstance(reason, dict) else reason)


def _planned(folder: Path) -> list[str]:
    """Returns the names of a batch's clips."""
    if not (folder / BATCH_FILE).exists():
        return []
    try:
        found = files.read_json(folder / BATCH_FILE, "the clips of a batch")
    except InputError as error:
        log.warning("%s Clips that have not been run are left out.", error)
        return []
    clips = found.get("clips") if isinstance(found, dict) else None
    if not isinstance(clips, (dict, list)):
        log.warning(
            "%s: no clips in it; those not run are left out.", folder / BATCH_FILE
        )
        return []
    return [name for name in clips if isinstance(name, str) and is_file_name(name)]
