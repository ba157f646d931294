"""Arrays of `.npz` and `.npy` files, whose headers are checked before anything is read.

Nothing is unpickled, and a header is matched, not run: shape and type must be those of
plain values, and fit the bytes that follow.
"""

import contextlib
import math
import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import budget
from bodyslam_jax.io.declared import Fields, Shape, Sizes, as_array, fields
from bodyslam_jax.io.files import open_binary, parse_json, read_zip, reading

_BLOCK_BYTES = 1 << 22
"""Bytes that are unpacked at a time."""
_MAX_HEADER_BYTES = 10_000
"""Largest size of the header of a `.npy`, bytes: those of plain arrays have 128."""
_PLAIN_KINDS = "biufcSU"
"""Kinds of NumPy's types that hold nothing but values of one size."""
_MAX_DIGITS = 19
"""Largest number of digits of the length of an axis."""


class Archive:
    """The arrays of an `.npz`, read by what a reader declares of each.

    Names of axes, as `m` in `(m, 2)`, stand for the same length in all its arrays.
    """

    def __init__(self, path: Path, what: str = "a NumPy archive (.npz)") -> None:
        self.path, self._members = path, read_zip(path, what)
        self._sizes = Sizes()
        self.names = [
            name.removesuffix(".npy")
            for name in self._members.names
            if name.endswith(".npy")
        ]
        if not self.names:
            raise InputError(f"{path}: no array in it, expected {what}.")

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def require(self, *names: str) -> None:
        """Checks that the archive has arrays of these names.

        **Raises:** `InputError` if one is missing.
        """
        missing = [name for name in names if name not in self]
        if missing:
            found = ", ".join(name[:40] for name in self.names[:12])
            raise InputError(
                f"{self.path}: no array {', '.join(missing)}; found {found}."
            )

    def header(self, name: str) -> tuple[tuple[int, ...], np.dtype]:
        """Returns shape and type of an array without reading it."""
        self.require(name)
        with self._members.opened(f"{name}.npy") as file:
            return _npy_header(self.path, name, file)[:2]

    def raw(self, name: str) -> np.ndarray:
        """Returns an array as it is, of numbers, of true and false or of text.

        **Raises:** `InputError`, naming file and array, if it is missing, damaged, or
        holds Python's objects.
        """
        self.require(name)
        member = f"{name}.npy"
        with self._members.opened(member) as file:
            return _npy(self.path, name, file, self._members.size(member))

    def array(self, name: str, *shapes: Shape, **declared: Any) -> np.ndarray:
        """Returns an array, as `declared.as_array` checks and converts it."""
        return as_array(
            self.path, name, self.raw(name), *shapes, sizes=self._sizes, **declared
        )

    def text(self, name: str) -> str:
        """Returns a single text."""
        found = self.raw(name)
        if found.size == 1 and found.dtype.kind in "SU":
            with contextlib.suppress(ValueError, SystemError):  # no code points
                word = found.reshape(-1)[0]
                return word.decode() if isinstance(word, bytes) else str(word)
        raise InputError(
            f"{self.path}: `{name}` is {found.dtype}{found.shape}, expected a text."
        )

    def json(self, name: str) -> Fields:
        """Returns the entries of a JSON object in an array of one text."""
        data = parse_json(self.text(name), self.path, f"JSON in `{name}`")
        return fields(self.path, data, name)


def read_npz(path: Path, what: str = "a NumPy archive (.npz)") -> Archive:
    """Returns the arrays of an `.npz`; nothing in it is unpickled.

    **Raises:** `InputError` as `read_zip`, or if it holds no arrays.
    """
    return Archive(path, what)


def read_npy(path: Path, what: str = "a NumPy array (.npy)") -> np.ndarray:
    """Returns the array of a `.npy`; nothing in it is unpickled.

    **Raises:** `InputError` as `open_binary`, or if it is no array or is damaged.
    """
    with open_binary(path, what) as file, reading(path, what):
        return _npy(path, path.stem, file, os.fstat(file.fileno()).st_size)


