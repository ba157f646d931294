"""An interpreter of pickles that can make plain data only.

A pickle is a program for a machine with a stack. Python's own machine looks up and
calls what the program names; this one knows lists, dictionaries, sets, tuples, numbers
and text, and inert stand-ins for the few names that result files hold: NumPy's arrays
and types, joblib's arrays, PyTorch's tensors. No object of a library is made by what
the program says: an array is made here, once its type, shape and bytes agree. What the
program makes, how deep, and in how many instructions is bounded.

The instructions are those of protocols 0 to 5, documented in CPython's `pickletools`.
"""

import codecs
import dataclasses
import re
import struct
from collections.abc import Callable
from typing import Any

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

MAX_DEPTH = 64
"""Levels of nesting; results of tools have 10 at most."""
MAX_PICKLES = 4
"""Pickles within pickles, as joblib's arrays of objects are."""
MAX_LINE_BYTES = 65_536
"""Of a line of protocol 0 that is no text: a name or a number."""
MAX_COLLISIONS = 100
"""Keys that are tuples and share a hash: a few by chance, more by intent."""
OBJECT_BYTES = 200
"""What a container costs in memory: an empty set, the largest, takes 216."""
BLOB_BYTES = 4096
"""Bytes and Python 2's texts from this length on stay in the file until used."""

Persistent = Callable[[Any], Any]


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


class _Array:
    """Stands for an array between its creation and the instruction that fills it."""

    value: Any = None


class _JoblibArray:
    """Stands for joblib's `NumpyArrayWrapper`: a head, with the bytes behind it."""


@dataclasses.dataclass(frozen=True)
class _Blob:
    """Bytes, or a text of Python 2, that lie in the file."""

    view: memoryview
    is_text: bool


_ATOMS = frozenset({int, float, bool, type(None)})


