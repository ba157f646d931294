"""Draws figures in the form of the paper's, as PNG.

`about`, a description of the data, is printed below each figure.
"""

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Row = Mapping[str, Any]
_BASELINE_COLOUR, _ESTIMATE_COLOUR, _TRUTH_COLOUR = "#c96a3d", "#2f6f9f", "#444444"
_PAPER_STYLE: dict[str, Any] = {
    "ls": "",
    "marker": "o",
    "markeredgecolor": "k",
    "markersize": 4,
    "label": "the paper's, its own data",
}
"""Style of the paper's values, drawn in the colour of ours."""
_LETTERS_PER_INCH = 17
"""Number of letters of the smallest font per inch."""
_MAX_DRAWN_DEVIATION = 0.25
"""Deviation of a ratio from 1 above which its value is printed instead of drawn to
scale."""


def _figure(width: float, height: float):
    from matplotlib.figure import Figure  # takes half a second to import

    return Figure((width, height), layout="constrained")


def _legend(figure, axes, title: str, columns: int = 3):
    """Adds one legend for all `axes`, outside them."""
    entries = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    figure.legend(
        entries.values(),
        entries.keys(),
        ncols=columns,
        fontsize=8,
        title=title,
        title_fontsize=9,
        loc="outside upper center",
    )


def _save(figure, path: Path, about: str) -> None:
    """Writes a figure with a description of its data below it, so that it can stand
    alone."""
    line = int(_LETTERS_PER_INCH * figure.get_figwidth())
    figure.supxlabel(textwrap.fill(about, line), fontsize=7, color=_TRUTH_COLOUR)
    figure.savefig(path, dpi=110)


def log_limits_mm(values: Sequence[float]) -> tuple[float, float]:
    """Returns the lower and upper limit of a logarithmic axis for errors in mm.

    The lower limit is 1 mm, or the next lower power of ten below the least error.
    """
    finite = np.array(values, float)
    finite = finite[np.isfinite(finite) & (finite > 0)]
    if not finite.size:
        return 1.0, 10.0
    low = 10.0 ** np.floor(np.log10(0.99 * finite.min()))
    return min(1.0, low), max(10.0, 1.5 * finite.max())


def draw_table(
    path: Path, rows: Sequence[Row], paper: Sequence[Row | None], about: str
) -> None:
    """Draws C-, H- and J-ATE after SE(3) alignment, and the scale, for each sequence.

    Our errors are bars, the paper's are dots. `paper` has the paper's row for each of
    `rows`, or `None`.
    """
    figure = _figure(max(7.0, 1.5 + 0.55 * len(rows)), 7.5)
    axes = figure.subplots(4, 1, sharex=True)
    at = np.arange(len(rows))
    published = [(k, p) for k, p in enumerate(paper) if p is not None]
    methods = (
        (-0.2, "no_mm", _BASELINE_COLOUR, "no motion model"),
        (0.2, "full", _ESTIMATE_COLOUR, "full"),
    )
    names = ("c_ate_se3", "h_ate_se3", "j_ate_se3")
    labels = ("C-ATE, mm", "H-ATE, mm", "J-ATE, mm")
    for axis, name, label in zip(axes, names, labels, strict=False):
        drawn: list[float] = []
        for shift, method, color, meaning in methods:
            key = f"{method}/{name}"
            ours = [1e3 * (row.get(key) or np.nan) for row in rows]
            theirs = [1e3 * p[key] for _, p in published]
            axis.bar(at + shift, ours, 0.4, color=color, label=meaning)
            axis.plot(
                [k + shift for k, _ in published], theirs, color=color, **_PAPER_STYLE
            )
            drawn += [*ours, *theirs]
        axis.set(ylabel=label, yscale="log", ylim=log_limits_mm(drawn))
        axis.grid(axis="y", alpha=0.3)
    scale = axes[3]
    scale.axhline(1, color=_TRUTH_COLOUR, lw=1)
    full = [r.get("full/scale") or np.nan for r in rows]
    scale.plot(at, full, "s", color=_ESTIMATE_COLOUR, label="scale, full")
    start = [1 / r["start_ratio"] if r.get("start_ratio") else np.nan for r in rows]
    scale.plot(at, start, "x", color=_TRUTH_COLOUR, label="scale, closed form")
    theirs = [p["full/scale"] for _, p in published]
    scale.plot(
        [k + 0.2 for k, _ in published], theirs, color=_ESTIMATE_COLOUR, **_PAPER_STYLE
    )
    scale.set(ylabel="scale (best 1)", xlabel="sequence", xlim=(-0.6, len(rows) - 0.4))
    scale.grid(axis="y", alpha=0.3)
    scale.set_xticks(at, [str(r["sequence"]) for r in rows], rotation=60, fontsize=8)
    _legend(figure, axes, "simulated sequences, after SE(3)")
    _save(figure, path, about)


