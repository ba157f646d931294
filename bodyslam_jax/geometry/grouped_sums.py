"""Sums of rows that share an index, as in block-wise normal equations."""

import numpy as np


def sum_by(index: np.ndarray, values: np.ndarray, num: int) -> np.ndarray:
    """Returns (num, ...): for each index, the sum of the rows of `values` (m, ...) that
    have it in `index` (m,)."""
    flat = values.reshape(len(index), int(np.prod(values.shape[1:])))
    sums = [np.bincount(index, column, num) for column in flat.T]
    return np.stack(sums, axis=-1).reshape(num, *values.shape[1:])
