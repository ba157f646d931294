"""Rows of figures, one for each run folder from its `summary.json`, and tables of them.

Tables are CSV, Markdown and LaTeX; a `Column` has the unit and the format of a figure.
"""

import dataclasses
import logging
import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, TypeGuard

from bodyslam_jax import evaluation
from bodyslam_jax.batch import failures
from bodyslam_jax.batch.inputs import BATCH_FILE, RUNS_FOLDER, is_file_name
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.evaluation import ROWS
from bodyslam_jax.evaluation.before_after import JOINT_ESTIMATE
from bodyslam_jax.io import files
from bodyslam_jax.io.markup import csv_table, latex_text, markdown_table

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
Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Column:
    """A column: its key in the rows, its title with the unit, its format."""

    key: str
    title: str
    digits: int | None = None
    """Number of decimal places; `None` for text and whole numbers."""
    factor: float = 1.0
    """Factor from the row's unit (SI) to that of the title."""
    is_wide: bool = False
    """Whether the column has text of any length, and is left out of LaTeX."""

    def value(self, row: Row) -> Any:
        """Returns the value in the unit of the title; `None` if the row has none."""
        found = row.get(self.key)
        if isinstance(found, (int, float)) and not isinstance(found, bool):
            if not math.isfinite(found):
                return None
            return found * self.factor if self.factor != 1 else found
        return found if found != "" else None

    def text(self, row: Row) -> str:
        """Returns the row's value as the text of a cell."""
        found = self.value(row)
        if found is None:
            return "–"
        if self.digits is not None and isinstance(found, (int, float)):
            return f"{found:.{self.digits}f}"
        return str(found)


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


def present(columns: Sequence[Column], rows: Sequence[Row]) -> list[Column]:
    """Returns the columns for which any row has a value."""
    return [c for c in columns if any(c.value(row) is not None for row in rows)]


def to_csv(columns: Sequence[Column], rows: Sequence[Row]) -> str:
    """Returns CSV with all digits; columns have their titles as names."""
    titles = [column.title for column in columns]
    cells = ([column.value(row) for column in columns] for row in rows)
    return csv_table([titles, *cells])


def to_markdown(columns: Sequence[Column], rows: Sequence[Row]) -> str:
    """Returns a Markdown table with numbers aligned to the right, and the medians as
    last line."""
    cells = ([column.text(row) for column in columns] for row in rows)
    return markdown_table(
        [[column.title for column in columns], *cells],
        right=[column.digits is not None for column in columns],
        last=["median", *_medians(columns[1:], rows)] if len(rows) > 2 else (),
    )


def to_latex(columns: Sequence[Column], rows: Sequence[Row]) -> str:
    """Returns a `tabular` with rules of the package booktabs."""
    columns = [column for column in columns if not column.is_wide]
    form = "".join("r" if column.digits is not None else "l" for column in columns)
    line = lambda cells: " & ".join(map(latex_text, cells)) + r" \\"
    body = [line([column.text(row) for column in columns]) for row in rows]
    if len(rows) > 2:
        body += [r"\midrule", line(["median", *_medians(columns[1:], rows)])]
    return "\n".join(
        [
            rf"\begin{{tabular}}{{{form}}}",
            r"\toprule",
            line([column.title for column in columns]),
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
            "",
        ]
    )


def _medians(columns: Sequence[Column], rows: Sequence[Row]) -> list[str]:
    found = []
    for column in columns:
        values: list[float] = sorted(
            v for row in rows if _is_number(v := row.get(column.key))
        )
        if column.digits is None or not values:
            found.append("")
            continue
        half = len(values) // 2
        median = (values[half] + values[-half - 1]) / 2
        found.append(column.text({column.key: median}))
    return found


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, (int, float)) and math.isfinite(value)
