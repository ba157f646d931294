"""Declarations of what a reader needs of a file: rank, type, range and finiteness.

A reader says what it needs of each value before code of its own runs on it, and what
differs is one line: the file, the place, what was found, what was expected.
"""

import math
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import budget

MAX_MAGNITUDE = 1e12
"""Largest absolute value of a measurement. Its square times a million still fits
float32."""
MAX_QUATERNION_ERROR = 0.05
"""Largest deviation of the length of a quaternion from 1; chosen, not measured."""
Kind = Literal["number", "whole", "boolean"]
Shape = Sequence[int | str | None]
"""Length of each axis: a number, a name that stands for the same number throughout a
file, or `None` for any. A first entry of `...` is not needed: give several shapes."""


class Sizes(dict[str, int]):
    """The lengths of named axes in one file."""


def as_array(
    path: Path,
    name: str,
    value: Any,
    *shapes: Shape,
    kind: Kind = "number",
    finite: bool = True,
    low: float | int = -MAX_MAGNITUDE,
    high: float | int = MAX_MAGNITUDE,
    sizes: Sizes | None = None,
) -> np.ndarray:
    """Returns the value as a float64, int64 or bool array of one of the shapes (of any
    shape without one), from an array or from nested lists.

    Args:
        kind: `whole` for whole numbers, as int64; `boolean` for true and false, or 0
            and 1.
        finite: whether NaN and infinity are refused. Otherwise NaN stands for what is
            missing, and so do numbers beyond the range.
        low, high: the range of the numbers that are finite.
        sizes: lengths of named axes so far; those of this array are added.

    **Raises:** `InputError`, one line that names the file and the array.
    """
    array = _plain_array(path, name, value)
    _check_shape(path, name, array, shapes, Sizes() if sizes is None else sizes)
    if kind == "boolean":
        if array.dtype.kind != "b" and not np.isin(array, (0, 1)).all():
            raise InputError(f"{path}: `{name}` is not true or false throughout.")
        return array.astype(bool)
    if array.dtype.kind == "b" and not isinstance(value, np.ndarray):
        raise InputError(f"{path}: `{name}` is true or false, expected numbers.")
    # A float64 has 8 bytes.
    budget.check_bytes(path, 8 * array.size, f"`{name}` as numbers has ")
    with np.errstate(all="ignore"):
        found = np.asarray(array, np.float64)
    is_finite = np.isfinite(found)
    if finite and not is_finite.all():
        bad = int((~is_finite).sum())
        raise InputError(
            f"{path}: {bad} of {found.size} numbers of `{name}` not finite (NaN or "
            "infinite)."
        )
    outside = is_finite & ~((found >= low) & (found <= high))
    if not finite:
        beyond = (found > MAX_MAGNITUDE) | (found < -MAX_MAGNITUDE)
        outside &= ~beyond
        found = np.where(beyond, np.nan, found) if beyond.any() else found
    if outside.any():
        worst = found[outside].flat[0]
        raise InputError(
            f"{path}: `{name}` has {worst:.6g}, expected {_range(low, high)}."
        )
    if kind == "whole":
        broken = np.floor(found) != found
        if broken.any():
            worst = found[broken].flat[0]
            raise InputError(
                f"{path}: `{name}` has {worst:.6g}, expected whole numbers."
            )
        return array.astype(np.int64)
    return found


def as_number(
    path: Path,
    name: str,
    value: Any,
    low: float | int = -MAX_MAGNITUDE,
    high: float | int = MAX_MAGNITUDE,
) -> float:
    """Returns one finite number.

    **Raises:** `InputError`, one line, if the value is anything else or out of range.
    """
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    is_number = isinstance(value, int | float | np.integer | np.floating)
    if not is_number or isinstance(value, bool) or value != value:
        raise InputError(f"{path}: `{name}` is {shown(value)}, expected a number.")
    # Compared before it is converted: a whole number may be too large for a float.
    if not (low <= value <= high and abs(value) <= 1.7e308):
        raise InputError(
            f"{path}: `{name}` is {shown(value)}, expected {_range(low, high)}."
        )
    return float(value)


def as_whole(
    path: Path,
    name: str,
    value: Any,
    low: int = 0,
    high: int = 10**12,
) -> int:
    """Returns one whole number, also if it is written as 640.0.

    **Raises:** `InputError`, one line, if the value is anything else or out of range.
    """
    found = as_number(path, name, value, low, high)
    if found % 1:
        raise InputError(f"{path}: `{name}` is {found:g}, expected a whole number.")
    return int(found)


