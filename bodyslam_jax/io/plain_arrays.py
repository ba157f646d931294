"""Arrays of numbers and text, from bytes and what a file says of their type and shape.

No type, shape or stride of a file reaches NumPy before it is checked here: a type by
its letters alone (`<f8`), a shape against the bytes that are there. What a file makes
in memory is counted by an `Account` before it is made.
"""

import dataclasses
import math
import re
from typing import Any

import numpy as np

MAX_BYTES = 1_000_000_000
"""Largest size of an unpacked file, and of each part of it, bytes."""
MAX_UNPACKED_BYTES = 100_000_000
"""Size to which even the smallest compressed file may unpack, bytes."""
MAX_RATIO = 100
"""Ratio of larger content to the file: measurements are compressed to a half or a
fifth; 1,000, which zlib reaches for zeros, only makes a small file large."""
MAX_AXES = 32
"""Largest number of axes of an array, as in every version of NumPy."""
MAX_TEXT_WIDTH = 65_536
"""Largest number of characters of a text in an array of texts, which are all as
wide."""
MAX_HEADER_BYTES = 65_536
"""Largest header of an array in NumPy's format, bytes: that of a plain type has 128."""
VALUE_BYTES = 50
"""Memory of a number or a reference, with its share of a list, bytes."""
_SIZES = {
    "b": (1,),
    "i": (1, 2, 4, 8),
    "u": (1, 2, 4, 8),
    "f": (2, 4, 8),
    "c": (8, 16),
}
"""Sizes, bytes, of NumPy's types of plain numbers, by kind."""
_TYPE = re.compile(r"([<>|=]?)([biufcSUO])(\d{0,6})")


class Damaged(Exception):
    """The file contradicts itself or ends too early."""


class Refused(Exception):
    """The file asks for something that is not plain data, or for too much of it."""


FREE_STEPS = 5_000_000
"""Instructions of a pickle that its size need not account for; they take two
seconds."""


class Account:
    """The memory, in bytes, that one file has used so far, and its limit."""

    def __init__(self, disk_bytes: int, max_bytes: int = MAX_BYTES) -> None:
        self.max_bytes = max_bytes
        self.max_unpacked = min(max_bytes, MAX_UNPACKED_BYTES + MAX_RATIO * disk_bytes)
        """Bytes that a compressed file may unpack to."""
        # A file is held as a whole while arrays are made of it: half as much again,
        # so that a file of nearly the largest size cannot take twice its size.
        self.left = max_bytes * 3 // 2
        self.steps = FREE_STEPS + disk_bytes
        """Instructions of pickles: each takes a byte at least, so only those of a
        compressed file can be more than its bytes."""

    def check(self, size: int, what: str) -> None:
        """Checks that one object alone is within the budget.

        **Raises:** `Refused` if it is larger.
        """
        if size > self.max_bytes:
            limit = f"more than {self.max_bytes / 1e9:.3g} GB"
            raise Refused(f"{what} of {size} bytes ({limit})")

    def check_unpacked(self, size: int) -> None:
        """Checks the size to which a compressed file unpacks.

        **Raises:** `Refused` if it is too large.
        """
        if size > self.max_unpacked:
            limit = f"{self.max_unpacked / 1e9:.3g} GB for a file of its size"
            raise Refused(f"it unpacks to {size / 1e9:.3g} GB (more than {limit})")

    def spend(self, size: int) -> None:
        """Counts what is about to be made.

        **Raises:** `Refused` if all of it together exceeds the budget.
        """
        self.left -= size
        if self.left < 0:
            raise Refused(f"it makes more than {self.max_bytes * 1.5 / 1e9:.3g} GB")


@dataclasses.dataclass
class ArrayType:
    """The type of an array's elements; stands in for `numpy.dtype`."""

    kind: str
    """NumPy's letter, one of `biufcSU`, or `O` for any values."""
    size: int
    """Bytes of an element; 0 for `O`."""
    order: str = "<"
    """`<` or `>`: where the most significant byte is."""

    @property
    def code(self) -> str:
        """NumPy's name of the type, as in `<f8`."""
        width = self.size // 4 if self.kind == "U" else self.size
        return f"{self.order}{self.kind}{width or ''}"


def array_type(code: Any) -> ArrayType:
    """Returns the type that letters such as `<f8`, `|b1` or `S5` stand for.

    **Raises:** `Refused` for every other type.
    """
    found = _TYPE.fullmatch(code) if isinstance(code, str) else None
    if type(code) is str and code in ("?", "|?"):
        return ArrayType("b", 1)
    if found is None:
        raise Refused(f"an array of type {shown(code)}, not of numbers or text")
    order, kind, digits = found.groups()
    width = int(digits or 0)
    if kind == "O":
        return ArrayType("O", 0)
    fits = 0 < width <= MAX_TEXT_WIDTH if kind in "SU" else width in _SIZES[kind]
    if not fits:
        raise Refused(f"an array of type {shown(code)}, not of numbers or text")
    size = 4 * width if kind == "U" else width
    return ArrayType(kind, size, ">" if order == ">" else "<")


def shape_of(value: Any) -> tuple[int, ...]:
    """Returns a shape that a file gives: whole numbers from 0, for 32 axes at most.

    **Raises:** `Refused` for anything else.
    """
    axes = (value,) if type(value) is int else value
    if (
        not isinstance(axes, tuple | list)
        or len(axes) > MAX_AXES
        or not all(type(n) is int and n >= 0 for n in axes)
    ):
        raise Refused(f"an array of shape {shown(value)}")
    return tuple(axes)


