"""Values of a pickle while it runs, and the plain data that they become.

Stand-ins hold a place for objects of libraries; `Plain` replaces them at the end, and
refuses data that a reader could not walk through.
"""

import dataclasses
from typing import Any

import numpy as np

from bodyslam_jax.io.plain_arrays import VALUE_BYTES, Account, ArrayType, Refused

MAX_DEPTH = 64
"""Largest number of levels of nesting; results of tools have 10 at most."""
OBJECT_BYTES = 300
"""Memory of a container, bytes: an empty set, the largest, takes 240."""
BLOB_BYTES = 4096
"""Length from which bytes and Python 2's texts stay in the file until used, bytes."""


class StandIn:
    """An object of a library that is not imported: keeps its state, does nothing."""

    def __init__(self, name: str) -> None:
        self.name = name
        """Of its class, with the module."""
        self.state: Any = None


@dataclasses.dataclass(frozen=True)
class Name:
    """What a pickle refers to by module and name; inert."""

    key: str
    is_stand_in: bool = False


@dataclasses.dataclass(frozen=True)
class Storage:
    """The numbers that PyTorch's tensors are views of."""

    of: ArrayType
    numbers: np.ndarray
    is_bfloat16: bool = False


class ArrayToFill:
    """Stands for an array between its creation and the instruction that fills it."""

    value: Any = None


class JoblibArray:
    """Stands for joblib's `NumpyArrayWrapper`: a head, with the bytes behind it."""


@dataclasses.dataclass(frozen=True)
class Blob:
    """Bytes, or a text of Python 2, that lie in the file."""

    view: memoryview
    is_text: bool


def content_of(blob: Blob, account: Account) -> str | bytes:
    account.spend(len(blob.view))
    return str(blob.view, "latin1") if blob.is_text else bytes(blob.view)


_ATOMS = frozenset({int, float, bool, type(None)})


class Plain:
    """Replaces stand-ins in what a pickle made, and measures it.

    Parts may be shared, so the size is counted as if every reference were written out:
    a few bytes can stand for more than a reader could walk through.
    """

    def __init__(self, account: Account) -> None:
        self.account = account
        self.done: dict[int, tuple[Any, Any, int, int]] = {}
        """By identity: the object itself, kept alive; what replaces it; its size in
        bytes and its levels of nesting, both with all that it refers to."""
        self.open: set[int] = set()

    def of(self, value: Any) -> Any:
        """Returns the data without stand-ins.

        **Raises:** `Refused` if the data contain themselves, are nested too deeply, are
        too large or are not plain.
        """
        return self._visit(value, 0)[0]

    def _visit(self, value: Any, depth: int) -> tuple[Any, int, int]:
        kind = type(value)
        if kind in _ATOMS or kind is complex or kind is slice:
            return value, VALUE_BYTES, 0
        if kind is str or kind is bytes:
            return value, VALUE_BYTES + len(value), 0
        if kind is np.ndarray:
            return value, 2 * VALUE_BYTES + value.nbytes, 0
        identity = id(value)
        if identity in self.done:
            _, found, size, levels = self.done[identity]
        elif identity in self.open:
            raise Refused("data that contain themselves")
        else:
            if depth >= MAX_DEPTH:
                raise Refused(f"data nested more than {MAX_DEPTH} deep")
            self.open.add(identity)
            found, size, levels = self._replace(value, depth)
            self.open.discard(identity)
            self.account.check(size, "repeated data")
            self.done[identity] = (value, found, size, levels)
        if depth + levels > MAX_DEPTH:
            raise Refused(f"data nested more than {MAX_DEPTH} deep")
        return found, size, levels

    def _replace(self, value: Any, depth: int) -> tuple[Any, int, int]:
        kind = type(value)
        if kind is list or kind is tuple:
            if _ATOMS.issuperset(map(type, value)):
                return value, VALUE_BYTES * (len(value) + 2), 1
            items, size, levels = self._visit_all(value, depth)
            if kind is tuple:
                return tuple(items), size, levels
            value[:] = items
            return value, size, levels
        if kind is dict:
            items, size, levels = self._visit_all(value.values(), depth)
            for key, item in zip(value, items, strict=True):
                value[key] = item
            size += sum(
                VALUE_BYTES + (len(k) if type(k) in (str, bytes) else 0) for k in value
            )
            return value, size, levels
        if kind is set or kind is frozenset:
            return value, *self._visit_all(value, depth)[1:]
        if kind is StandIn:
            (value.state,), size, levels = self._visit_all([value.state], depth)
            return value, size, levels
        if kind is ArrayToFill and value.value is not None:
            return self._visit(value.value, depth)
        if kind is Blob:
            found = content_of(value, self.account)
            return found, VALUE_BYTES + len(found), 0
        if kind is Name:
            return value.key, VALUE_BYTES + len(value.key), 0
        if kind is ArrayType:
            return value.code, VALUE_BYTES, 0
        raise Refused(f"{kind.__name__.lstrip('_')} without content")

    def _visit_all(self, values: Any, depth: int) -> tuple[list[Any], int, int]:
        items, size, levels = [], 2 * VALUE_BYTES, 0
        self.account.spend(8 * len(values))
        for value in values:
            item, more, deep = self._visit(value, depth + 1)
            items.append(item)
            size += more
            levels = max(levels, deep)
        return items, size, levels + 1
