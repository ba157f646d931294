"""Pictures like the paper's, of simulated sequences."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Row = Mapping[str, Any]
_BASELINE, _OURS, _TRUTH = "#c96a3d", "#2f6f9f", "#444444"


def _figure(width: float, height: float):
    from matplotlib.figure import Figure  # takes half a second to import

    return Figure((width, height), layout="constrained")


def draw_table(path: Path, rows: Sequence[Row], paper: Sequence[Row | None]) -> None:
    """C-, H- and J-ATE under SE(3) by sequence, and the scale: bars, the paper's dots.

    `paper` has the paper's row for each of ours, or `None`.
    """
    figure = _figure(max(7.0, 1.5 + 0.55 * len(rows)), 7.5)
    axes = figure.subplots(4, 1, sharex=True)
    at = np.arange(len(rows))
    names = ("c_ate_se3", "h_ate_se3", "j_ate_se3")
    labels = ("C-ATE, mm", "H-ATE, mm", "J-ATE, mm")
    for axis, name, label in zip(axes, names, labels, strict=False):
        value = lambda method, name=name: [
            1e3 * (row.get(f"{method}/{name}") or np.nan) for row in rows
        ]
        axis.bar(
            at - 0.2, value("no_mm"), 0.4, color=_BASELINE, label="no motion model"
        )
        axis.bar(at + 0.2, value("full"), 0.4, color=_OURS, label="full")
        for shift, method, color in ((-0.2, "no_mm", _BASELINE), (0.2, "full", _OURS)):
            known = [(k, p) for k, p in enumerate(paper) if p is not None]
            axis.plot(
                [k + shift for k, _ in known],
                [1e3 * p[f"{method}/{name}"] for _, p in known],
                "o",
                color=color,
                markeredgecolor="k",
                markersize=4,
                label="the paper's, its own data" if method == "full" else None,
            )
        axis.set(ylabel=label, yscale="log", ylim=(1, None))
        axis.grid(axis="y", alpha=0.3)
    axes[0].set_title("simulated sequences, after SE(3)", fontsize=10)
    axes[0].legend(ncols=3, fontsize=7, loc="upper left")
    scale = axes[3]
    scale.axhline(1, color=_TRUTH, lw=1)
    scale.plot(at, [r.get("full/scale") or np.nan for r in rows], "s", color=_OURS)
    start = [1 / r["start_ratio"] if r.get("start_ratio") else np.nan for r in rows]
    scale.plot(at, start, "x", color=_TRUTH, label="closed form")
    scale.set(ylabel="scale (best 1)", xlabel="sequence")
    scale.legend(fontsize=8)
    scale.set_xticks(at, [str(r["sequence"]) for r in rows], rotation=60, fontsize=8)
    figure.savefig(path, dpi=110)


def draw_paths(path: Path, rows: Sequence[Row]) -> None:
    """Cameras and human centres from above after SE(3), as the paper's appendix."""
    rows = [row for row in rows if row.get("paths")]
    if not rows:
        return
    figure = _figure(8.0, 3.4 * len(rows))
    axes = figure.subplots(len(rows), 2, squeeze=False)
    for row, pair in zip(rows, axes, strict=True):
        for axis, what in zip(pair, ("camera", "human"), strict=True):
            drawn = (("no_mm", _BASELINE), ("full", _OURS), ("truth", _TRUTH))
            for name, color in drawn:
                points = np.array(row["paths"][f"{what}/{name}"], float)
                label = {"no_mm": "no motion model"}.get(name, name)
                axis.plot(*points.T, color=color, lw=1.2, label=label)
            axis.set(title=f"{row['sequence']}: {what}", xlabel="x, m", ylabel="z, m")
            axis.set_aspect("equal", adjustable="datalim")
    axes[0, 0].legend(fontsize=8)
    figure.savefig(path, dpi=110)


def draw_scale(path: Path, rows: Sequence[Row]) -> None:
    """H-ATE under SE(3), and s over what it should be, after each iteration."""
    figure = _figure(9.0, 3.0 * len(rows))
    axes = figure.subplots(len(rows), 2, squeeze=False, sharex=True)
    for row, (left, right) in zip(rows, axes, strict=True):
        for i, p in enumerate(row["perturbation"]):
            left.plot(1e3 * np.array(row["h_ate"][i], float), label=f"1/s' = {p:g}")
            right.plot(np.array(row["history"][i], float) / p)
        left.set(ylabel=f"{row['sequence']}: H-ATE, mm", yscale="log")
        right.set(ylabel="s / (1/s')", yscale="log")
        right.axhline(1, color=_TRUTH, lw=0.8)
        for axis in (left, right):
            axis.grid(alpha=0.3)
    for axis in axes[-1]:
        axis.set_xlabel("iteration")
    axes[0, 0].legend(fontsize=8, title="simulated")
    figure.savefig(path, dpi=110)


def draw_bars(
    path: Path, rows: Sequence[Row], names: Sequence[tuple[str, str, float]]
) -> None:
    """One panel a measure, one bar a row; `names` are key, label, factor."""
    figure = _figure(3.2 * len(names) + 2, 0.6 + 0.28 * len(rows))
    axes = np.atleast_1d(figure.subplots(1, len(names), sharey=True))
    at = np.arange(len(rows))[::-1]
    for axis, (key, label, factor) in zip(axes, names, strict=True):
        found = [row.get(key) for row in rows]
        value = [np.nan if v is None else factor * v for v in found]
        axis.barh(at, value, color=_OURS)
        axis.set(xlabel=label)
        axis.grid(axis="x", alpha=0.3)
    axes[0].set_yticks(at, [str(row["label"]) for row in rows], fontsize=8)
    figure.savefig(path, dpi=110)


def draw_structure(
    path: Path, rows: Sequence[Row], paper: Sequence[Row | None]
) -> None:
    """C-ATE of the shaken cameras, and after both optimisations."""
    figure = _figure(max(6.0, 1.5 + 1.1 * len(rows)), 3.4)
    axis = figure.subplots()
    stages = ("perturbed", "no_landmarks", "landmarks")
    colors = ("#999999", _BASELINE, _OURS)
    for k, (stage, color) in enumerate(zip(stages, colors, strict=True)):
        at = np.arange(len(rows)) + 0.27 * (k - 1)
        value = [1e3 * (row.get(stage) or np.nan) for row in rows]
        axis.bar(at, value, 0.25, color=color, label=stage.replace("_", " "))
        known = [(x, p[stage]) for x, p in zip(at, paper, strict=True) if p]
        label = "the paper's, its own data" if k == 2 else None
        axis.plot(
            [x for x, _ in known],
            [1e3 * v for _, v in known],
            "o",
            color=color,
            markeredgecolor="k",
            markersize=4,
            label=label,
        )
    axis.set(ylabel="C-ATE, SE(3), mm", yscale="log")
    axis.set_xticks(np.arange(len(rows)), [str(row["sequence"]) for row in rows])
    where = "outside upper center"
    figure.legend(fontsize=8, ncols=4, title="simulated", loc=where)
    figure.savefig(path, dpi=110)


def draw_learning(path: Path, row: Row) -> None:
    """The error on the training sequences by step, and the weights on the way."""
    figure = _figure(9.0, 3.0)
    left, right = figure.subplots(1, 2)
    left.plot(row["history"], "o-", color=_OURS)
    left.set(xlabel="step", ylabel="training error, 1")
    for name, values in zip(row["names"], np.array(row["path"]).T, strict=True):
        right.plot(values, label=name)
    right.set(xlabel="step", ylabel="log of the factor on σ")
    right.legend(fontsize=7)
    figure.savefig(path, dpi=110)
