"""Pickled files without running what is in them.

Pickle, joblib, PyTorch's zip files and object arrays of NumPy can hold code that runs
on loading. This unpickler makes numbers, text, lists, dictionaries and arrays, by
functions of its own, and refuses every other name before it is called. Objects of
libraries that the caller names become inert stand-ins that keep their state.
"""

import bz2
import collections
import dataclasses
import gzip
import io
import lzma
import pickle
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from bodyslam_jax.config.errors import InputError

_MAX_BYTES = 8 << 30
"""A larger array or archive is refused as a decompression bomb."""
_TEXT_PICKLES = (b"(d", b"(l", b"}", b"]")
"""How dictionaries and lists begin in protocols 0 and 1, which have no magic number."""

_STORAGES = {
    "DoubleStorage": "f8",
    "FloatStorage": "f4",
    "HalfStorage": "f2",
    "LongStorage": "i8",
    "IntStorage": "i4",
    "ShortStorage": "i2",
    "CharStorage": "i1",
    "ByteStorage": "u1",
    "BoolStorage": "?",
}


class Refused(pickle.UnpicklingError):
    """The pickle asks for something that is not plain data."""


class StandIn:
    """An object of a library that is not imported: keeps its state, does nothing."""

    state: Any = None

    def __new__(cls, *args: Any, **kwargs: Any) -> "StandIn":
        return object.__new__(cls)

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        pass

    def __setstate__(self, state: Any) -> None:
        # Objects with slots have a pair: dictionary, slots.
        if isinstance(state, tuple) and state and isinstance(state[0], dict):
            state = state[0]
        self.state = state


@dataclasses.dataclass(frozen=True)
class _Names:
    """What stands for each name that a pickle may ask for."""

    stand_ins: tuple[str, ...] = ()
    """Packages whose classes become `StandIn`s."""

    def find(self, module: str, name: str) -> Any:
        key = f"{module}.{name}".replace("numpy._core.", "numpy.core.")
        if key in _ALLOWED:
            return _ALLOWED[key]
        if any(f"{module}.".startswith(f"{package}.") for package in self.stand_ins):
            return type(name, (StandIn,), {})
        raise Refused(f"it wants to load {module}.{name}")


def restricted_load(path: Path, stand_ins: tuple[str, ...] = ()) -> Any:
    """Loads a pickle, joblib, `.pt`, `.npz` or `.npy` file made of plain data.

    Tensors become NumPy arrays.

    Args:
        stand_ins: packages, such as `"scipy.sparse"`, whose objects become `StandIn`s
            instead of being refused. The packages are not imported.

    **Raises:** `InputError`, one line that names the file, if it is damaged or holds
    anything else.
    """
    allowed = _Names(stand_ins)
    try:
        with path.open("rb") as file:
            head = file.read(8)
            file.seek(0)
            if head.startswith(b"PK\x03\x04"):
                return _load_zip(file, allowed)
            if head.startswith(b"\x93NUMPY"):
                return _load_array(file, allowed)
            stream = _decompressed(file, head)
            start = stream.tell()
            if not stream.read(2).startswith((b"\x80", *_TEXT_PICKLES)):
                raise InputError("neither a pickle nor an archive")
            stream.seek(start)
            return _Unpickler(stream, allowed).load()
    except Refused as error:
        raise InputError(f"{path}: refused, {error}.") from None
    except (MemoryError, RecursionError, Exception) as error:
        # A damaged pickle can fail anywhere, with any error.
        what = f"{type(error).__name__}: {error}".splitlines()[0][:150]
        raise InputError(f"{path}: not a readable result file ({what}).") from None


def _load_array(file: io.BufferedIOBase, allowed: _Names) -> Any:
    """Reads one array in NumPy's format; a lone pickled object is returned as it is."""
    version = np.lib.format.read_magic(file)
    reader = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if reader is None:
        raise Refused(f"unknown version {version} of NumPy's format")
    start = file.tell()
    shape, _, dtype = reader(file)
    if not dtype.hasobject:
        file.seek(start - 8)
        return np.lib.format.read_array(file, allow_pickle=False)
    found = _Unpickler(file, allowed).load()
    is_lone = shape == () and isinstance(found, np.ndarray) and found.size == 1
    return found.item() if is_lone else found


