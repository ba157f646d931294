"""Writes rows as Markdown and CSV tables, below a description of the data."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bodyslam_jax.experiments.paper import OTHER_DATA
from bodyslam_jax.io.atomic import write_text
from bodyslam_jax.io.markup import csv_table, markdown_table

Row = dict[str, Any]
MM = 1e3
"""Factor from a row's metres to a table's millimetres."""
Cell = str | float | int | None


@dataclasses.dataclass(frozen=True)
class Column:
    """A column of a table: its key in the rows, unit and format."""

    title: str
    key: str
    factor: float = 1.0
    """Factor from the row's unit (SI) to the table's."""
    digits: int = 1
    average: bool = True
    """Whether the last row of the table holds the mean."""

    def value(self, row: dict[str, Any]) -> Cell:
        """Returns the row's value in the unit of the table."""
        found = row.get(self.key)
        if isinstance(found, (int, float)) and not isinstance(found, bool):
            return found * self.factor
        return found

    def text(self, value: Cell) -> str:
        """Returns a value as the text of a cell."""
        if value is None:
            return "–"
        return value if isinstance(value, str) else f"{value:.{self.digits}f}"


def markdown(
    columns: Sequence[Column], rows: Sequence[dict[str, Any]], *, mean: bool = False
) -> str:
    """Returns a Markdown table, with the mean over rows as the last line if `mean` is
    set."""
    lines, total = [[column.title for column in columns]], []
    lines += [[c.text(c.value(row)) for c in columns] for row in rows]
    if mean and rows:
        last: list[str] = []
        for column in columns:
            values = [column.value(row) for row in rows]
            numbers = [v for v in values if isinstance(v, (int, float))]
            averaged = column.average and len(numbers) == len(rows)
            last.append(column.text(sum(numbers) / len(rows)) if averaged else "")
        if any(last):
            total = ["mean", *last[1:]]
    return markdown_table(lines, last=total)


def to_csv(
    columns: Sequence[Column], rows: Sequence[dict[str, Any]], about: str = ""
) -> str:
    """Returns a CSV table with values in full precision, in the units of the columns'
    titles.

    If `about`, a description of the data, is given, it fills a last column `data`.
    """
    last = [about] if about else []
    titles = [column.title for column in columns] + ["data"] * len(last)
    cells = ([*(column.value(row) for column in columns), *last] for row in rows)
    return csv_table([titles, *cells])


def intro(title: str, about: str, *lines: str) -> str:
    """Returns the head of a Markdown report: `title`, `about` (a description of the
    data), and `lines` that introduce the tables."""
    return "\n".join([f"# {title}", "", f"{about} {OTHER_DATA}", *lines, "", ""])


def write_tables(
    out: Path,
    name: str,
    head: str,
    parts: Sequence[tuple[str, Sequence[Column], Sequence[Row]]],
    about: str,
) -> list[Path]:
    """Writes `name.md` with all parts under their titles, and `name.csv` with the first
    part.

    `about` describes the data.
    """
    text = head
    for title, columns, rows in parts:
        text += f"## {title}\n\n{markdown(columns, rows, mean=len(rows) > 1)}\n"
    write_text(out / f"{name}.md", text)
    write_text(out / f"{name}.csv", to_csv(*parts[0][1:], about))
    return [out / f"{name}.md", out / f"{name}.csv"]