class Machine:
    """Runs one pickle.

    Args:
        data: of the file, unpacked.
        at: where the pickle begins; after `load`, where it ended.
        stand_ins: packages whose objects become `StandIn`s.
        persistent: what stands for a reference to data outside the pickle.
    """

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
        """The plain data that the pickle makes.

        **Raises:** `Refused` or `Damaged`; `IndexError` and others of Python's if the
        pickle is damaged.
        """
        data, account = self.data, self.account
        while True:
            code = data[self.at]
            self.at += 1
            if code == _STOP:
                break
            account.steps -= 1
            if account.steps < 0:
                raise Refused("more instructions than its size on disk accounts for")
            step = _STEPS.get(code)
            if step is None:
                raise Damaged(f"{bytes([code])!r} is no instruction of a pickle")
            step(self)
        if len(self.stack) != 1 or self.marked:
            raise Damaged(f"it ends with {len(self.stack)} objects, not with one")
        return _Plain(account).of(self.stack[0])

    # What instructions are made of

    def bytes_at(self, count: int) -> memoryview:
        """The next bytes, which are not copied."""
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
        """All objects above the last mark, which goes."""
        items, self.stack = self.stack, self.marked.pop()
        return items

    def named(self, module: Any, name: Any) -> Name:
        """The stand-in for a name.

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
        if key in _CALLS or key in _INERT:
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
        make = _CALLS.get(function.key)
        if make is None:
            raise Refused(f"it wants to call {function.key}")
        self.push(make(self, *arguments), OBJECT_BYTES)

    def key(self, value: Any) -> Any:
        """A value as the key of a dictionary or the element of a set."""
        if isinstance(value, _Blob):
            value = _content(value, self.account)
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
            _set_type(target, state)
        elif isinstance(target, _Array):
            target.value = self._array(state)
        elif isinstance(target, _JoblibArray):
            # joblib writes an array's bytes behind the object that describes it.
            self.stack[-1] = self._joblib_array(state)
        else:
            raise Refused(f"it wants to change {shown(target)}")

    def _array(self, state: Any) -> Any:
        """What `numpy.ndarray.__setstate__` would make."""
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
        """An array of bytes that the pickle holds."""
        if not isinstance(of, ArrayType):
            raise Refused("an array without a type")
        if isinstance(content, _Blob):
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
            inner = Machine(
                self.data, self.at, self.account, self.stand_ins, level=self.level + 1
            )
            found = inner.load()
            self.at = inner.at
            return found
        if state.get("numpy_array_alignment_bytes") is not None:
            self.bytes_at(self.bytes_at(1)[0])
        content = self.bytes_at(plain_arrays.num_bytes(of, shape, self.account))
        return plain_arrays.array_of(content, of, shape, self.account, order == "F")


def _set_type(of: ArrayType, state: Any) -> None:
    """What `numpy.dtype.__setstate__` would do: only the order of bytes may change.

    The state is (version, order, subtype, names, fields, item size, alignment, flags).
    """
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
        and flags in {"O": (63,), "U": (8, 0)}.get(of.kind, (0,))
    )
    if not known:
        raise Refused("an array's type with fields, flags or sizes of its own")
    of.order = ">" if order == ">" else "<"


def _content(blob: _Blob, account: Account) -> str | bytes:
    account.spend(len(blob.view))
    return str(blob.view, "latin1") if blob.is_text else bytes(blob.view)


class _Plain:
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
        """**Raises:** `Refused` if the data contain themselves, are nested too deeply,
        are too large or hold what is not plain."""
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
        if kind is _Array and value.value is not None:
            return self._visit(value.value, depth)
        if kind is _Blob:
            found = _content(value, self.account)
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


# What stands for the functions that result files name


def _type(_: Machine, code: Any = None, *flags: Any) -> ArrayType:
    if len(flags) > 2 or any(type(flag) not in (bool, int) for flag in flags):
        raise Refused("an array's type with fields, flags or sizes of its own")
    return plain_arrays.array_type(code)


def _reconstruct(_: Machine, kind: Any, shape: Any, code: Any) -> _Array:
    """An empty array, whose state follows; shape and type given here are not used."""
    if kind != Name("numpy.ndarray"):
        raise Refused(f"an array of class {shown(getattr(kind, 'key', kind))}")
    return _Array()


def _from_buffer(
    machine: Machine,
    content: Any,
    of: Any,
    shape: Any,
    order: Any,
    axes: Any = None,
) -> np.ndarray:
    if order not in ("C", "F", "A", "K"):
        raise Refused(f"an array in the order {shown(order)}")
    if order != "K" or axes is None:
        return machine.array(content, of, shape, order == "F")
    axes = plain_arrays.shape_of(axes)
    array = machine.array(content, of, shape)
    if sorted(axes) != list(range(array.ndim)):
        raise Refused(f"an array with the axes {axes}")
    machine.account.spend(array.nbytes)
    return np.ascontiguousarray(array.transpose(axes))


def _scalar(machine: Machine, of: Any, content: Any = b"") -> Any:
    return machine.array(content, of, ()).item()


def _joblib(_: Machine, *arguments: Any) -> _JoblibArray:
    return _JoblibArray()


def _encode(machine: Machine, text: Any, encoding: Any = "latin1") -> bytes:
    """Bytes, as protocols up to 2 hold them."""
    if type(text) is not str or encoding not in ("latin1", "latin-1"):
        raise Refused(f"{shown(text)} in the encoding {shown(encoding)}")
    machine.account.spend(len(text))
    return text.encode("latin1")


def _dict(machine: Machine, *arguments: Any) -> dict:
    """A dictionary, ordered or not, of pairs."""
    pairs = arguments[0] if arguments else []
    if len(arguments) > 1 or type(pairs) not in (list, tuple):
        raise Refused(f"a dictionary of {shown(pairs)}")
    found: dict[Any, Any] = {}
    for pair in pairs:
        if type(pair) not in (list, tuple) or len(pair) != 2:
            raise Refused("a dictionary of other things than pairs")
        machine.set_items(found, list(pair))
    return found


def _default_dict(machine: Machine, *arguments: Any) -> dict:
    """A dictionary; what it makes of missing keys is lost."""
    return _dict(machine, *arguments[1:])


def _sequence(make: Callable[[Any], Any]) -> Callable[..., Any]:
    def made(machine: Machine, items: Any = (), *more: Any) -> Any:
        if type(items) not in (list, tuple):
            raise Refused(f"a sequence of {shown(items)}")
        machine.account.spend(VALUE_BYTES * len(items))
        return make(items)

    return made


def _set(machine: Machine, items: Any = ()) -> set:
    if type(items) not in (list, tuple):
        raise Refused(f"a set of {shown(items)}")
    return machine.set_of(items)


def _bytes(machine: Machine, content: Any = b"") -> bytes | _Blob:
    if type(content) is bytes or isinstance(content, _Blob):
        return content
    raise Refused(f"bytes of {shown(content)}")


def _number(machine: Machine, value: Any = 0) -> int | float:
    if type(value) in (int, float, bool):
        return value
    raise Refused(f"a number of {shown(value)}")


def _complex(machine: Machine, real: Any, imaginary: Any) -> complex:
    return complex(_number(machine, real), _number(machine, imaginary))


def _slice(machine: Machine, *limits: Any) -> slice:
    if len(limits) != 3 or any(type(n) not in (int, type(None)) for n in limits):
        raise Refused("a slice of other things than whole numbers")
    return slice(*limits)


def _path(machine: Machine, *parts: Any) -> str:
    if not all(type(part) is str for part in parts):
        raise Refused("a path of other things than text")
    machine.account.spend(sum(len(part) + 1 for part in parts))
    return "/".join(parts)


def _reconstructor(machine: Machine, of: Any, base: Any, state: Any) -> StandIn:
    """An instance of a new-style class, as Python 2 pickles it."""
    if isinstance(of, Name) and of.is_stand_in and base == Name("builtins.object"):
        return StandIn(of.key)
    raise Refused(f"it wants to make {shown(getattr(of, 'key', of))}")


def _tensor(
    machine: Machine, storage: Any, offset: Any, size: Any, stride: Any, *_: Any
) -> np.ndarray:
    """A copy of a strided view, checked to lie within its storage."""
    if not isinstance(storage, Storage) or type(offset) is not int or offset < 0:
        raise Refused("a tensor without numbers")
    size, stride = plain_arrays.shape_of(size), plain_arrays.shape_of(stride)
    if len(size) != len(stride):
        raise Refused(f"a tensor of shape {size} with the strides {stride}")
    wanted = plain_arrays.num_bytes(storage.of, size, machine.account)
    numbers = storage.numbers
    if wanted > max(numbers.nbytes, MAX_REPEATED_BYTES):
        raise Refused(f"a tensor of shape {size}, larger than its storage")
    machine.account.spend(wanted * (3 if storage.is_bfloat16 else 1))
    if wanted:
        last = offset + sum((n - 1) * s for n, s in zip(size, stride, strict=True))
        if last >= len(numbers):
            raise Refused(f"a tensor of shape {size}, larger than its storage")
        steps = [s * numbers.itemsize for s in stride]
        view = np.lib.stride_tricks.as_strided(numbers[offset:], size, steps)
        array = np.array(view, order="C")
    else:
        array = np.zeros(size, numbers.dtype)
    if not storage.is_bfloat16:
        return array
    # The upper half of a float32.
    return (array.astype(np.uint32) << np.uint32(16)).view(np.float32)


MAX_REPEATED_BYTES = 16_000_000
"""Of a tensor that repeats its numbers: ten β for each of 400,000 frames."""


def _parameter(machine: Machine, data: Any, *_: Any) -> np.ndarray:
    if isinstance(data, np.ndarray):
        return data
    raise Refused("a parameter without a tensor")


_CALLS: dict[str, Callable[..., Any]] = {
    "numpy.dtype": _type,
    "numpy.core.multiarray._reconstruct": _reconstruct,
    "numpy.core.multiarray.scalar": _scalar,
    "numpy.core.numeric._frombuffer": _from_buffer,
    "joblib.numpy_pickle.NumpyArrayWrapper": _joblib,
    "torch._utils._rebuild_tensor": _tensor,
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch._utils._rebuild_parameter": _parameter,
    "torch.Size": _sequence(tuple),
    "collections.OrderedDict": _dict,
    "collections.defaultdict": _default_dict,
    "collections.deque": _sequence(list),
    "copyreg._reconstructor": _reconstructor,
    "_codecs.encode": _encode,
    "pathlib.PosixPath": _path,
    "pathlib._local.PosixPath": _path,
    "builtins.list": _sequence(list),
    "builtins.tuple": _sequence(tuple),
    "builtins.dict": _dict,
    "builtins.set": _set,
    "builtins.frozenset": _set,
    "builtins.bytes": _bytes,
    "builtins.bytearray": _bytes,
    "builtins.int": _number,
    "builtins.long": _number,
    "builtins.float": _number,
    "builtins.complex": _complex,
    "builtins.slice": _slice,
}
"""What is done for each name that may be called; every other one is refused."""
STORAGES = {
    "torch.DoubleStorage": "f8",
    "torch.FloatStorage": "f4",
    "torch.HalfStorage": "f2",
    "torch.BFloat16Storage": "u2",
    "torch.LongStorage": "i8",
    "torch.IntStorage": "i4",
    "torch.ShortStorage": "i2",
    "torch.CharStorage": "i1",
    "torch.ByteStorage": "u1",
    "torch.BoolStorage": "b1",
}
"""The types of PyTorch's storages, by name."""
_INERT = {"numpy.ndarray", "builtins.object", "builtins.str", *STORAGES}
"""Names that may be given as arguments, but not called."""


