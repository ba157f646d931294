"""Operations on arrays: runs of true entries, sums of rows that share an index, and the
standard deviation by a median."""

import numpy as np
from jaxtyping import Bool

SIGMA_OF_MEDIAN = 1.4826
"""Standard deviation over the median absolute value of normal errors: 1 over the normal
quantile of 75 %."""


def runs(present: Bool[np.ndarray, " t"]) -> list[slice]:
    """Returns the maximal runs of consecutive true entries of `present`, as slices."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], present, [False]])))
    return [slice(a, b) for a, b in edges.reshape(-1, 2)]


def sum_by(index: np.ndarray, values: np.ndarray, num: int) -> np.ndarray:
    """Returns (num, ...): for each index, the sum of the rows of `values` (m, ...) that
    have it in `index` (m,)."""
    flat = values.reshape(len(index), int(np.prod(values.shape[1:])))
    sums = [np.bincount(index, column, num) for column in flat.T]
    return np.stack(sums, axis=-1).reshape(num, *values.shape[1:])
