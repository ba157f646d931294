"""Writes the report of `bodyslam experiment video`: tables with standard errors of
means."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bodyslam_jax.evaluation import FIGURES
from bodyslam_jax.experiments.tables import (
    MM,
    Column,
    Row,
    intro,
    markdown,
    to_csv,
    write_text,
)
from bodyslam_jax.experiments.video import INPUTS

_CM = 100.0
_DEGREES = math.degrees(1.0)
_FIGURES = (
    Column("found, % of frames", "found", 100.0, 0),
    Column("C-ATE SE(3), mm", "c_ate_se3", MM),
    Column("C-ATE Sim(3), mm", "c_ate_sim3", MM),
    Column("H-ATE SE(3), mm", "h_ate_se3", MM),
    Column("H-ATE Sim(3), mm", "h_ate_sim3", MM),
    Column("J-ATE SE(3), mm", "j_ate_se3", MM),
    Column("J-ATE Sim(3), mm", "j_ate_sim3", MM),
    Column("scale (truth per estimate)", "scale", digits=3),
    Column("|1 - scale|", "scale_error", digits=3),
    Column("leg / true leg", "size", digits=3),
    Column("PA-MPJPE, mm", "pa_mpjpe", MM),
    Column("standing foot, m/s", "foot_speed", digits=2),
    Column("lowest point over the ground, 5th percentile, cm", "feet_low", _CM),
    Column("95th percentile, cm", "feet_high", _CM),
    Column("knees, degrees", "knee", _DEGREES),
    Column("straighter knee, degrees", "straighter_knee", _DEGREES),
    Column("joints' acceleration, m/s²", "joint_acceleration"),
    Column("gravity error, degrees", "gravity_error", _DEGREES, 2),
)
_OTHER = (
    " The first person does what `motion` says (a CMU trial, played forwards and "
    "backwards), a second one walks. Neither the posture prior nor the lifting network "
    "that ship learnt from the people of these trials."
)
_TRUTH_FIGURES = {name: f"{name}_of_truth" for name in FIGURES}
"""Keys of the figures that are computed for the truth as well."""


def write_video(out: Path, rows: list[Row], *, about: str) -> list[Path]:
    """Writes `video.md` and `video.csv`: means, every sequence, the detector's
    keypoints.

    Rows of people who do something else than walk are written to `video-other.md` and
    `.csv` beside these.
    """
    rows = [
        row | {"scale_error": None if row["scale"] is None else abs(1 - row["scale"])}
        for row in rows
    ]
    others = [Column("motion", "motion")] if any("motion" in r for r in rows) else []
    title = "From pixels alone, beside simulated keypoints and bodies"
    text = intro(
        f"{title}: other motion than walking" if others else title,
        about,
        "People in clothes are rendered; in medium sequences (M) furniture hides them "
        "for a while, in difficult ones (D) there is a second person and a rolling "
        "shutter. All inputs are the same video and camera.json; `pixels`: nothing "
        "else, people are found by the networks that ship; `keypoints`: simulated "
        "keypoints, noise as above; `bodies`: these and bodies as of a regressor. "
        "Means over sequences ± their standard errors. Errors are means over frames; "
        "the lowest point is the lowest of ankles and toes, the standing foot the "
        "lower of both in each frame (horizontal, median)."
        + (_OTHER if others else ""),
    )
    families = dict.fromkeys(row["sequence"].split("-")[1] for row in rows)
    for family in families:
        own = [row for row in rows if row["sequence"].endswith(family)]
        text += f"## Family `{family}`: means\n\n{_summary(own)}\n"
    for family in families:
        own = [row for row in rows if row["sequence"].endswith(family)]
        columns = [Column("sequence", "sequence"), *others, Column("input", "input")]
        columns += [*_FIGURES, Column("status", "status")]
        text += f"## Family `{family}`: every sequence\n\n{markdown(columns, own)}\n"
    text += f"## The detector's keypoints\n\n{keypoint_table(rows)}"
    name = "video-other" if others else "video"
    write_text(out / f"{name}.md", text)
    columns = [Column("sequence", "sequence"), *others, Column("input", "input")]
    columns += _FIGURES
    columns += [Column(f"true {c.title}", _TRUTH_FIGURES[c.key], c.factor, c.digits)
                for c in _FIGURES if c.key in _TRUTH_FIGURES]  # fmt: skip
    write_text(out / f"{name}.csv", to_csv(columns, rows, about))
    return [out / f"{name}.md", out / f"{name}.csv"]


def _summary(rows: Sequence[Row]) -> str:
    """Returns a table with a line for each figure, and a column for each input and the
    truth."""
    columns = [Column("", "what"), *(Column(name, name) for name in INPUTS)]
    columns.append(Column("truth", "truth"))
    lines = []
    for figure in _FIGURES:
        of = lambda which, f=figure: [r.get(f.key) for r in rows if r["input"] == which]
        line: Row = {"what": figure.title}
        line |= {which: _mean(of(which), figure) for which in INPUTS}
        if figure.key in _TRUTH_FIGURES:
            once = {r["sequence"]: r[_TRUTH_FIGURES[figure.key]] for r in rows}
            line["truth"] = _mean(list(once.values()), figure)
        lines.append(line)
    count = {w: sum(r["input"] == w for r in rows) for w in INPUTS}
    lines.append({"what": "sequences", **{w: str(n) for w, n in count.items()}})
    return markdown(columns, lines)


def _mean(values: Sequence[float | None], column: Column) -> str | None:
    """Returns text such as `43.7 ± 6.7`, and the number of rows that lack the figure,
    if any."""
    finite = [v for v in values if v is not None and math.isfinite(v)]
    numbers = np.array(finite, float) * column.factor
    if not len(numbers):
        return None
    d = column.digits
    text = f"{numbers.mean():.{d}f}"
    if len(numbers) > 1:
        text += f" ± {numbers.std(ddof=1) / math.sqrt(len(numbers)):.{d}f}"
    missing = len(values) - len(numbers)
    return text + (f" ({missing} without)" if missing else "")


def keypoint_table(rows: Sequence[Row]) -> str:
    """Returns a table of mean offsets, averaged over both sides, % of the stature."""
    found = [row["keypoints"] for row in rows if row.get("keypoints")]
    if not found:
        return "Nobody was found.\n"
    names = dict.fromkeys(
        n.removeprefix("left_").removeprefix("right_") for n in found[0]
    )
    axes = ("out", "up", "forward")
    columns = [
        Column("keypoint", "name"),
        *(Column(f"{axis}, %", axis) for axis in axes),
        Column("spread in the image, %", "spread"),
        Column("given, %", "seen"),
        Column("of something else, %", "gross"),
    ]
    lines = []
    for name in names:
        own = [
            value for one in found for key, value in one.items()
            if key.removeprefix("left_").removeprefix("right_") == name
        ]  # fmt: skip
        of = lambda read, own=own: _mean(
            [read(v) for v in own], Column("", "", 100.0, 1)
        )
        line: Row = {"name": name}
        for i, axis in enumerate(axes):
            line[axis] = of(lambda v, i=i: v["offset"][i])
        line |= {k: of(lambda v, k=k: v[k]) for k in ("spread", "seen", "gross")}
        lines.append(line)
    return (
        "Error of each keypoint against the joint or vertex that it is taken for, in "
        "the frame of the joint that it moves with, % of the stature (out: away from "
        "the body's middle plane; both sides together; ± the standard error over "
        "sequences and sides). Forward is known only where the view changes.\n\n"
        + markdown(columns, lines)
    )