# The instructions


def _whole(value: int) -> int:
    """A whole number that fits 64 bits; later code converts it to such."""
    if not -(2**63) <= value < 2**64:
        raise Refused("a whole number of more than 64 bits")
    return value


def _fixed(layout: str) -> Callable[[Machine], None]:
    number = struct.Struct(layout)
    return lambda machine: machine.push(machine.number(number))


def _constant(value: Any) -> Callable[[Machine], None]:
    return lambda machine: machine.push(value)


def _long(layout: str) -> Callable[[Machine], None]:
    width = struct.Struct(layout)

    def step(machine: Machine) -> None:
        count = machine.number(width)
        if not 0 <= count <= 9:
            raise Refused("a whole number of more than 64 bits")
        value = int.from_bytes(machine.bytes_at(count), "little", signed=True)
        machine.push(_whole(value))

    return step


def _written_int(machine: Machine) -> None:
    text = machine.line()
    if text in (b"00", b"01"):
        return machine.push(text == b"01")
    if not re.fullmatch(rb"[+-]?\d{1,20}L?", text):
        raise Damaged(f"{text[:40]!r} as a whole number")
    machine.push(_whole(int(text.rstrip(b"L"))))


def _written_float(machine: Machine) -> None:
    text = machine.line()
    if not re.fullmatch(rb"[+-]?(\d+\.?\d*|\.\d+|inf|nan)(e[+-]?\d+)?", text.lower()):
        raise Damaged(f"{text[:40]!r} as a number")
    machine.push(float(text))


