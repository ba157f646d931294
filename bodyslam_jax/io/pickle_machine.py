"""An interpreter of pickles that can make plain data only.

A pickle is a program for a machine with a stack. Python's own machine looks up and
calls what the program names; this one knows lists, dictionaries, sets, tuples, numbers
and text, and inert stand-ins for the few names that result files hold: NumPy's arrays
and types, joblib's arrays, PyTorch's tensors. No object of a library is made by what
the program says: an array is made here, once its type, shape and bytes agree. What the
program makes, how deep, and in how many instructions is bounded.

Stand-ins hold a place for objects of libraries; `Plain` replaces them at the end by
plain data, and refuses data that a reader could not walk through.

The machine has the stack, the names and the account of what is made. Its subclass in
`safe_pickle` has the instructions (`pickle_instructions`) and what stands for names
(`pickle_names`).
"""

import dataclasses
import struct
from collections.abc import Callable, Collection, Mapping
from typing import Any, ClassVar

import numpy as np

from bodyslam_jax.io import plain_arrays
from bodyslam_jax.io.plain_arrays import (
    VALUE_BYTES,
    Account,
    ArrayType,
    Damaged,
    Refused,
    shown,
)

MAX_PICKLES = 4
"""Largest number of nested pickles, such as joblib's arrays of objects."""
MAX_LINE_BYTES = 65_536
"""Largest length of a line of protocol 0 that is not text but a name or a number,
bytes."""
MAX_COLLISIONS = 100
"""Largest number of keys that are tuples and share a hash: a few do by chance, more by
intent."""
Persistent = Callable[[Any], Any]
Instruction = Callable[["Machine"], None]
STOP = ord(".")
"""The instruction that ends a pickle."""
MAX_DEPTH = 64
"""Largest number of levels of nesting; results of tools have 10 at most."""
REFERENCE_BYTES = 8
"""Size of a reference to a value, bytes: a pointer of 64 bits."""
OBJECT_BYTES = 300
"""Memory of a container, bytes: an empty set, the largest, takes 240."""
BLOB_BYTES = 4096
"""Length from which bytes and Python 2's texts stay in the file until used, bytes."""
_ATOMS = frozenset({int, float, bool, type(None)})


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
        self.account.spend(REFERENCE_BYTES * len(values))
        for value in values:
            item, more, deep = self._visit(value, depth + 1)
            items.append(item)
            size += more
            levels = max(levels, deep)
        return items, size, levels + 1