def num_bytes(of: ArrayType, shape: tuple[int, ...], account: Account) -> int:
    """Returns the bytes that an array takes.

    **Raises:** `Refused` if they exceed the budget, also by an axis of an empty array.
    """
    what = f"an array {of.code}{shape}"
    account.check(math.prod(n or 1 for n in shape) * max(of.size, 1), what)
    return math.prod(shape) * of.size


def array_of(
    content: Any,
    of: ArrayType,
    shape: tuple[int, ...],
    account: Account,
    by_column: bool = False,
) -> np.ndarray:
    """Returns a new array, row by row and in the machine's order of bytes, of
    `content`.

    A `bytearray` is taken over; of anything else a copy is made.

    **Raises:** `Damaged` if the content has another size than type and shape ask for,
    or values that no number or text of that type has.
    """
    if of.kind == "O":
        raise Refused("an array of objects made of bytes")
    wanted = num_bytes(of, shape, account)
    if len(content) != wanted:
        what = f"an array {of.code}{shape} has {wanted} bytes"
        raise Damaged(f"{what}, {len(content)} are there")
    account.spend(wanted + 2 * VALUE_BYTES)
    if not wanted:
        return np.zeros(shape, np.dtype(of.code).newbyteorder("="))
    array = np.frombuffer(content, np.dtype(of.code))
    if of.kind == "b" and (array.view(np.uint8) > 1).any():
        raise Damaged("true and false as a number above 1")
    if of.kind == "U":
        points = np.frombuffer(content, f"{of.order}u4")
        # The last code point, and those of halves of characters in UTF-16.
        if ((points > 0x10FFFF) | ((points >= 0xD800) & (points < 0xE000))).any():
            raise Damaged("a text with characters that Unicode does not have")
    array = array.reshape(shape, order="F" if by_column else "C")
    if type(content) is not bytearray:
        array = array.copy()
    return np.ascontiguousarray(array, array.dtype.newbyteorder("=")).reshape(shape)


def listed(values: list, shape: tuple[int, ...], account: Account) -> Any:
    """Returns an array of any values as nested lists; without an axis, the value
    itself.

    **Raises:** `Damaged` if there are more or fewer values than the shape has.
    """
    if len(values) != math.prod(shape):
        raise Damaged(f"{len(values)} objects in an array of shape {shape}")
    if not shape:
        return values[0]
    if not values:
        return []
    for length in shape[:0:-1]:
        account.spend(2 * VALUE_BYTES * len(values) // length)
        values = [values[k : k + length] for k in range(0, len(values), length)]
    return values


_ENTRY = r"'(?:descr|fortran_order|shape)': ?(?:'[^'\\]*'|True|False|\([\dL, ]*\))"
_HEADER = re.compile(rf"\{{\s*(?:{_ENTRY}\s*,?\s*){{3}}\}}\s*")
_NAMED = {
    "descr": re.compile(r"'descr': ?'([^']*)'"),
    "fortran_order": re.compile(r"'fortran_order': ?(True|False)"),
    "shape": re.compile(r"'shape': ?\(([\dL, ]*)\)"),
}


def read_header(file: Any) -> tuple[ArrayType, tuple[int, ...], bool, int]:
    """Reads the head of an array in NumPy's format.

    Returns: type, shape, whether it is stored by column, and the head's own bytes.

    **Raises:** `Damaged` if it is none; `Refused` for other types than numbers, text
    and objects.
    """
    # Six letters and the version of NumPy's format,
    magic = file.read(8)
    # eight bytes in all.
    if magic[:6] != b"\x93NUMPY" or len(magic) < 8 or magic[6] not in (1, 2, 3):
        raise Damaged(f"an array that begins with {magic!r}")
    width = 2 if magic[6] == 1 else 4
    length = int.from_bytes(file.read(width), "little")
    if length > MAX_HEADER_BYTES:
        raise Damaged(f"an array with a head of {length} bytes")
    head = file.read(length)
    text = head.decode("latin1")
    if len(head) < length:
        raise Damaged("an array whose head is cut short")
    found = {name: entry.findall(text) for name, entry in _NAMED.items()}
    if not _HEADER.fullmatch(text) or any(len(x) != 1 for x in found.values()):
        # The place where a type with named fields stands, or a type within a type.
        raise Refused(f"an array with the head {shown(text.strip())}")
    digits = re.findall(r"\d+", found["shape"][0])
    # Numbers of 18 digits fit 64 bits.
    if any(len(n) > 18 for n in digits):
        raise Refused(f"an array of shape ({shown(found['shape'][0])})")
    return (
        array_type(found["descr"][0]),
        shape_of(tuple(int(n) for n in digits)),
        found["fortran_order"][0] == "True",
        # Bytes before the content: magic, length, text.
        8 + width + length,
    )


def shown(value: Any) -> str:
    """Returns a value of a file in one short line of printable characters."""
    if isinstance(value, str | int | float | None) or (
        isinstance(value, tuple | list) and all(type(n) is int for n in value[:9])
    ):
        value = value[:60] if isinstance(value, str | tuple | list) else value
        return ascii(value)[:80]
    return f"a {type(value).__name__}"
