"""Writes the report of `bodyslam experiment table1`: our rows beside the paper's
values."""

import math
from collections.abc import Sequence
from pathlib import Path

from bodyslam_jax.experiments import figures, paper
from bodyslam_jax.experiments.comparison import METHODS
from bodyslam_jax.experiments.tables import (
    MM,
    Column,
    Row,
    intro,
    to_csv,
    write_tables,
    write_text,
)

_GROUPS = {"se3": "SE(3)", "sim3": "Sim(3)"}
_PAPER_METHODS = {"no_mm": "no MM", "full": "full"}
"""The methods that the paper compares."""
_PAPER_PREFIX = "paper:"
"""Prefix of the keys of the paper's values in our rows."""
_SEQUENCE_COLUMN = Column("sequence", "sequence")
_DETAIL_COLUMNS = [
    Column("frames", "frames", digits=0),
    Column("camera's RMS radius, m", "radius", digits=2),
    Column("C-ATE SE(3), % of it", "share", 100.0, 2),
    Column("start / true scale", "start_ratio", digits=3),
    Column("its standard error", "start_sigma", digits=3),
    Column("estimated / true scale", "scale_ratio", digits=3),
    Column("|1 − s|", "scale_error", digits=3),
    Column("leg / true leg", "full/leg_ratio", digits=3),
    Column("steps", "steps", digits=0),
    Column("status", "status"),
]
_DEGREES = 180 / math.pi
_PLAUSIBILITY_COLUMNS = [
    Column("gravity error, degrees", "full/gravity_error", _DEGREES, 2),
    *(
        Column(f"{title}{of}", f"full/{name}{whose}", factor, digits)
        for title, name, factor, digits in (
            ("standing foot, m/s", "foot_speed", 1.0, 2),
            ("feet over the ground, 5th percentile, mm", "feet_low", MM, 0),
            ("feet, 95th percentile, mm", "feet_high", MM, 0),
            ("joints' acceleration, m/s²", "joint_acceleration", 1.0, 1),
            ("knees, degrees", "knee", _DEGREES, 1),
            ("straighter knee, degrees", "straighter_knee", _DEGREES, 1),
        )
        for of, whose in (("", ""), (", truth", "_of_truth"))
    ),
]
"""Gravity, feet and posture of the full estimate."""


def write_table1(out: Path, rows: list[Row], *, about: str) -> list[Path]:
    """Writes table 1, details of its rows, and the baselines; the CSV contains all of
    them."""
    papers = [paper.table1_row(row["sequence"].split("-")[0]) for row in rows]
    rows = [_completed(*both) for both in zip(rows, papers, strict=True)]
    baselines = {name: METHODS[name] for name in METHODS if name not in _PAPER_METHODS}
    parts = []
    for family in dict.fromkeys(row["sequence"].split("-")[1] for row in rows):
        own = [row for row in rows if row["sequence"].endswith(family)]
        add = lambda what, columns, f=family, own=own: parts.append(
            (f"Family `{f}`{what}", [_SEQUENCE_COLUMN, *columns], own)
        )
        add(", after SE(3)", [*_beside("se3"), *_scales()])
        add(", after Sim(3)", _beside("sim3"))
        add(": behind it", _DETAIL_COLUMNS)
        add(": gravity, feet and knees, before smoothing", _PLAUSIBILITY_COLUMNS)
        for method, meaning in baselines.items():
            add(f": {meaning}", [*_errors(method), _scale(method)])
    head = intro(
        "Table 1: with and without a motion model",
        about,
        "Means over frames. `scale` is that of the Sim(3) alignment of the cameras "
        "(truth per estimate, best 1); without a motion model it is the unit of the "
        "reconstruction, hence arbitrary. "
        + "; ".join(f"`{name}`: {meaning}" for name, meaning in METHODS.items())
        + ".",
    )
    written = write_tables(out, "table1", head, parts, about)
    columns = [_SEQUENCE_COLUMN, *_beside("se3"), *_beside("sim3"), *_scales()]
    for method in baselines:
        columns += [*_errors(method, f" {method}"), _scale(method, f" {method}")]
    write_text(
        out / "table1.csv",
        to_csv([*columns, *_DETAIL_COLUMNS, *_PLAUSIBILITY_COLUMNS], rows, about),
    )
    figures.draw_table(out / "table1.png", rows, papers, about)
    figures.draw_paths(out / "table1_paths.png", rows, about)
    return [*written, out / "table1.png", out / "table1_paths.png"]


def _completed(row: Row, theirs: Row) -> Row:
    """Returns a row with derived values and the paper's values added."""
    scale, error = row["full/scale"], row["full/c_ate_se3"]  # `None`: not finite
    return {
        **row,
        "scale_error": None if scale is None else abs(1 - scale),
        "share": None if error is None or not row["radius"] else error / row["radius"],
        **{_PAPER_PREFIX + name: value for name, value in theirs.items()},
    }


def _beside(group: str) -> list[Column]:
    """Returns the columns of C-, H- and J-ATE without and with a motion model, each
    beside the paper's, mm."""
    return [
        Column(f"{whose}{error.upper()}-ATE {_GROUPS[group]} {short}, mm", key, MM)
        for error in "chj"
        for method, short in _PAPER_METHODS.items()
        for whose, key in _ours_and_theirs(f"{method}/{error}_ate_{group}")
    ]


def _scales() -> list[Column]:
    return [
        Column(f"{whose}scale {short}", key, digits=3)
        for method, short in _PAPER_METHODS.items()
        for whose, key in _ours_and_theirs(f"{method}/scale")
    ]


def _ours_and_theirs(key: str) -> tuple[tuple[str, str], tuple[str, str]]:
    return ("", key), ("the paper's ", _PAPER_PREFIX + key)


def _errors(method: str, label: str = "") -> Sequence[Column]:
    """Returns the columns of C-, H- and J-ATE of one method, mm."""
    return [
        Column(f"{e.upper()}-ATE {name}{label}, mm", f"{method}/{e}_ate_{group}", MM)
        for group, name in _GROUPS.items()
        for e in "chj"
    ]


def _scale(method: str, label: str = "") -> Column:
    return Column(f"scale{label}", f"{method}/scale", digits=3)