def draw_paths(path: Path, rows: Sequence[Row], about: str) -> None:
    """Draws top views of camera and human centres after SE(3) alignment, as in the
    paper's appendix."""
    rows = [row for row in rows if row.get("paths")]
    if not rows:
        return
    figure = _figure(8.0, 3.4 * len(rows))
    axes = figure.subplots(len(rows), 2, squeeze=False)
    for row, pair in zip(rows, axes, strict=True):
        for axis, what in zip(pair, ("camera", "human"), strict=True):
            drawn = (
                ("no_mm", _BASELINE_COLOUR),
                ("full", _ESTIMATE_COLOUR),
                ("truth", _TRUTH_COLOUR),
            )
            for name, color in drawn:
                points = np.array(row["paths"][f"{what}/{name}"], float)
                label = {"no_mm": "no motion model"}.get(name, name)
                axis.plot(*points.T, color=color, lw=1.2, label=label)
            axis.set(title=f"{row['sequence']}: {what}", xlabel="x, m", ylabel="z, m")
            axis.set_aspect("equal", adjustable="datalim")
    _legend(figure, [axes[0, 0]], "simulated, from above, after SE(3)")
    _save(figure, path, about)


def draw_scale(path: Path, rows: Sequence[Row], about: str) -> None:
    """Draws H-ATE after SE(3) alignment, and the ratio of the estimated to the correct
    scale, after each iteration.

    The correct scale is the perturbation 1/s'; there is one curve for each.
    """
    figure = _figure(9.0, 3.0 * len(rows))
    axes = figure.subplots(len(rows), 2, squeeze=False, sharex=True)
    for row, (left, right) in zip(rows, axes, strict=True):
        for i, p in enumerate(row["perturbation"]):
            left.plot(1e3 * np.array(row["h_ate"][i], float), label=f"1/s' = {p:g}")
            right.plot(np.array(row["history"][i], float) / p)
        left.set(ylabel=f"{row['sequence']}: H-ATE, mm", yscale="log")
        right.set(ylabel="s / (1/s')", yscale="log")
        right.axhline(1, color=_TRUTH_COLOUR, lw=0.8)
        for axis in (left, right):
            axis.grid(alpha=0.3)
    for axis in axes[-1]:
        axis.set_xlabel("iteration")
    _legend(figure, [axes[0, 0]], "simulated", columns=6)
    _save(figure, path, about)