class Machine:
    """Runs one pickle.

    Args:
        data: of the file, unpacked.
        at: where the pickle begins; after `load`, where it ended.
        stand_ins: packages whose objects become `StandIn`s.
        persistent: what stands for a reference to data outside the pickle.
    """

    instructions: ClassVar[Mapping[int, Instruction]] = {}
    """What each instruction does, by its code (`pickle_instructions`)."""
    calls: ClassVar[Mapping[str, Callable[..., Any]]] = {}
    """What stands for the functions and classes that a pickle may call
    (`pickle_names`)."""
    inert: ClassVar[Collection[str]] = ()
    """Names that a pickle may hold, but not call."""

    def __init__(
        self,
        data: bytes | bytearray,
        at: int,
        account: Account,
        stand_ins: tuple[str, ...] = (),
        persistent: Persistent | None = None,
        level: int = 0,
    ) -> None:
        if level >= MAX_PICKLES:
            raise Refused(f"more than {MAX_PICKLES} pickles within each other")
        self.data, self.view, self.at = data, memoryview(data), at
        self.account, self.stand_ins, self.level = account, stand_ins, level
        self.persistent = persistent
        self.stack: list[Any] = []
        self.marked: list[list[Any]] = []
        """Stacks below the marks that are open."""
        self.memo: dict[int, Any] = {}
        self.names: dict[tuple[str, str], Name] = {}
        self.hashes: dict[int, tuple] = {}
        self.collisions = 0

    def load(self) -> Any:
        """Returns the plain data that the pickle makes.

        **Raises:** `Refused` or `Damaged`; `IndexError` and others of Python's if the
        pickle is damaged.
        """
        data, account = self.data, self.account
        while True:
            code = data[self.at]
            self.at += 1
            if code == STOP:
                break
            account.steps -= 1
            if account.steps < 0:
                raise Refused("more instructions than its size on disk accounts for")
            step = self.instructions.get(code)
            if step is None:
                raise Damaged(f"{bytes([code])!r} is no instruction of a pickle")
            step(self)
        if len(self.stack) != 1 or self.marked:
            raise Damaged(f"it ends with {len(self.stack)} objects, not with one")
        return Plain(account).of(self.stack[0])

    # What instructions are made of

    def bytes_at(self, count: int) -> memoryview:
        """Returns the next bytes without copying them."""
        end = self.at + count
        if end > len(self.data):
            raise Damaged(f"{count} bytes, {len(self.data) - self.at} are there")
        found = self.view[self.at : end]
        self.at = end
        return found

    def number(self, layout: struct.Struct) -> Any:
        return layout.unpack(self.bytes_at(layout.size))[0]

    def line(self, most: int = MAX_LINE_BYTES) -> bytes:
        end = self.data.find(b"\n", self.at, self.at + most)
        if end < 0:
            raise Damaged(f"no end of a line within {most} bytes")
        found = bytes(self.view[self.at : end])
        self.at = end + 1
        return found

    def push(self, value: Any, cost: int = VALUE_BYTES) -> None:
        self.account.spend(cost)
        self.stack.append(value)

    def pop_mark(self) -> list[Any]:
        """Removes the last mark and returns all objects above it."""
        items, self.stack = self.stack, self.marked.pop()
        return items

    def named(self, module: Any, name: Any) -> Name:
        """Returns the stand-in for a name.

        **Raises:** `Refused` for every name that result files do not need.
        """
        if not (isinstance(module, str) and isinstance(name, str)):
            raise Refused("it wants to load a name that is no text")
        found = self.names.get((module, name))
        if found is not None:
            return found
        root, _, rest = module.partition(".")
        root = {"__builtin__": "builtins", "copy_reg": "copyreg"}.get(root, root)
        key = ".".join([root, rest, name] if rest else [root, name])
        key = key.replace("numpy._core.", "numpy.core.")
        if key in self.calls or key in self.inert:
            found = Name(key)
        elif any(f"{module}.".startswith(f"{package}.") for package in self.stand_ins):
            self.account.spend(OBJECT_BYTES + len(key))
            found = Name(key, is_stand_in=True)
        else:
            raise Refused(f"it wants to load {shown(f'{module}.{name}')[1:-1]}")
        self.names[module, name] = found
        return found

    def call(self, function: Any, arguments: Any) -> None:
        """Pushes what a function or class makes of its arguments."""
        if not isinstance(function, Name) or not isinstance(arguments, tuple):
            raise Refused(f"it wants to call {shown(function)}")
        if function.is_stand_in:
            return self.push(StandIn(function.key), 2 * OBJECT_BYTES)
        make = self.calls.get(function.key)
        if make is None:
            raise Refused(f"it wants to call {function.key}")
        self.push(make(self, *arguments), OBJECT_BYTES)

    def key(self, value: Any) -> Any:
        """Returns a value as the key of a dictionary or the element of a set."""
        if isinstance(value, Blob):
            value = content_of(value, self.account)
        if type(value) in (str, int, float, bool, bytes, type(None)):
            return value
        simple = (str, int, float, bool, bytes)
        if type(value) is not tuple or not all(type(x) in simple for x in value):
            raise Refused(f"{shown(value)} as the key of a dictionary")
        # Python spreads keys by their hash; that of numbers can be made the same.
        if self.hashes.setdefault(hash(value), value) != value:
            self.collisions += 1
            if self.collisions > MAX_COLLISIONS:
                raise Refused("keys that are made to be slow")
        return value

    def set_items(self, target: Any, items: list[Any]) -> None:
        if type(target) is not dict:
            raise Refused(f"it wants to change {shown(target)}")
        self.account.spend(2 * VALUE_BYTES * len(items))
        if len(items) % 2:
            raise Damaged("a key without a value")
        for k in range(0, len(items), 2):
            target[self.key(items[k])] = items[k + 1]

    def extend(self, target: Any, items: list[Any]) -> None:
        if type(target) is not list:
            raise Refused(f"it wants to change {shown(target)}")
        target.extend(items)

    def set_of(self, items: Any) -> set:
        self.account.spend(2 * VALUE_BYTES * len(items))
        return {self.key(item) for item in items}

    def remember(self, place: int) -> None:
        if self.memo.get(place) is None:
            self.account.spend(2 * VALUE_BYTES)
        self.memo[place] = self.stack[-1]

    def build(self) -> None:
        """Gives an object its state: only a stand-in can have one."""
        state = self.stack.pop()
        target = self.stack[-1]
        if isinstance(target, StandIn):
            # Objects with slots have a pair: dictionary, slots.
            if type(state) is tuple and state and type(state[0]) is dict:
                state = state[0]
            target.state = state
        elif isinstance(target, ArrayType):
            set_type(target, state)
        elif isinstance(target, ArrayToFill):
            target.value = self._array(state)
        elif isinstance(target, JoblibArray):
            # joblib writes an array's bytes behind the object that describes it.
            self.stack[-1] = self._joblib_array(state)
        else:
            raise Refused(f"it wants to change {shown(target)}")

    def _array(self, state: Any) -> Any:
        """Returns what `numpy.ndarray.__setstate__` would make."""
        # With or without a version before shape, type, order and content.
        if type(state) is not tuple or len(state) not in (4, 5):
            raise Refused("an array without shape, type and content")
        shape, of, by_column, content = state[-4:]
        shape = plain_arrays.shape_of(shape)
        if not isinstance(of, ArrayType) or type(by_column) not in (bool, int):
            raise Refused("an array without a type")
        if of.kind == "O":
            if type(content) is not list:
                raise Refused(f"{shown(content)} as the objects of an array")
            plain_arrays.num_bytes(of, shape, self.account)
            self.account.spend(VALUE_BYTES * len(content))
            return plain_arrays.listed(list(content), shape, self.account)
        return self.array(content, of, shape, bool(by_column))

    def array(
        self, content: Any, of: Any, shape: Any, by_column: bool = False
    ) -> np.ndarray:
        """Returns an array of bytes that the pickle holds."""
        if not isinstance(of, ArrayType):
            raise Refused("an array without a type")
        if isinstance(content, Blob):
            content = content.view
        elif type(content) is str:  # as Python 2 wrote bytes
            self.account.spend(len(content))
            content = content.encode("latin1")
        elif type(content) is not bytes:
            raise Refused(f"{shown(content)} as the bytes of an array")
        shape = plain_arrays.shape_of(shape)
        return plain_arrays.array_of(content, of, shape, self.account, by_column)

    def _joblib_array(self, state: Any) -> Any:
        if type(state) is not dict or not {"shape", "order", "dtype"} <= set(state):
            raise Refused("an array of joblib's without shape, order and type")
        of, order = state["dtype"], state["order"]
        shape = plain_arrays.shape_of(state["shape"])
        if not isinstance(of, ArrayType) or order not in ("C", "F"):
            raise Refused("an array of joblib's without order and type")
        if of.kind == "O":
            inner = type(self)(
                self.data, self.at, self.account, self.stand_ins, level=self.level + 1
            )
            found = inner.load()
            self.at = inner.at
            return found
        if state.get("numpy_array_alignment_bytes") is not None:
            self.bytes_at(self.bytes_at(1)[0])
        content = self.bytes_at(plain_arrays.num_bytes(of, shape, self.account))
        return plain_arrays.array_of(content, of, shape, self.account, order == "F")


def set_type(of: ArrayType, state: Any) -> None:
    """Sets a type as `numpy.dtype.__setstate__` would: only the order of bytes may
    change.

    The state is (version, order, subtype, names, fields, item size, alignment, flags).
    """
    # As the docstring says, or with metadata.
    if type(state) is not tuple or len(state) not in (8, 9):
        raise Refused("an array's type with an unknown state")
    version, order, subtype, names, fields, size, alignment, flags, *metadata = state
    known = (
        version in (3, 4)
        and order in ("<", ">", "|", "=")
        and subtype is names is fields is None
        and metadata in ([], [None])
        and size in (-1, of.size)
        and alignment in (-1, 1, 2, 4, 8)
        # NumPy's flags of types of objects and of text.
        and flags in {"O": (63,), "U": (8, 0)}.get(of.kind, (0,))
    )
    if not known:
        raise Refused("an array's type with fields, flags or sizes of its own")
    of.order = ">" if order == ">" else "<"


def content_of(blob: Blob, account: Account) -> str | bytes:
    account.spend(len(blob.view))
    return str(blob.view, "latin1") if blob.is_text else bytes(blob.view)
