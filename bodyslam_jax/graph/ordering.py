"""In which order chunks of frames are eliminated; NumPy, at the door.

A landmark connects all chunks that see it. In the order of time, a place that is seen
again connects what lies far apart, and the band of the camera matrix becomes as wide as
the video is long. Chunks then stand in the order of the second eigenvector of the
Laplacian of their graph, which puts side by side what sees the same (S. Barnard, A.
Pothen, H. Simon, A spectral algorithm for envelope reduction of sparse matrices, 1993).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

CHUNK = 10
"""Frames in a chunk."""
CAMERAS = 6 * CHUNK
"""Coordinates of a chunk's cameras."""
PERSON = 81
"""Coordinates that a person keeps of a chunk, about."""
_GAIN = 0.7
"""An order other than time's must save this much: it is gathered to and fro."""
_TOGETHER = 4096
"""Landmarks that are counted at once."""
_MOST = 2000
"""Chunks that are ordered at most: their graph is a dense table, of 32 MB then."""


class Ordering(NamedTuple):
    """Where chunks stand."""

    order: Int[np.ndarray, " c"] | None
    """The chunk at each place; `None` in the order of time."""
    reach: int
    """Places between a chunk and the next in time, at most."""


def order_chunks(
    landmark: Int[np.ndarray, " p"],
    chunk: Int[np.ndarray, " p"],
    count: int,
    num_people: int,
) -> Ordering:
    """The order of time of `count` chunks, unless another costs clearly less; `p` pairs
    of a landmark and a chunk that sees it, none of them twice and sorted by landmark.
    """
    in_time = Ordering(None, 1)
    begin = np.flatnonzero(np.diff(landmark, prepend=-1))
    own = num_people * PERSON

    def cost(place, reach):
        """Products that landmarks and the factorisation of all chunks take."""
        at = place[chunk]
        span = np.maximum.reduceat(at, begin) - np.minimum.reduceat(at, begin) + 1.0
        rows = reach * own + max(span.max() - 1, reach) * CAMERAS
        return count * (own + CAMERAS) * rows**2 + 3 * CAMERAS**2 * np.sum(span**2)

    if not 3 < count <= _MOST:
        return in_time
    order = _spectral(landmark, chunk, begin, count)
    place = np.argsort(order)
    reach = int(np.abs(np.diff(place)).max())
    if cost(place, reach) > _GAIN * cost(np.arange(count), 1):
        return in_time
    return Ordering(order, reach)


def _spectral(landmark, chunk, begin, count) -> Int[np.ndarray, " c"]:
    # A band is as wide for one landmark as for a hundred.
    shared = np.log1p(_shared(landmark, chunk, begin, count))
    k = np.arange(count - 1)
    # Time connects neighbours: people do, and an interruption parts no graph.
    in_time = 1 + shared[k, k + 1].mean()
    shared[k, k + 1] += in_time
    shared[k + 1, k] += in_time
    np.fill_diagonal(shared, 0)
    _, vectors = np.linalg.eigh(np.diag(shared.sum(axis=1)) - shared)
    order = np.argsort(vectors[:, 1], kind="stable")
    return order if order[0] < order[-1] else order[::-1]


def _shared(landmark, chunk, begin, count) -> Float[np.ndarray, "c c"]:
    """How many landmarks two chunks both see."""
    shared = np.zeros((count, count))
    row = np.searchsorted(landmark[begin], landmark)
    for first in range(0, len(begin), _TOGETHER):
        here = slice(*np.searchsorted(row, [first, first + _TOGETHER]))
        sees = np.zeros((_TOGETHER, count), np.float32)
        sees[row[here] - first, chunk[here]] = 1
        shared += sees.T @ sees
    return shared
