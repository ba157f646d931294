"""Plots a sweep: over each axis, and as maps over the first two."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bodyslam_jax.batch.grid import Axis
from bodyslam_jax.batch.table import Column, Row

_PANEL_SIZE_IN = (3.2, 2.4)
"""Width and height of a panel."""
_MAX_SEPARATE_CLIPS = 8
"""Number of clips up to which each is drawn; more are represented by their median."""
_MAX_FIGURES = 4
"""Number of figures that are drawn at most."""


def draw(
    path: Path, rows: Sequence[Row], axes: Sequence[Axis], columns: Sequence[Column]
) -> None:
    """Draws a row of panels for each axis, with the medians over the other axes; then
    maps over the first two axes, of the median over clips."""
    from matplotlib.figure import Figure  # takes half a second to import

    names = {axis.name for axis in axes}
    drawn = [c for c in columns if c.digits is not None and c.key not in names]
    drawn = [c for c in drawn if c.key != "iterations"]
    # Cost, scale and camera path, and the first error.
    drawn = drawn[:_MAX_FIGURES]
    several = [axis for axis in axes if len(axis.values) > 1] or list(axes[:1])
    down = len(several) + (len(several) > 1)
    size = (_PANEL_SIZE_IN[0] * len(drawn), _PANEL_SIZE_IN[1] * down)
    figure = Figure(size, layout="constrained")
    panels = figure.subplots(down, len(drawn), squeeze=False)
    for line, axis in zip(panels, several, strict=False):
        for panel, column in zip(line, drawn, strict=True):
            _lines(panel, rows, axis, column)
    if len(several) > 1:
        for panel, column in zip(panels[-1], drawn, strict=True):
            _map(figure, panel, rows, several[0], several[1], column)
    figure.savefig(path, dpi=110)


def _lines(panel, rows: Sequence[Row], axis: Axis, column: Column) -> None:
    """Draws a line for each clip, through the medians over all other axes."""
    clips = list(dict.fromkeys(str(row["name"]) for row in rows))
    apart = clips if len(clips) <= _MAX_SEPARATE_CLIPS else [None]
    places = _places(axis)
    for clip in apart:
        chosen = [row for row in rows if clip in (None, row["name"])]
        values = [
            _median(column, [row for row in chosen if _is_at(row, axis, value)])
            for value in axis.values
        ]
        panel.plot(places, values, "o-", ms=3, lw=1, label=clip)
    _scale(panel.set_xscale, panel.set_xticks, axis)
    panel.set(xlabel=axis.name, ylabel=column.title)
    if 1 < len(apart):
        panel.legend(fontsize=5)
    panel.spines[["top", "right"]].set_visible(False)


def _map(
    figure, panel, rows: Sequence[Row], first: Axis, second: Axis, column: Column
) -> None:
    values = [
        [
            _median(
                column,
                [r for r in rows if _is_at(r, first, x) and _is_at(r, second, y)],
            )
            for x in first.values
        ]
        for y in second.values
    ]
    image = panel.imshow(values, origin="lower", aspect="auto", cmap="viridis")
    panel.set_xticks(range(len(first.values)), first.values, fontsize=7)
    panel.set_yticks(range(len(second.values)), second.values, fontsize=7)
    panel.set(xlabel=first.name, ylabel=second.name, title=column.title)
    panel.title.set_size(8)
    figure.colorbar(image, ax=panel)


def _is_at(row: Row, axis: Axis, value: str) -> bool:
    found = row.get(axis.name)
    return found == (value if axis.is_setting else float(value))


def _median(column: Column, rows: Sequence[Row]) -> float:
    values = [v for row in rows if (v := column.value(row)) is not None]
    return float(np.median(values)) if values else np.nan


def _places(axis: Axis) -> list[float]:
    """Returns the values as numbers; their ranks, if a value is not a number."""
    try:
        return [float(value) for value in axis.values]
    except ValueError:
        return [float(k) for k in range(len(axis.values))]


def _scale(set_scale, set_ticks, axis: Axis) -> None:
    places = _places(axis)
    if places != [float(k) for k in range(len(places))] and min(places) > 0:
        if max(places) >= 5 * min(places):
            set_scale("log")
    set_ticks(places, axis.values, minor=False)
    set_ticks([], minor=True)