def _written_string(machine: Machine) -> None:
    """A text of Python 2, in quotes."""
    text = machine.line(len(machine.data))
    if len(text) < 2 or text[:1] not in b"'\"" or text[:1] != text[-1:]:
        raise Damaged(f"{text[:40]!r} as a text in quotes")
    machine.account.spend(2 * len(text))
    plain: Any = codecs.escape_decode(text[1:-1])[0]  # pyright: ignore
    machine.push(plain.decode("latin1"))


def _written_unicode(machine: Machine) -> None:
    line = machine.line(len(machine.data))
    machine.account.spend(4 * len(line))
    text = line.decode("raw-unicode-escape")
    if not text.isascii():
        text.encode("utf-8")  # fails for halves of characters: no file takes them
    machine.push(text)


def _sized(layout: str, kind: type, is_text: bool = False) -> Callable[[Machine], None]:
    """Bytes, or a text, behind their length."""
    width = struct.Struct(layout)

    def step(machine: Machine) -> None:
        count = machine.number(width)
        if count < 0:
            raise Damaged(f"a text of {count} characters")
        view = machine.bytes_at(count)
        if kind is str:
            # One character beyond latin1 makes all of a text four bytes wide.
            is_wide = count < BLOB_BYTES or np.frombuffer(view, "u1").max() > 0xC3
            machine.account.spend(4 * count if is_wide else count)
            return machine.push(str(view, "utf-8"))
        if count >= BLOB_BYTES:
            return machine.push(_Blob(view, is_text), OBJECT_BYTES)
        value = str(view, "latin1") if is_text else bytes(view)
        machine.push(value, VALUE_BYTES + count)

    return step


