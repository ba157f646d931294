"""Formats tables of the report as HTML."""

import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

from bodyslam_jax import evaluation


def error_tables(
    errors: Mapping[str, Mapping[str, Any]], sentences: Sequence[str] = ()
) -> str:
    """Returns the errors against the truth, with one column per evaluated estimate, and
    the sentences below the main ones."""
    if not errors:
        return ""
    first = [row for row in evaluation.ROWS if row[0] in _MAIN_ERRORS]
    others = [row for row in evaluation.ROWS if row[0] not in _MAIN_ERRORS]
    return (
        "<section><h2>Error against the truth</h2>"
        "<p>Means over all frames. SE(3) alignment keeps the estimated size; Sim(3) "
        "corrects it by the truth, which is unknown outside of benchmarks.</p>"
        f"{_error_table(errors, first)}"
        f"{''.join(f'<p>{html.escape(line)}</p>' for line in sentences)}"
        f"{folded('More errors', _error_table(errors, others))}</section>"
    )


_MAIN_ERRORS = ("c_ate_se3", "c_ate_sim3", "h_ate_se3", "j_ate_se3", "scale", "w_mpjpe")
_MAIN_ERRORS += ("wa_mpjpe", "pa_mpjpe", "rte")


def _error_table(
    errors: Mapping[str, Mapping[str, Any]],
    chosen: Sequence[tuple[str, str, str, float]],
) -> str:
    head = "".join(_header(name) for name in errors)
    rows = []
    for key, label, unit, factor in chosen:
        values = [found.get(key) for found in errors.values()]
        if any(isinstance(value, (int, float)) for value in values):
            cells = "".join(f"<td>{_error(v, factor)}</td>" for v in values)
            name = f"{html.escape(label)}{f', {unit}' if unit else ''}"
            rows.append(f'<tr><th scope="row">{name}</th>{cells}</tr>')
    return (
        f'<div class="wide"><table><thead><tr>{_header("error")}{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _error(value: Any, factor: float) -> str:
    """Returns a number, or a dash with the reason for which there is none."""
    why = f" <small>{html.escape(value)}</small>" if isinstance(value, str) else ""
    return number(value, factor) + why


def number(value: Any, factor: float = 1.0) -> str:
    """Returns a number times `factor` as text with four digits; a dash if it is not
    finite."""
    if not isinstance(value, (int, float)) or not math.isfinite(value):
        return "–"
    value *= factor
    if value == 0 or 1e-3 <= abs(value) < 1e6:
        return f"{value:.4g}" if abs(value) < 1e4 else f"{value:,.0f}"
    return f"{value:.3g}"


def table(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Returns a table as HTML; the first cell of each row is its header."""
    head = "".join(_header(words(str(column))) for column in columns)
    body = "".join(
        f'<tr><th scope="row">{html.escape(words(str(name)))}</th>'
        f"{''.join(f'<td>{_cell(value)}</td>' for value in values)}</tr>"
        for name, *values in rows
    )
    return (
        f'<div class="wide"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def _header(name: str) -> str:
    return f'<th scope="col">{html.escape(name)}</th>'


def _cell(value: Any) -> str:
    if value is None or isinstance(value, (int, float)) and not isinstance(value, bool):
        return number(value)
    return html.escape(words(str(value)))


def words(name: str) -> str:
    """Returns a name with spaces for underscores."""
    return name.replace("_", " ")


def folded(title: str, content: str) -> str:
    """Returns content that is folded below its title, as HTML."""
    return f"<details><summary>{title}</summary>{content}</details>"
