"""Formats rows of figures as CSV, Markdown and LaTeX."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, TypeGuard

from bodyslam_jax.io.markup import csv_table, latex_text, markdown_table

Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Column:
    """A column: its key in the rows, its title with the unit, its format."""

    key: str
    title: str
    digits: int | None = None
    """Number of decimal places; `None` for text and whole numbers."""
    factor: float = 1.0
    """Factor from the row's unit (SI) to that of the title."""
    is_wide: bool = False
    """Whether the column has text of any length, and is left out of LaTeX."""

    def value(self, row: Row) -> Any:
        """Returns the value in the unit of the title; `None` if the row has none."""
        found = row.get(self.key)
        if isinstance(found, (int, float)) and not isinstance(found, bool):
            if not math.isfinite(found):
                return None
            return found * self.factor if self.factor != 1 else found
        return found if found != "" else None

    def text(self, row: Row) -> str:
        """Returns the row's value as the text of a cell."""
        found = self.value(row)
        if found is None:
            return "–"
        if self.digits is not None and isinstance(found, (int, float)):
            return f"{found:.{self.digits}f}"
        return str(found)


def present(columns: Sequence[Column], rows: Sequence[Row]) -> list[Column]:
    """Returns the columns for which any row has a value."""
    return [c for c in columns if any(c.value(row) is not None for row in rows)]


def to_csv(columns: Sequence[Column], rows: Sequence[Row]) -> str:
    """Returns CSV with all digits; columns have their titles as names."""
    titles = [column.title for column in columns]
    cells = ([column.value(row) for column in columns] for row in rows)
    return csv_table([titles, *cells])


def to_markdown(columns: Sequence[Column], rows: Sequence[Row]) -> str:
    """Returns a Markdown table with numbers aligned to the right, and the medians as
    last line."""
    cells = ([column.text(row) for column in columns] for row in rows)
    return markdown_table(
        [[column.title for column in columns], *cells],
        right=[column.digits is not None for column in columns],
        last=["median", *_medians(columns[1:], rows)] if len(rows) > 2 else (),
    )


def to_latex(columns: Sequence[Column], rows: Sequence[Row]) -> str:
    """Returns a `tabular` with rules of the package booktabs."""
    columns = [column for column in columns if not column.is_wide]
    form = "".join("r" if column.digits is not None else "l" for column in columns)
    line = lambda cells: " & ".join(map(latex_text, cells)) + r" \\"
    body = [line([column.text(row) for column in columns]) for row in rows]
    if len(rows) > 2:
        body += [r"\midrule", line(["median", *_medians(columns[1:], rows)])]
    return "\n".join(
        [
            rf"\begin{{tabular}}{{{form}}}",
            r"\toprule",
            line([column.title for column in columns]),
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
            "",
        ]
    )


def _medians(columns: Sequence[Column], rows: Sequence[Row]) -> list[str]:
    found = []
    for column in columns:
        values: list[float] = sorted(
            v for row in rows if _is_number(v := row.get(column.key))
        )
        if column.digits is None or not values:
            found.append("")
            continue
        half = len(values) // 2
        median = (values[half] + values[-half - 1]) / 2
        found.append(column.text({column.key: median}))
    return found


def _is_number(value: Any) -> TypeGuard[float]:
    return isinstance(value, (int, float)) and math.isfinite(value)
