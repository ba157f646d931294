"""The arrays in SMPL's original pickles, without chumpy or SciPy.

These files hold chumpy expressions and scipy.sparse matrices beside NumPy arrays.
`io.safe_pickle` loads them as inert stand-ins, from whose state the numbers are taken.
"""

import pickle
from pathlib import Path
from typing import Any

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.safe_pickle import StandIn, restricted_load

_LIBRARIES = ("chumpy", "scipy.sparse")
_MAX_DEPTH = 8
"""Nested chumpy expressions that are followed."""


def read_pickle(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a pickled dictionary, by name; what is not an array is left out.

    **Raises:** `InputError`, one line that names the file, if it is not a pickle of a
    dictionary, is cut short, or asks for anything but plain data.
    """
    content = restricted_load(path, stand_ins=_LIBRARIES)
    if not isinstance(content, dict):
        found = type(content).__name__
        raise InputError(f"{path}: holds a {found}, expected a dictionary of arrays.")
    try:
        arrays = {str(key): _array(value) for key, value in content.items()}
    except Exception as error:  # a damaged state can fail anywhere, with any error
        what = " ".join(f"{type(error).__name__}: {error}".split())[:120]
        raise InputError(f"{path}: a damaged pickle ({what}).") from None
    return {key: value for key, value in arrays.items() if value is not None}


def _array(value: Any, depth: int = 0) -> np.ndarray | None:
    """The numbers of an array, a chumpy object or a sparse matrix; else `None`."""
    if isinstance(value, np.ndarray):
        return value
    if not isinstance(value, StandIn) or not isinstance(value.state, dict):
        return None
    state = value.state
    if "indptr" in state:
        return _dense(state, type(value).__name__.startswith("csr"))
    if depth > _MAX_DEPTH:
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
