"""Plots distributions over the clips of a batch, as one PNG."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from bodyslam_jax.batch.rows import STATUS_ORDER
from bodyslam_jax.batch.table import Column, Row

_STATUS_COLOURS: dict[str, str] = dict(
    zip(
        STATUS_ORDER,
        ("#4c956c", "#e0a030", "#c4553b", "#7a3b2e", "#b0b0b0"),
        strict=True,
    )
)
_OMITTED_COLUMNS = ("frames", "people")
_PANEL_SIZE_IN = (3.2, 2.4)
"""Width and height of a panel."""
_MAX_PANELS_ACROSS = 4


def draw(path: Path, rows: Sequence[Row], columns: Sequence[Column]) -> None:
    """Draws the number of clips of each status, and the sorted values of each figure.

    A dot is a clip, in the colour of its status.
    """
    from matplotlib.figure import Figure  # takes half a second to import

    drawn = [
        column
        for column in columns
        if column.digits is not None
        and column.key not in _OMITTED_COLUMNS
        and sum(column.value(row) is not None for row in rows) > 1
    ]
    count = len(drawn) + 1
    across = min(_MAX_PANELS_ACROSS, count)
    down = -(-count // across)
    figure = Figure(
        (_PANEL_SIZE_IN[0] * across, _PANEL_SIZE_IN[1] * down), layout="constrained"
    )
    axes = np.atleast_1d(figure.subplots(down, across, squeeze=False).ravel())
    _statuses(axes[0], rows)
    for axis, column in zip(axes[1:], drawn, strict=False):
        _sorted(axis, column, rows)
    for axis in axes[count:]:
        axis.set_visible(False)
    figure.savefig(path, dpi=110)


def _statuses(axis, rows: Sequence[Row]) -> None:
    counts = Counter(str(row["status"]) for row in rows)
    names = [name for name in STATUS_ORDER if counts[name]]
    bars = axis.barh(
        names,
        [counts[name] for name in names],
        color=[_STATUS_COLOURS[name] for name in names],
    )
    axis.bar_label(bars, padding=2)
    axis.invert_yaxis()
    axis.margins(x=0.15)
    axis.set(xlabel=f"of {len(rows)} clips")
    axis.spines[["top", "right"]].set_visible(False)


def _sorted(axis, column: Column, rows: Sequence[Row]) -> None:
    """Draws values against the share of clips that have smaller ones."""
    having = [row for row in rows if column.value(row) is not None]
    having.sort(key=column.value)
    values = [column.value(row) for row in having]
    share = (np.arange(len(values)) + 0.5) / len(values)
    colours = [_STATUS_COLOURS.get(str(row["status"]), "#444444") for row in having]
    axis.plot(values, share, color="#cccccc", lw=1, zorder=1)
    axis.scatter(values, share, s=12, c=colours, zorder=2)
    axis.axhline(0.5, color="#dddddd", lw=0.8, zorder=0)
    median = float(np.median(values))
    axis.set(
        xlabel=column.title,
        ylabel="share of clips",
        ylim=(0, 1),
        title=f"median {median:.{column.digits}f}",
    )
    axis.title.set_size(9)
    axis.spines[["top", "right"]].set_visible(False)