class Fields:
    """A dictionary of a file, whose entries are checked as they are read."""

    def __init__(self, path: Path, data: dict, place: str = "") -> None:
        self.path, self.data, self.place = path, data, place

    def __contains__(self, name: str) -> bool:
        return name in self.data

    def names(self) -> list[str]:
        return [str(name) for name in self.data]

    def value(self, *names: str) -> Any:
        """Returns the entry under the first of the names that is there.

        **Raises:** `InputError` if none is.
        """
        for name in names:
            if self.data.get(name) is not None:
                return self.data[name]
        found = ", ".join(str(name)[:40] for name in list(self.data)[:12]) or "nothing"
        where = f" in {self.place}" if self.place else ""
        raise InputError(
            f"{self.path}: no `{' or '.join(names)}`{where}; found {found}."
        )

    def number(
        self,
        name: str,
        low: float | int = -MAX_MAGNITUDE,
        high: float | int = MAX_MAGNITUDE,
    ) -> float:
        """Returns a finite number within the range."""
        return as_number(self.path, self._at(name), self.value(name), low, high)

    def whole(self, name: str, low: int = 0, high: int = 10**12) -> int:
        """Returns a whole number within the range."""
        return as_whole(self.path, self._at(name), self.value(name), low, high)

    def text(self, name: str, among: Collection[str] = ()) -> str:
        """Returns a text, one of `among` if that is given."""
        found = self.value(name)
        if not isinstance(found, str) or (among and found not in among):
            expected = " or ".join(among) or "a text"
            raise InputError(
                f"{self.path}: `{self._at(name)}` is {shown(found)}, expected "
                f"{expected}."
            )
        return found

    def array(self, name: str, *shapes: Shape, **declared: Any) -> np.ndarray:
        """Returns an array as `as_array` does."""
        return as_array(
            self.path, self._at(name), self.value(name), *shapes, **declared
        )

    def fields(self, name: str) -> "Fields":
        """Returns a dictionary within this one."""
        return fields(self.path, self.value(name), self._at(name))

    def each(self, name: str) -> Iterator["Fields"]:
        """Yields the dictionaries of a list within this one."""
        found = self.value(name)
        if not isinstance(found, list):
            raise InputError(
                f"{self.path}: `{self._at(name)}` is {shown(found)}, expected a list."
            )
        for k, one in enumerate(found):
            yield fields(self.path, one, f"{self._at(name)}[{k}]")

    def _at(self, name: str) -> str:
        return f"{self.place}.{name}" if self.place else name


def fields(path: Path, data: Any, place: str = "") -> Fields:
    """Returns the checked entries of a dictionary.

    **Raises:** `InputError`, one line, if the value is no dictionary.
    """
    if not isinstance(data, dict):
        where = f" in `{place}`" if place else ""
        raise InputError(
            f"{path}: {shown(data)}{where}, expected a dictionary (names and values)."
        )
    return Fields(path, data, place)


def shown(value: Any) -> str:
    """Returns a value of a file in a few words, for messages in one line."""
    if isinstance(value, list | tuple):
        if len(value) <= 4 and all(isinstance(x, int | float) for x in value):
            return f"{[float(f'{x:.6g}') for x in value]}"
        return f"a list of {len(value)}"
    if isinstance(value, dict):
        names = ", ".join(str(name)[:30] for name in list(value)[:5])
        return f"a dictionary of {names or 'nothing'}"
    if isinstance(value, np.ndarray):
        return f"an array {value.dtype}{value.shape}"
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:60]}..."


def _plain_array(path: Path, name: str, value: Any) -> np.ndarray:
    """Returns an array of numbers or of true and false; nothing is converted from
    text."""
    if not isinstance(value, np.ndarray):
        _check_entries(path, name, value)
        try:
            value = np.asarray(value)
            if value.dtype.kind == "O":  # whole numbers beyond 64 bits
                value = value.astype(np.float64)
        except (ValueError, OverflowError, MemoryError):
            raise InputError(
                f"{path}: `{name}` has rows of different lengths, expected a table."
            ) from None
    if value.dtype.kind not in "fiub":
        raise InputError(f"{path}: array `{name}` holds {value.dtype}, not numbers.")
    return value


def _check_entries(path: Path, name: str, value: Any) -> None:
    """Refuses lists that hold anything but numbers, before NumPy converts text to
    numbers, nothing to NaN, or one long text to a table of its length."""
    level = [value]
    while level:
        kinds = set(map(type, level))
        is_mixed = bool in kinds and kinds & {int, float}
        plain = {list, tuple, int, float, bool}
        wrong = [
            k
            for k in kinds - plain
            if not issubclass(k, np.number | np.ndarray | np.bool_)
        ]
        if wrong or is_mixed:
            bad = next(x for x in level if type(x) in (wrong or [bool]))
            raise InputError(
                f"{path}: `{name}` holds {shown(bad)}, expected numbers only."
            )
        level = [x for one in level if isinstance(one, list | tuple) for x in one]


def _check_shape(
    path: Path, name: str, array: np.ndarray, shapes: Sequence[Shape], sizes: Sizes
) -> None:
    if not shapes:
        return
    for shape in shapes:
        if len(shape) != array.ndim:
            continue
        named: dict[str, int] = {}
        for length, wanted in zip(array.shape, shape, strict=True):
            if isinstance(wanted, str):
                known = sizes.get(wanted, named.setdefault(wanted, length))
                if known != length:
                    break
            elif wanted is not None and wanted != length:
                break
        else:
            sizes.update(named)
            return
    expected = " or ".join(_shape_text(shape, sizes) for shape in shapes)
    raise InputError(f"{path}: `{name}` of shape {array.shape}, expected {expected}.")


def _shape_text(shape: Shape, sizes: Sizes) -> str:
    words = [
        "any" if n is None else str(sizes.get(n, n) if isinstance(n, str) else n)
        for n in shape
    ]
    return f"({', '.join(words)}{',' if len(words) == 1 else ''})"


def _range(low: float | int, high: float | int) -> str:
    if low == -MAX_MAGNITUDE or low == -math.inf:
        return f"{high:g} or less"
    if high in (MAX_MAGNITUDE, 10**12, math.inf):
        return f"{low:g} or more"
    return f"{low:g} to {high:g}"
