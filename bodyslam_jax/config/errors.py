"""The error that invalid inputs raise, and the checks of settings that raise it.

Every error is shown in one line by the command line and by lists of failures.
"""

import dataclasses
import math
import os
import types
import typing
from collections.abc import Collection, Mapping
from typing import Any

Range = tuple[int | float, int | float]
"""Least and largest value."""
SHARE: Range = (0, 1)
NOT_NEGATIVE: Range = (0, math.inf)


class InputError(ValueError):
    """An input of the user cannot be used; the message names it, in one line.

    The command line ends with exit code 1 for this error, and with 70 for every
    unexpected one, so that no fault of the program is attributed to a file.

    Messages quote the content of files, which is arbitrary: each argument is converted
    to one line of bounded length, with control characters escaped.
    """

    def __init__(self, *lines: object) -> None:
        self.lines = [_line(str(line)) for line in lines]
        """One line per mistake; the message joins them in one line."""
        super().__init__(" ".join(self.lines))


_MAX_LINE_LENGTH = 1000
"""Largest length of a line of a message; most quotations have less than a tenth."""


def _line(text: str) -> str:
    """Converts a text to one line, with characters that cannot be printed escaped."""
    if not text.isprintable():
        text = "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)
    if len(text) > _MAX_LINE_LENGTH:
        half = _MAX_LINE_LENGTH // 2
        text = f"{text[:half]} ... {text[-half:]}"
    return text


def check(
    settings: Any,
    ranges: Mapping[str, Range] = types.MappingProxyType({}),
    *,
    infinite: Collection[str] = (),
) -> None:
    """Rejects invalid settings before anything is computed.

    Whole numbers must be 1 or more, other numbers more than 0, unless `ranges` has the
    least and the largest value. Those named in `infinite` may be infinite, as a
    standard deviation that disables a term. Arrays are not checked, as JAX may be
    tracing them.

    **Raises:** `InputError` that names the setting, what was found and what was
    expected.
    """
    hints = typing.get_type_hints(type(settings))
    for field in dataclasses.fields(settings):
        found = getattr(settings, field.name)
        if dataclasses.is_dataclass(found) or hasattr(found, "dtype"):
            continue
        if found == () == field.default:
            continue
        if field.name in infinite and found == math.inf:
            continue
        expected = _refused(found, hints[field.name], ranges.get(field.name))
        if expected:
            raise InputError(f"{field.name}: found {found!r}, expected {expected}.")


def _refused(found: Any, kind: Any, within: Range | None) -> str | None:
    """Returns a description of the expected value, or `None` if `found` is valid."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        if found is None and types.NoneType in arguments:
            return None
        (kind,) = (one for one in arguments if one is not types.NoneType)
        expected = _refused(found, kind, within)
        return expected and f"{expected}, or nothing"
    if origin is typing.Literal:
        return None if found in arguments else f"one of {list(arguments)}"
    if origin is tuple:
        if not isinstance(found, tuple):
            return "several values"
        if kind == tuple[int, ...] and not found:
            return "one number or more"
        parts = (_refused(one, arguments[0], within) for one in found)
        return next((f"each {part}" for part in parts if part), None)
    if kind is float or kind is int:
        return _out_of_range(found, kind, within)
    if kind is str and isinstance(found, os.PathLike):
        return None
    names = {bool: "true or false", str: "a text"}
    return None if isinstance(found, kind) else names.get(kind, kind.__name__)


def _out_of_range(found: Any, kind: type, within: Range | None) -> str | None:
    """Returns a description of the expected number, or `None` if `found` is valid."""
    whole = isinstance(found, int) and not isinstance(found, bool)
    if not (whole or (kind is float and isinstance(found, float))):
        return "a whole number" if kind is int else "a number"
    if within is None:
        if kind is int:
            return None if found >= 1 else "1 or more"
        return None if 0 < found < math.inf else "more than 0, and finite"
    least, most = within
    # A NaN fails both comparisons.
    if least <= found <= most and math.isfinite(found):
        return None
    if found == most == math.inf:
        return f"{least:g} or more, and finite"
    return f"{least:g} or more" if most == math.inf else f"{least:g} to {most:g}"


def error_line(error: BaseException) -> str:
    """Returns an error in one line: the file and the system's reason, the message of an
    error of the input, or else the kind of the error and the start of its message."""
    if isinstance(error, OSError) and error.strerror:
        return _printable(f"{error.filename or 'file'}: {error.strerror}.")
    text = _printable(str(error))
    if isinstance(error, (OSError, ValueError)) and text:
        return text
    return f"{type(error).__name__}: {text[:300]}"


def _printable(text: str) -> str:
    """Returns the text in one line, without characters that terminals or files
    refuse."""
    line = " ".join(text.encode("utf-8", "backslashreplace").decode().split())
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in line)
