"""Writes one table, plots and a page for all run folders in a folder (`collect`).

`index.html` of a batch is a sortable table with overlays and links to reports. It opens
from disk, without network. Images and overlays are files beside it that the browser
loads when they come into view or are pointed at.
"""

import html
import logging
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from urllib.parse import quote

from bodyslam_jax.batch import plots, rows
from bodyslam_jax.batch.inputs import RUNS_FOLDER
from bodyslam_jax.batch.rows import STATUS_ORDER, Column, Row
from bodyslam_jax.config.errors import InputError, error_line
from bodyslam_jax.io import atomic

log = logging.getLogger(__name__)
_WRITTEN_FILES = ("table.csv", "table.md", "table.tex", "plots.png", "index.html")


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
    plots.draw(folder / "plots.png", found, columns)
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