def _tuple_of(count: int) -> Callable[[Machine], None]:
    def step(machine: Machine) -> None:
        if len(machine.stack) < count:
            raise Damaged("a tuple of more objects than there are")
        items = tuple(machine.stack[len(machine.stack) - count :])
        del machine.stack[len(machine.stack) - count :]
        machine.push(items, 2 * VALUE_BYTES)

    return step


def _of_marked(make: Callable[[Machine, list], Any]) -> Callable[[Machine], None]:
    """A container of all objects above the mark."""

    def step(machine: Machine) -> None:
        items = machine.pop_mark()
        machine.push(make(machine, items), OBJECT_BYTES + 8 * len(items))

    return step


def _marked_dict(machine: Machine, items: list) -> dict:
    found: dict[Any, Any] = {}
    machine.set_items(found, items)
    return found


def _empty(make: Callable[[], Any]) -> Callable[[Machine], None]:
    return lambda machine: machine.push(make(), OBJECT_BYTES)


def _mark(machine: Machine) -> None:
    machine.account.spend(2 * VALUE_BYTES)
    machine.marked.append(machine.stack)
    machine.stack = []


def _pop(machine: Machine) -> None:
    if machine.stack:
        machine.stack.pop()
    else:
        machine.pop_mark()


def _pop_mark(machine: Machine) -> None:
    machine.pop_mark()


def _append(machine: Machine) -> None:
    item = machine.stack.pop()
    machine.extend(machine.stack[-1], [item])


def _appends(machine: Machine) -> None:
    items = machine.pop_mark()
    machine.extend(machine.stack[-1], items)


def _set_item(machine: Machine) -> None:
    value, key = machine.stack.pop(), machine.stack.pop()
    machine.set_items(machine.stack[-1], [key, value])


def _set_items(machine: Machine) -> None:
    items = machine.pop_mark()
    machine.set_items(machine.stack[-1], items)


def _add_items(machine: Machine) -> None:
    items, target = machine.pop_mark(), machine.stack[-1]
    if type(target) is not set:
        raise Refused(f"it wants to change {shown(target)}")
    target.update(machine.set_of(items))


def _put(layout: str) -> Callable[[Machine], None]:
    place = struct.Struct(layout)
    return lambda machine: machine.remember(machine.number(place))


def _get(layout: str) -> Callable[[Machine], None]:
    place = struct.Struct(layout)
    return lambda machine: machine.push(machine.memo[machine.number(place)], 8)


def _place(machine: Machine) -> int:
    text = machine.line()
    if not re.fullmatch(rb"\d{1,10}", text):
        raise Damaged(f"{text[:40]!r} as a number of an object")
    return int(text)


def _global(machine: Machine) -> None:
    module, name = machine.line().decode(), machine.line().decode()
    machine.push(machine.named(module, name), 8)


def _stack_global(machine: Machine) -> None:
    name, module = machine.stack.pop(), machine.stack.pop()
    machine.push(machine.named(module, name), 8)