def _npy(path: Path, name: str, file: Any, size: int) -> np.ndarray:
    """Returns one array in NumPy's format, from a stream of `size` bytes."""
    shape, dtype, is_fortran, used = _npy_header(path, name, file)
    if dtype.kind == "O":
        raise InputError(
            f"{path}: `{name}` is a pickled object, expected a plain array."
        )
    if dtype.kind not in _PLAIN_KINDS or dtype.subdtype or not dtype.itemsize:
        raise InputError(f"{path}: `{name}` holds {dtype}, expected numbers or text.")
    wanted = math.prod(shape) * dtype.itemsize
    if wanted > size - used:
        raise InputError(
            f"{path}: `{name}` is {dtype}{shape} by its header, {wanted} bytes, but "
            f"has {size - used}; expected a whole array."
        )
    budget.check_bytes(path, wanted, f"`{name}` has ")
    content = np.empty(wanted, np.uint8)
    at = 0
    while at < wanted:
        block = file.read(min(_BLOCK_BYTES, wanted - at))
        if not block:
            raise InputError(
                f"{path}: `{name}` ends after {at} of {wanted} bytes, expected a whole "
                "array."
            )
        content[at : at + len(block)] = np.frombuffer(block, np.uint8)
        at += len(block)
    array = content.view(dtype).reshape(shape, order="F" if is_fortran else "C")
    return np.asarray(array, dtype.newbyteorder("="))


def _npy_header(
    path: Path, name: str, file: Any
) -> tuple[tuple[int, ...], np.dtype, bool, int]:
    """Returns shape, type, whether columns come first, and the header's own bytes."""
    # Six letters and the version of NumPy's format,
    magic = file.read(8)
    with reading(path, f"`{name}` in NumPy's format"):
        # eight bytes in all.
        if len(magic) < 8 or magic[:6] != b"\x93NUMPY" or magic[6] not in (1, 2, 3):
            raise ValueError(f"`{name}` begins with {magic!r}")
        width = 2 if magic[6] == 1 else 4
        length = int.from_bytes(file.read(width), "little")
        if length > _MAX_HEADER_BYTES:
            raise ValueError(f"`{name}` has a header of {length} bytes")
        text = file.read(length).decode("latin1" if magic[6] < 3 else "utf-8")
        match = _HEADER.fullmatch(text)
        if match is None:
            raise ValueError(f"`{name}` has the header {text.strip()[:80]!r}")
        entries = dict(_ENTRY.findall(match[1]))
        digits = re.findall(r"\d+", entries["shape"])
        shape = tuple(int(n) for n in digits if len(n) <= _MAX_DIGITS)
        # NumPy has 32 axes at most.
        if len(shape) != len(digits) or len(shape) > 32:
            raise ValueError(f"`{name}` has the shape {entries['shape'][:80]}")
        return (
            shape,
            _plain_dtype(entries["descr"]),
            entries["fortran_order"] == "True",
            # Bytes before the content: magic, length, text.
            8 + width + length,
        )


_VALUE = r"'[^']*'|\[[^{}]*\]|\([\dL, ]*\)|True|False"
_HEADER = re.compile(
    r"\{((?:\s*+'(?:descr|fortran_order|shape)'\s*+:\s*+(?:"
    + _VALUE
    + r")\s*+,?){3}\s*+)\}\s*+"
)
"""The header of a `.npy`: a dictionary as Python writes it, which is never run."""
_ENTRY = re.compile(r"'(descr|fortran_order|shape)'\s*+:\s*+(" + _VALUE + ")")


def _plain_dtype(descr: str) -> np.dtype:
    """Returns a type by its code, such as `<f8`; for any other code, one that readers
    refuse."""
    match = re.fullmatch(r"'([<>|=]?)([biufcSUO?])(\d{0,6})'", descr)
    return np.dtype(descr[1:-1]) if match else np.dtype("V1")
