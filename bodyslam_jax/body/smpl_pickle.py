"""Reads the arrays in SMPL's original pickles, without chumpy or SciPy.

These files contain chumpy expressions and scipy.sparse matrices beside NumPy arrays.
`io.safe_pickle` loads them as inert stand-ins, from whose state the numbers are taken.
"""

from pathlib import Path
from typing import Any

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.safe_pickle import StandIn, restricted_load

_LIBRARIES = ("chumpy", "scipy.sparse")
_MAX_DEPTH = 8
"""Largest depth of nested chumpy expressions that are evaluated."""
_MAX_NUMBERS = 20_000_000
"""Largest total size of the arrays that sparse matrices and selections expand to;
SMPL-X's regressor has 576,000 numbers, its shapes have 12 million."""


def read_pickle(path: Path) -> dict[str, np.ndarray]:
    """Reads the arrays of a pickled dictionary, by name; other values are skipped.

    **Raises:** `InputError`, one line that names the file, if it is not a pickle of a
    dictionary, is truncated, or contains anything but plain data.
    """
    content = restricted_load(path, stand_ins=_LIBRARIES)
    if not isinstance(content, dict):
        found = type(content).__name__
        raise InputError(f"{path}: holds a {found}, expected a dictionary of arrays.")
    expressions = _Expressions()
    try:
        arrays = {str(k): expressions.array(value) for k, value in content.items()}
    except Exception as error:  # a damaged state can fail anywhere, with any error
        what = " ".join(f"{type(error).__name__}: {error}".split())[:120]
        raise InputError(
            f"{path}: a damaged pickle ({what}), expected arrays of a body model."
        ) from None
    return {key: value for key, value in arrays.items() if value is not None}


class _Expressions:
    """Evaluates chumpy objects and sparse matrices to arrays, each of them once."""

    def __init__(self) -> None:
        self.found: dict[tuple[int, int], np.ndarray | None] = {}
        """Results by identity of a stand-in and depth of the expression."""
        self.left = _MAX_NUMBERS
        """How many numbers may still be expanded."""

    def array(self, value: Any, depth: int = 0) -> np.ndarray | None:
        """Evaluates an array, a chumpy object or a sparse matrix; else returns
        `None`."""
        if isinstance(value, np.ndarray):
            return value
        if not isinstance(value, StandIn) or not isinstance(value.state, dict):
            return None
        if (id(value), depth) not in self.found:
            self.found[id(value), depth] = self._evaluated(value, value.state, depth)
        return self.found[id(value), depth]

    def _evaluated(self, value: StandIn, state: dict, depth: int) -> np.ndarray | None:
        """Evaluates one object from its state, without the results in `found`."""
        if "indptr" in state:
            return self._dense(state, value.name.rpartition(".")[2].startswith("csr"))
        if depth > _MAX_DEPTH:
            return None
        if "idxs" in state and "a" in state:  # chumpy.reordering.Select
            return self._selected(state, depth)
        for key in ("x", "a", *state):
            found = self.array(state.get(key), depth + 1)
            if found is not None:
                return found
        return None

    def _selected(self, state: dict, depth: int) -> np.ndarray | None:
        """Evaluates chumpy's selection of entries of another expression."""
        source, index = self.array(state["a"], depth + 1), np.asarray(state["idxs"])
        if source is None or index.dtype.kind not in "iu":
            return None
        self._spend(index.size)
        shape = state.get("preferred_shape", index.shape)
        return source.ravel()[index.ravel()].reshape(shape)

    def _dense(self, state: dict, by_row: bool) -> np.ndarray | None:
        """Converts a compressed sparse matrix (SciPy's csc or csr) to a dense one."""
        shape = state.get("_shape", state.get("shape"))
        parts = [state.get(name) for name in ("data", "indices", "indptr")]
        if shape is None or not all(isinstance(part, np.ndarray) for part in parts):
            return None
        data, indices, indptr = (np.asarray(part) for part in parts)
        rows, columns = (int(x) for x in shape)
        if rows < 0 or columns < 0 or any(x.ndim != 1 for x in (data, indices, indptr)):
            raise ValueError(f"a sparse matrix of shape {(rows, columns)}")
        self._spend(rows * columns)
        counts = np.diff(indptr.astype(np.int64))
        outside = indices.size and not (
            0 <= indices.min() and indices.max() < (columns if by_row else rows)
        )
        length = rows if by_row else columns
        if (
            outside
            or len(counts) != length
            or (counts < 0).any()
            or not len(indices) == len(data) == counts.sum()
        ):
            raise ValueError("a sparse matrix that contradicts its own index")
        outer = np.repeat(np.arange(len(counts)), counts)
        dense = np.zeros((rows, columns), data.dtype)
        dense[(outer, indices) if by_row else (indices, outer)] = data
        return dense

    def _spend(self, numbers: int) -> None:
        """**Raises:** `ValueError` if all expansions exceed `_MAX_NUMBERS`."""
        self.left -= numbers
        if self.left < 0:
            raise ValueError(f"expressions of more than {_MAX_NUMBERS} numbers")
