"""Writes one table, plots and a page for all run folders in a folder (`collect`).

`index.html` of a batch is a sortable table with overlays and links to reports. It opens
from disk, without network. Images and overlays are files beside it that the browser
loads when they come into view or are pointed at. Plots have distributions over the
clips of a batch, or over each axis of a sweep, with maps over the first two.
"""

import html
import logging
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from urllib.parse import quote

import numpy as np

from bodyslam_jax.batch import rows
from bodyslam_jax.batch.grid import Axis
from bodyslam_jax.batch.inputs import RUNS_FOLDER
from bodyslam_jax.batch.rows import STATUS_ORDER, Column, Row
from bodyslam_jax.config.errors import InputError, error_line
from bodyslam_jax.io import atomic

log = logging.getLogger(__name__)
_WRITTEN_FILES = ("table.csv", "table.md", "table.tex", "plots.png", "index.html")
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
_MAX_SEPARATE_CLIPS = 8
"""Number of clips up to which each is drawn; more are represented by their median."""
_MAX_FIGURES = 4
"""Number of figures that are drawn at most."""


def collect(folder: str | Path) -> list[Path]:
    """Writes `table.csv`, `.md` and `.tex`, `plots.png` and `index.html` into a folder
    of run folders, and returns their paths.

    Clips that failed or have not been run are listed with the reason. A record that
    cannot be read is left out, with a warning that names it.

    **Raises:** `InputError` if there are no run folders, or a folder has the name of a
    file to be written.
    """
    folder = Path(folder)
    for name in _WRITTEN_FILES:
        if (folder / name).is_dir():
            raise InputError(
                f"{folder / name}: a folder of the name of a file that is written; "
                f"move run folders into {folder / RUNS_FOLDER}."
            )
    found = rows.read_rows(folder)
    columns = rows.present(rows.columns(), found)
    written = write_tables(folder, columns, found)
    draw(folder / "plots.png", found, columns)
    write_index(folder, found, columns, _thumbnails(folder, found))
    return [*written, folder / "plots.png", folder / "index.html"]


def write_tables(
    folder: Path, columns: list[rows.Column], found: list[rows.Row]
) -> list[Path]:
    """Writes a table in three formats, and returns their paths."""
    forms = {
        "csv": rows.to_csv,
        "md": rows.to_markdown,
        "tex": rows.to_latex,
    }
    for suffix, form in forms.items():
        atomic.write_text(folder / f"table.{suffix}", form(columns, found))
    return [folder / f"table.{suffix}" for suffix in forms]


def _thumbnails(folder: Path, found: list[rows.Row]) -> dict[str, str]:
    """Writes still images of the overlays, and returns their paths by the clip's
    name."""
    from bodyslam_jax.view.video_file import write_thumbnail

    made = {}
    for row in found:
        name = str(row["name"])
        film = folder / str(row["folder"]) / "overlay.webm"
        if not film.is_file():
            continue
        try:
            (folder / "thumbnails").mkdir(exist_ok=True)
            if write_thumbnail(film, folder / "thumbnails" / f"{name}.jpg"):
                made[name] = f"thumbnails/{name}.jpg"
        except Exception as error:  # the page does not depend on this picture
            log.warning("%s: no picture of it (%s).", film, error_line(error))
    return made


def write_index(
    folder: Path,
    rows: Sequence[Row],
    columns: Sequence[Column],
    thumbnails: Mapping[str, str],
) -> None:
    """Writes `index.html`.

    Args:
        thumbnails: paths of still images from `folder`, by the clip's name.
    """
    first, *others = columns
    heads = "".join(_head(column) for column in (first, *others))
    body = "\n".join(_row(folder, row, first, others, thumbnails) for row in rows)
    counts = Counter(str(row["status"]) for row in rows)
    subtitle = ", ".join(
        f"{counts[name]} {name}" for name in STATUS_ORDER if counts[name]
    )
    template = resources.files("bodyslam_jax.batch").joinpath("index.html").read_text()
    parts = {
        "TITLE": html.escape(folder.resolve().name),
        "SUBTITLE": html.escape(f"{len(rows)} clips: {subtitle}"),
        "HEADS": heads,
        "ROWS": body,
    }
    # In one pass, because a clip's name may contain the mark of another part.
    place = re.compile(f"<!--({'|'.join(parts)})-->")
    page = place.sub(lambda found: parts[found[1]], template)
    atomic.write_text(folder / "index.html", page)


def _head(column: Column) -> str:
    return f'<th scope="col"><button>{html.escape(column.title)}</button></th>'


def _row(
    folder: Path,
    row: Row,
    first: Column,
    others: Sequence[Column],
    thumbnails: Mapping[str, str],
) -> str:
    name = str(row["name"])
    cells = [f"<td>{_preview(row, thumbnails)}</td>"]
    run = str(row["folder"])
    report = folder / run / "report.html"
    label = html.escape(name)
    if report.exists():
        label = f'<a href="{quote(f"{run}/report.html")}">{label}</a>'
    elif (folder / "logs" / f"{name}.txt").exists():
        label += f' <a href="{quote(f"logs/{name}.txt")}">log</a>'
    cells.append(f'<th scope="row" data-v="{html.escape(name)}">{label}</th>')
    for column in others:
        value = column.value(row)
        text = html.escape(column.text(row))
        if column.key == "status":
            kind = html.escape(str(value).replace(" ", "-"))
            text = f'<span class="badge {kind}">{text}</span>'
            value = (
                STATUS_ORDER.index(value)
                if value in STATUS_ORDER
                else len(STATUS_ORDER)
            )
        number = isinstance(value, (int, float))
        kind = ' class="number"' if number and column.key != "status" else ""
        key = "" if value is None else html.escape(str(value))
        cells.append(f'<td{kind} data-v="{key}">{text}</td>')
    return f"<tr>{''.join(cells)}</tr>"


def _preview(row: Row, thumbnails: Mapping[str, str]) -> str:
    """Returns a still image; an overlay, if there is one, plays while pointed at."""
    name = str(row["name"])
    image = thumbnails.get(name)
    if image is None:
        return ""
    alt = html.escape(f"overlay of {name}")
    film = quote(f"{row['folder']}/overlay.webm")
    return (
        f'<div class="preview" data-film="{film}">'
        f'<img src="{quote(image)}" alt="{alt}" loading="lazy" width="160"></div>'
    )


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


def draw_sweep(
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