def _reduce(machine: Machine) -> None:
    arguments, function = machine.stack.pop(), machine.stack.pop()
    machine.call(function, arguments)


def _new_with_names(machine: Machine) -> None:
    named = machine.stack.pop()
    if named != {}:
        raise Refused("it wants to make an object with named arguments")
    _reduce(machine)


def _instance(machine: Machine) -> None:
    """An object of an old class of Python 2, by its name."""
    of = machine.named(machine.line().decode(), machine.line().decode())
    machine.call(of, tuple(machine.pop_mark()))


def _object(machine: Machine) -> None:
    items = machine.pop_mark()
    machine.call(items[0], tuple(items[1:]))


def _reference(machine: Machine) -> None:
    pid = machine.stack.pop()
    if machine.persistent is None:
        raise Refused("it refers to data outside the file")
    machine.push(machine.persistent(pid), OBJECT_BYTES)


def _outside(_: Machine) -> None:
    raise Refused("it refers to data outside the file")


def _protocol(machine: Machine) -> None:
    (version,) = machine.bytes_at(1)
    if version > 5:
        raise Refused(f"a pickle of protocol {version}, expected 0 to 5")


def _frame(machine: Machine) -> None:
    """The length of a part, for those who read in parts."""
    length = machine.number(struct.Struct("<Q"))
    if length > len(machine.data) - machine.at:
        raise Damaged(f"{length} bytes, {len(machine.data) - machine.at} are there")


_STOP = ord(".")
_STEPS: dict[int, Callable[[Machine], None]] = {
    ord(code): step
    for code, step in {
        "(": _mark,
        "0": _pop,
        "1": _pop_mark,
        "2": lambda machine: machine.push(machine.stack[-1], 8),
        "F": _written_float,
        "G": _fixed(">d"),
        "I": _written_int,
        "J": _fixed("<i"),
        "K": _fixed("<B"),
        "M": _fixed("<H"),
        "L": _written_int,
        "\x8a": _long("<B"),
        "\x8b": _long("<i"),
        "N": _constant(None),
        "\x88": _constant(True),
        "\x89": _constant(False),
        "S": _written_string,
        "T": _sized("<i", bytes, is_text=True),
        "U": _sized("<B", bytes, is_text=True),
        "B": _sized("<I", bytes),
        "C": _sized("<B", bytes),
        "\x8e": _sized("<Q", bytes),
        "\x96": _sized("<Q", bytes),
        "V": _written_unicode,
        "X": _sized("<I", str),
        "\x8c": _sized("<B", str),
        "\x8d": _sized("<Q", str),
        ")": _empty(tuple),
        "t": _of_marked(lambda _, items: tuple(items)),
        "\x85": _tuple_of(1),
        "\x86": _tuple_of(2),
        "\x87": _tuple_of(3),
        "]": _empty(list),
        "l": _of_marked(lambda _, items: items),
        "a": _append,
        "e": _appends,
        "}": _empty(dict),
        "d": _of_marked(_marked_dict),
        "s": _set_item,
        "u": _set_items,
        "\x8f": _empty(set),
        "\x90": _add_items,
        "\x91": _of_marked(Machine.set_of),
        "c": _global,
        "\x93": _stack_global,
        "R": _reduce,
        "\x81": _reduce,
        "\x92": _new_with_names,
        "i": _instance,
        "o": _object,
        "b": Machine.build,
        "p": lambda machine: machine.remember(_place(machine)),
        "q": _put("<B"),
        "r": _put("<I"),
        "\x94": lambda machine: machine.remember(len(machine.memo)),
        "g": lambda machine: machine.push(machine.memo[_place(machine)], 8),
        "h": _get("<B"),
        "j": _get("<I"),
        "P": _outside,
        "Q": _reference,
        "\x97": _outside,
        "\x98": _outside,
        "\x80": _protocol,
        "\x95": _frame,
    }.items()
}
"""The instructions by their codes; those that import through a registry are missing."""
