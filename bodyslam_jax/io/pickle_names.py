"""Replacements of the names in result files: NumPy, joblib, PyTorch, collections.

No function here calls what it stands for. NumPy's arrays, their types and PyTorch's
tensors are described by the pickle; what it says is checked, and the array is made by
`plain_arrays`.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from bodyslam_jax.io import plain_arrays
from bodyslam_jax.io.pickle_machine import (
    ArrayToFill,
    Blob,
    JoblibArray,
    Machine,
    Name,
    StandIn,
    Storage,
)
from bodyslam_jax.io.plain_arrays import VALUE_BYTES, ArrayType, Refused, shown

MAX_REPEATED_BYTES = 16_000_000
"""Largest size of a tensor that repeats its numbers, bytes: ten β for each of 400,000
frames."""


def _type(_: Machine, code: Any = None, *flags: Any) -> ArrayType:
    if len(flags) > 2 or any(type(flag) not in (bool, int) for flag in flags):
        raise Refused("an array's type with fields, flags or sizes of its own")
    return plain_arrays.array_type(code)


def _reconstruct(_: Machine, kind: Any, shape: Any, code: Any) -> ArrayToFill:
    """Returns an empty array, whose state follows; shape and type given here are not
    used."""
    if kind != Name("numpy.ndarray"):
        raise Refused(f"an array of class {shown(getattr(kind, 'key', kind))}")
    return ArrayToFill()


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


def _joblib(_: Machine, *arguments: Any) -> JoblibArray:
    return JoblibArray()


def _encode(machine: Machine, text: Any, encoding: Any = "latin1") -> bytes:
    """Returns bytes as protocols up to 2 hold them."""
    if type(text) is not str or encoding not in ("latin1", "latin-1"):
        raise Refused(f"{shown(text)} in the encoding {shown(encoding)}")
    machine.account.spend(len(text))
    return text.encode("latin1")


def _dict(machine: Machine, *arguments: Any) -> dict:
    """Returns a dictionary, ordered or not, of pairs."""
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
    """Returns a dictionary, without the default for missing keys."""
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


def _bytes(machine: Machine, content: Any = b"") -> bytes | Blob:
    if type(content) is bytes or isinstance(content, Blob):
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
    """Returns an instance of a new-style class, as Python 2 pickles it."""
    if isinstance(of, Name) and of.is_stand_in and base == Name("builtins.object"):
        return StandIn(of.key)
    raise Refused(f"it wants to make {shown(getattr(of, 'key', of))}")


def _tensor(
    machine: Machine, storage: Any, offset: Any, size: Any, stride: Any, *_: Any
) -> np.ndarray:
    """Returns a copy of a strided view, checked to lie within its storage."""
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


def _parameter(machine: Machine, data: Any, *_: Any) -> np.ndarray:
    if isinstance(data, np.ndarray):
        return data
    raise Refused("a parameter without a tensor")


CALLS: dict[str, Callable[..., Any]] = {
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
"""Function that replaces each name that may be called; every other name is refused."""
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
INERT = {"numpy.ndarray", "builtins.object", "builtins.str", *STORAGES}
"""Names that may be given as arguments, but not called."""
