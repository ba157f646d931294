"""Writes `index.html` of a batch: a sortable table with overlays and links to reports.

It opens from disk, without network. Images and overlays are files beside it that the
browser loads when they come into view or are pointed at.
"""

import html
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from urllib.parse import quote

from bodyslam_jax.batch.rows import STATUS_ORDER
from bodyslam_jax.batch.table import Column, Row
from bodyslam_jax.io import atomic


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