# The implementation in Python: joblib's arrays are read within its loop.
_Base: Any = getattr(pickle, "_Unpickler")


class _Unpickler(_Base):
    dispatch = dict(_Base.dispatch)

    def __init__(self, file: io.BufferedIOBase, allowed: _Names):
        # latin1 is what Python 2's arrays need.
        super().__init__(file, encoding="latin1")
        self.raw, self.allowed = file, allowed

    def find_class(self, module: str, name: str) -> Any:
        return self.allowed.find(module, name)

    def persistent_load(self, pid: Any) -> Any:
        raise Refused("it refers to data outside the file")

    def load_build(self) -> None:
        # Setting attributes of anything else could change this program's own functions.
        changeable = np.ndarray | np.dtype | _JoblibArray | StandIn
        if not isinstance(self.stack[-2], changeable):
            raise Refused(f"it wants to change a {type(self.stack[-2]).__name__}")
        super().load_build()
        if isinstance(self.stack[-1], _JoblibArray):
            # joblib writes an array's bytes behind the object that describes it.
            self.stack[-1] = self.stack[-1].read(self)

    dispatch[pickle.BUILD[0]] = load_build


class _JoblibArray:
    """Stands for joblib's `NumpyArrayWrapper`: a header, with the bytes behind it."""

    shape: tuple[int, ...]
    dtype: np.dtype
    order: str

    def read(self, unpickler: _Unpickler) -> Any:
        if self.dtype.hasobject:
            return _Unpickler(unpickler.raw, unpickler.allowed).load()
        if getattr(self, "numpy_array_alignment_bytes", None) is not None:
            (padding,) = unpickler.raw.read(1)
            unpickler.raw.read(padding)
        count = int(np.prod(self.shape, dtype=np.int64))
        size = count * self.dtype.itemsize
        if not 0 <= size <= _MAX_BYTES:
            raise Refused(f"an array of {size} bytes")
        array = np.frombuffer(unpickler.raw.read(size), self.dtype, count)
        order = "F" if self.order == "F" else "C"
        return array.reshape(self.shape, order=order).copy()


class _Storage:
    """PyTorch's storages, by name: only the type of their numbers matters."""

    def __init__(self, dtype: str):
        self.dtype = np.dtype(dtype)


def _load_zip(file: io.BufferedIOBase, allowed: _Names) -> Any:
    """A `.pt` of PyTorch 1.6 or later; or an `.npz`, as a dictionary."""
    with zipfile.ZipFile(file) as archive:
        total = sum(entry.file_size for entry in archive.infolist())
        if total > _MAX_BYTES:
            raise Refused(f"{total} bytes unpacked")
        pickles = [n for n in archive.namelist() if n.endswith("/data.pkl")]
        if not pickles:
            return {
                n.removesuffix(".npy"): _load_array(
                    io.BytesIO(archive.read(n)), allowed
                )
                for n in archive.namelist()
                if n.endswith(".npy")
            }
        folder = pickles[0].removesuffix("data.pkl")
        unpickler = _Unpickler(io.BytesIO(archive.read(pickles[0])), allowed)

        def storage(pid: Any) -> np.ndarray:
            kind, storage_type, key, _, count = pid
            if kind != "storage" or not isinstance(storage_type, _Storage):
                raise Refused(f"unknown reference {kind!r}")
            data = archive.read(f"{folder}data/{key}")
            return np.frombuffer(data, storage_type.dtype, int(count))

        unpickler.persistent_load = storage
        return unpickler.load()


