"""Sums of rows that share an index: normal equations in blocks."""

import numpy as np


def sum_by(index: np.ndarray, values: np.ndarray, num: int) -> np.ndarray:
    """Sums of `values` (m, ...) over the rows of each index (m,): (num, ...)."""
    flat = values.reshape(len(index), int(np.prod(values.shape[1:])))
    sums = [np.bincount(index, column, num) for column in flat.T]
    return np.stack(sums, axis=-1).reshape(num, *values.shape[1:])