def draw_variants(path: Path, rows: Sequence[Row], about: str) -> None:
    """Draws C- and J-ATE after SE(3) alignment, and estimated over true scale, with one
    line for each variant."""
    figure = _figure(11.0, max(2.4, 1.2 + 0.28 * len(rows)))
    figure.suptitle(f"{rows[0]['sequence']}, simulated", fontsize=10)
    *errors, scale = figure.subplots(1, 3, sharey=True)
    at = np.arange(len(rows))[::-1]
    for axis, name in zip(errors, ("c_ate_se3", "j_ate_se3"), strict=True):
        value = [1e3 * (row.get(name) or np.nan) for row in rows]
        axis.barh(at, value, color=_ESTIMATE_COLOUR)
        label = f"{name[0].upper()}-ATE, SE(3), mm"
        axis.set(xlabel=label, xscale="log", xlim=log_limits_mm(value))
    ratio = np.array([row.get("scale_ratio") for row in rows], float)
    draw_ratios(scale, at, ratio)
    scale.set(xlabel="estimated / true scale")
    for axis in (*errors, scale):
        axis.grid(axis="x", alpha=0.3)
    for y, row in zip(at, rows, strict=True):
        if row.get("c_ate_se3") is None:
            where = errors[0].get_yaxis_transform()
            status = "none" if "c_ate_se3" in row else str(row.get("status"))
            errors[0].text(0.02, y, status, transform=where, fontsize=7, va="center")
    errors[0].set_yticks(at, [str(row["label"]) for row in rows], fontsize=8)
    errors[0].set_ylim(-0.7, len(rows) - 0.3)
    _save(figure, path, about)


def draw_ratios(axis, at: np.ndarray, ratio: np.ndarray) -> None:
    """Draws ratios as deviations from 1; those beyond `_MAX_DRAWN_DEVIATION` are
    printed as numbers at the end of the axis."""
    off = np.abs(ratio - 1)
    near = off <= _MAX_DRAWN_DEVIATION
    end = 1.1 * max(off[near].max(initial=0.0), 0.05)
    axis.axvline(1, color=_TRUTH_COLOUR, lw=1)
    axis.hlines(at[near], 1, ratio[near], color=_ESTIMATE_COLOUR, lw=1)
    axis.plot(ratio[near], at[near], "o", color=_ESTIMATE_COLOUR, markersize=4)
    for y, value in zip(
        at[off > _MAX_DRAWN_DEVIATION], ratio[off > _MAX_DRAWN_DEVIATION], strict=True
    ):
        side = np.sign(value - 1)
        mark = ">" if side > 0 else "<"
        axis.plot(1 + 0.97 * side * end, y, mark, color=_BASELINE_COLOUR, markersize=5)
        axis.text(
            1 + 0.9 * side * end,
            y,
            f"{value:.2f}",
            fontsize=7,
            va="center",
            ha="right" if side > 0 else "left",
        )
    axis.set_xlim(1 - end, 1 + end)


def draw_structure(
    path: Path, rows: Sequence[Row], paper: Sequence[Row | None], about: str
) -> None:
    """Draws the C-ATE of the perturbed cameras, and after optimisation without and with
    landmarks."""
    figure = _figure(max(6.0, 1.5 + 1.1 * len(rows)), 3.4)
    axis = figure.subplots()
    stages = ("perturbed", "no_landmarks", "landmarks")
    colors = ("#999999", _BASELINE_COLOUR, _ESTIMATE_COLOUR)
    drawn: list[float] = []
    for k, (stage, color) in enumerate(zip(stages, colors, strict=True)):
        at = np.arange(len(rows)) + 0.27 * (k - 1)
        ours = [1e3 * (row.get(stage) or np.nan) for row in rows]
        axis.bar(at, ours, 0.25, color=color, label=stage.replace("_", " "))
        theirs = [(x, 1e3 * p[stage]) for x, p in zip(at, paper, strict=True) if p]
        axis.plot(
            [x for x, _ in theirs], [v for _, v in theirs], color=color, **_PAPER_STYLE
        )
        drawn += [*ours, *(v for _, v in theirs)]
    axis.set(ylabel="C-ATE, SE(3), mm", yscale="log", ylim=log_limits_mm(drawn))
    axis.set_xticks(np.arange(len(rows)), [str(row["sequence"]) for row in rows])
    _legend(figure, [axis], "simulated", columns=4)
    _save(figure, path, about)
