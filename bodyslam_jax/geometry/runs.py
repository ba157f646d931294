"""Runs of consecutive frames."""

import numpy as np
from jaxtyping import Bool


def runs(present: Bool[np.ndarray, " t"]) -> list[slice]:
    """Returns the maximal runs of consecutive true entries of `present`, as slices."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], present, [False]])))
    return [slice(a, b) for a, b in edges.reshape(-1, 2)]
