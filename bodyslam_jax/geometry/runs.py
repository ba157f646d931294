"""Stretches of frames that follow one another."""

import numpy as np
from jaxtyping import Bool


def runs(present: Bool[np.ndarray, " t"]) -> list[slice]:
    """The stretches of consecutive frames in `present`."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], present, [False]])))
    return [slice(a, b) for a, b in edges.reshape(-1, 2)]
