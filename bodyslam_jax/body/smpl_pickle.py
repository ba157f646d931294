"""SMPL's original pickles, read without chumpy or SciPy and without trusting them.

A pickle is a program. This one may make NumPy arrays and plain containers; objects of
chumpy and scipy.sparse become inert stand-ins from which the numbers are taken. Any
other name is refused when the pickle asks for it, which is before anything is called.
"""

import collections
import pickle
from pathlib import Path
from typing import Any

import numpy as np


class _StandIn:
    """An object of a library that is not imported: keeps its state, does nothing."""

    state: Any = None

    def __new__(cls, *args, **kwargs):
        return object.__new__(cls)

    def __init__(self, *args, **kwargs):
        pass

    def __setstate__(self, state):
        # Objects with slots have a pair: dictionary, slots.
        if isinstance(state, tuple) and state and isinstance(state[0], dict):
            state = state[0]
        self.state = state


def _reconstruct(subtype, shape, dtype):
    if subtype is not np.ndarray:
        raise pickle.UnpicklingError("an array type that is not NumPy's own")
    return np.ndarray.__new__(np.ndarray, (0,), np.dtype("int8"))


def _scalar(dtype, data=b""):
    if dtype.hasobject:
        raise pickle.UnpicklingError("a scalar that holds an object")
    data = data.encode("latin1") if isinstance(data, str) else data
    return np.frombuffer(data, dtype, 1)[0]


def _encode(text, encoding="latin1"):
    if encoding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError(f"text in {encoding!r}")
    return text.encode("latin1")


def _reconstructor(cls, base, state):
    """What Python 2 writes for an instance of a new-style class."""
    if isinstance(cls, type) and issubclass(cls, _StandIn):
        return cls()
    raise pickle.UnpicklingError(f"an instance of {cls}")


_ALLOWED: dict[tuple[str, str], Any] = {
    ("_codecs", "encode"): _encode,
    ("collections", "OrderedDict"): collections.OrderedDict,
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
}
for _module in ("numpy.core.multiarray", "numpy._core.multiarray"):
    _ALLOWED[_module, "_reconstruct"] = _reconstruct
    _ALLOWED[_module, "scalar"] = _scalar
for _module in ("copy_reg", "copyreg"):
    _ALLOWED[_module, "_reconstructor"] = _reconstructor
for _module in ("__builtin__", "builtins"):
    for _type in (object, list, dict, tuple, set, int, float, complex, slice):
        _ALLOWED[_module, _type.__name__] = _type
_ALLOWED["__builtin__", "long"] = int


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in _ALLOWED:
            return _ALLOWED[module, name]
        if module.split(".")[0] == "chumpy" or module.startswith("scipy.sparse"):
            return type(name, (_StandIn,), {})
        raise pickle.UnpicklingError(f"it asks for {module}.{name}, which is refused")


def read_pickle(path: Path) -> dict[str, Any]:
    """The arrays of a pickled dictionary, by name; what is not an array is left out.

    **Raises:** `ValueError` if the file is not a pickle, is cut short, or asks for
    anything but arrays.
    """
    with open(path, "rb") as file:
        try:
            content = _Unpickler(file, encoding="latin1").load()
            if isinstance(content, dict):
                content = {str(key): _array(value) for key, value in content.items()}
        except pickle.UnpicklingError as error:
            raise ValueError(f"{path}: not a usable pickle: {_line(error)}.") from None
        except Exception as error:
            # Damaged bytes make pickle raise nearly anything.
            kind = type(error).__name__
            raise ValueError(
                f"{path}: not a pickle, or a damaged one ({kind}: {_line(error)})."
            ) from None
    if not isinstance(content, dict):
        found = type(content).__name__
        raise ValueError(f"{path}: holds a {found}, expected a dictionary of arrays.")
    return {key: value for key, value in content.items() if value is not None}


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:120].rstrip(".")


def _array(value: Any, depth: int = 0) -> np.ndarray | None:
    """The numbers of an array, a chumpy object or a sparse matrix; else `None`."""
    if isinstance(value, np.ndarray):
        return value
    if not isinstance(value, _StandIn) or not isinstance(value.state, dict):
        return None
    state = value.state
    if "indptr" in state:
        return _dense(state, type(value).__name__.startswith("csr"))
    if depth > 8:
        return None
    if "idxs" in state and "a" in state:  # chumpy.reordering.Select
        source, index = _array(state["a"], depth + 1), np.asarray(state["idxs"])
        if source is None or index.dtype.kind not in "iu":
            return None
        shape = state.get("preferred_shape", index.shape)
        return source.ravel()[index.ravel()].reshape(shape)
    for key in ("x", "a", *state):
        found = _array(state.get(key), depth + 1)
        if found is not None:
            return found
    return None


def _dense(state: dict, by_row: bool) -> np.ndarray | None:
    """A compressed sparse matrix (SciPy's csc or csr) as a plain one."""
    shape = state.get("_shape", state.get("shape"))
    parts = [state.get(name) for name in ("data", "indices", "indptr")]
    if shape is None or not all(isinstance(part, np.ndarray) for part in parts):
        return None
    data, indices, indptr = (np.asarray(part) for part in parts)
    rows, columns = (int(x) for x in shape)
    counts = np.diff(indptr)
    if rows * columns > 10**8 or (counts < 0).any() or counts.sum() != len(data):
        raise pickle.UnpicklingError("a sparse matrix that contradicts its own index")
    outer = np.repeat(np.arange(len(counts)), counts)
    dense = np.zeros((rows, columns), data.dtype)
    dense[(outer, indices) if by_row else (indices, outer)] = data
    return dense
