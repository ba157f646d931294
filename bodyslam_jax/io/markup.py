"""Escapes text for tables and pages: one function for each language.

Names of clips, reasons and statuses may come from folders that somebody else made. A
spreadsheet evaluates cells that begin like a formula, Markdown renders links and HTML,
and a page ends a script at the first `</script`.
"""

import json
import re
from collections.abc import Iterable, Sequence
from typing import Any

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(inf|nan)")
_FORMULA = re.compile(
    r"[\s\x00-\x1f\u200b\ufeff]*[=+\-@\uff1d\uff0b\uff0d\uff20]|[\t\r]"
)
"""Beginnings that spreadsheets take for a formula, also in full width, or that hide
one (OWASP, "CSV Injection")."""
_QUOTED = re.compile(r"[,;\"\t\r\n|]|^\s|\s$")
"""Pattern of what must be inside quotes, for any separator of cells."""
_CONTROLS = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]+")
_MARKDOWN = re.compile(r"[\\`|<>\[\]]|&(?=#?\w+;)")
_AUTOLINK = re.compile(r"(https?|ftp)(?=://)|\bwww(?=\.)", re.IGNORECASE)
_LATEX = {
    **{sign: f"\\{sign}" for sign in "&%$#_{}"},
    **{"±": r"$\pm$", "²": r"$^2$", "–": "--", "\\": r"\textbackslash{}"},
    **{"~": r"\textasciitilde{}", "^": r"\textasciicircum{}"},
    # After the end of a row these would begin its options.
    **{"[": "{[}", "]": "{]}", "*": "{*}"},
}


def csv_table(rows: Iterable[Sequence[Any]]) -> str:
    """Returns rows as CSV; text that a spreadsheet would evaluate has an apostrophe in
    front.

    Numbers, also as text, are as they are; `None` is an empty cell.
    """
    return "".join(",".join(map(csv_cell, row)) + "\n" for row in rows)


def csv_cell(value: Any) -> str:
    """Returns a cell of CSV."""
    if value is None:
        return ""
    text = str(value)
    if not _NUMBER.fullmatch(text) and _FORMULA.match(text):
        text = f"'{text}"
    if _QUOTED.search(text):
        text = '"' + text.replace('"', '""') + '"'
    return text


def markdown_table(
    rows: Sequence[Sequence[str]],
    *,
    right: Sequence[bool] = (),
    last: Sequence[str] = (),
) -> str:
    """Returns a Markdown table of text cells, the first row its titles.

    Args:
        right: of each column, whether it is aligned to the right.
        last: a row below the others, its first cell bold.
    """
    titles, *others = rows
    alignment = ["---:" if one else "---" for one in right or [False] * len(titles)]
    lines = [list(map(markdown_text, titles)), alignment]
    lines += [list(map(markdown_text, row)) for row in others]
    if last:
        lines.append([f"**{markdown_text(last[0])}**", *map(markdown_text, last[1:])])
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def markdown_text(text: str) -> str:
    """Returns text that Markdown shows as it is, in one line: no HTML, code, links or
    cells."""
    plain = _CONTROLS.sub(" ", text)
    escaped = _MARKDOWN.sub(lambda found: _MARKDOWN_SIGNS[found[0]], plain)
    # An entity in place of a letter, which links without brackets do not begin with.
    return _AUTOLINK.sub(lambda found: f"&#{ord(found[0][0])};{found[0][1:]}", escaped)


_MARKDOWN_SIGNS = {sign: f"\\{sign}" for sign in "\\`|[]"}
_MARKDOWN_SIGNS |= {"<": "&lt;", ">": "&gt;", "&": "&amp;"}


def latex_text(text: str) -> str:
    """Returns text that LaTeX shows as it is."""
    plain = _CONTROLS.sub(" ", text)
    return "".join(_LATEX.get(letter, letter) for letter in plain)


def json_in_html(value: Any) -> str:
    """Returns JSON for an element `script` of a page: it has no `<`, `>` or `&`, and no
    character outside ASCII."""
    text = json.dumps(value, separators=(",", ":"))
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return text