def _decompressed(file: io.BufferedIOBase, head: bytes) -> io.BufferedIOBase:
    """joblib's compressed files look like what they are compressed with."""
    if head[:1] == b"x":
        unpacked = zlib.decompressobj().decompress(file.read(), _MAX_BYTES)
        return io.BytesIO(unpacked)
    openers: dict[bytes, Any] = {
        b"\x1f\x8b": gzip.open,
        b"BZh": bz2.open,
        b"\xfd7zXZ": lzma.open,
    }
    for magic, opener in openers.items():
        if head.startswith(magic):
            with opener(file) as unpacked:
                return io.BytesIO(unpacked.read(_MAX_BYTES))
    return file


def _reconstruct(_subtype: Any, _shape: Any, _kind: Any) -> np.ndarray:
    """An empty array, whose state follows; the shape given here is never used."""
    return np.ndarray((0,), dtype=np.uint8)


def _from_buffer(
    buffer: Any, dtype: np.dtype, shape: tuple[int, ...], order: str
) -> np.ndarray:
    array = np.frombuffer(buffer, dtype=dtype)
    return array.reshape(shape, order="F" if order == "F" else "C").copy()


def _scalar(dtype: np.dtype, data: Any = b"") -> Any:
    data = data.encode("latin1") if isinstance(data, str) else data
    if dtype.hasobject:
        raise Refused("a scalar of objects")
    return np.frombuffer(data, dtype, 1)[0]


def _encode(text: str, encoding: str = "latin1") -> bytes:
    """Bytes, as Python 2 pickles them."""
    return text.encode("latin1")


def _tensor(storage: np.ndarray, offset: int, size: Any, stride: Any, *_: Any) -> Any:
    """A copy of a strided view, checked to lie within its storage."""
    size, stride, offset = tuple(size), tuple(stride), int(offset)
    if not all(isinstance(n, int) and n >= 0 for n in (*size, *stride, offset)):
        raise Refused("a tensor of impossible shape")
    if 0 in size:
        return np.zeros(size, storage.dtype)
    last = offset + sum((n - 1) * s for n, s in zip(size, stride, strict=True))
    if last >= len(storage) or np.prod(size, dtype=np.float64) > _MAX_BYTES:
        raise Refused("a tensor larger than its storage")
    steps = [s * storage.dtype.itemsize for s in stride]
    return np.lib.stride_tricks.as_strided(storage[offset:], size, steps).copy()


def _parameter(data: Any, *_: Any) -> Any:
    return data


def _reconstructor(cls: Any, _base: Any, _state: Any) -> StandIn:
    """An instance of a new-style class, as Python 2 pickles it."""
    if isinstance(cls, type) and issubclass(cls, StandIn):
        return cls()
    raise Refused(f"it wants to make a {cls}")


_ALLOWED: dict[str, Any] = {
    "collections.OrderedDict": dict,
    "collections.defaultdict": lambda *_: {},
    "collections.deque": collections.deque,
    "__builtin__.long": int,
    "copy_reg._reconstructor": _reconstructor,
    "copyreg._reconstructor": _reconstructor,
    "_codecs.encode": _encode,
    "pathlib.PosixPath": lambda *parts: "/".join(str(p) for p in parts),
    "numpy.ndarray": np.ndarray,
    "numpy.dtype": np.dtype,
    "numpy.core.multiarray._reconstruct": _reconstruct,
    "numpy.core.multiarray.scalar": _scalar,
    "numpy.core.numeric._frombuffer": _from_buffer,
    "joblib.numpy_pickle.NumpyArrayWrapper": _JoblibArray,
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch._utils._rebuild_parameter": _parameter,
    "torch.Size": tuple,
}
_ALLOWED |= {f"torch.{name}": _Storage(dtype) for name, dtype in _STORAGES.items()}
_ALLOWED |= {
    f"{module}.{kind.__name__}": kind
    for module in ("builtins", "__builtin__")
    for kind in (
        *(object, list, dict, tuple, set, frozenset, slice),
        *(int, float, complex),
    )
}
"""What is called for each name; every other one is refused."""
