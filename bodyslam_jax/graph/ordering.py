"""The order in which chunks of frames are eliminated.

The order of the kinds of variables (landmarks, postures, people and cameras, globals)
is fixed: see `solver/linear_system.py`.

A landmark connects all chunks that observe it. In the order of time, a loop closure
connects distant chunks, and the bandwidth of the reduced camera matrix grows to the
length of the video. Chunks are then sorted by the second eigenvector of the Laplacian
of their covisibility graph (S. Barnard, A. Pothen, H. Simon, A spectral algorithm for
envelope reduction of sparse matrices, 1993). Runs in NumPy when a problem is made.

The longest track determines the bandwidth of the reduced camera matrix. A few
landmarks that are observed much longer than all others are therefore eliminated after
the cameras, with the globals (`choose_long_tracks`): they widen the arrow of the
globals, and the band becomes as narrow as the other landmarks allow.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

CHUNK = 10
"""Frames in a chunk."""
CAMERAS = 6 * CHUNK
"""Coordinates of a chunk's cameras."""
PERSON_COORDINATES = 81
"""Approximate number of a person's coordinates that are left in a chunk after its inner
frames are eliminated."""
_MAX_COST_RATIO = 0.7
"""Chunks are reordered only if the cost falls below this share of the cost in the order
of time, as reordering needs gathers."""
_LANDMARK_BATCH = 4096
"""Number of landmarks that are processed at once."""
_MAX_CHUNKS = 2000
"""Largest number of chunks: their graph is a dense table, then of 32 MB."""
_TABLE_CHUNK_COST = 5000.0
"""Cost of one chunk of a landmark's table, in multiplications."""
_MAX_LONG_TRACK_COST_RATIO = 0.8
"""The cost must fall below this share of the cost without long tracks."""
_GROUP_COUNTS = (1, 2, 4, 8, 16)
"""Allowed numbers of groups: few, so that videos share a program."""
_MAX_LANDMARK_SHARE = 0.1
"""Largest share of all landmarks."""


class Ordering(NamedTuple):
    """An order of elimination."""

    order: Int[np.ndarray, " c"] | None
    """The chunk at each position; `None` for the order of time."""
    reach: int
    """Largest distance, in this order, of chunks adjacent in time."""


def order_chunks(
    landmark: Int[np.ndarray, " p"],
    chunk: Int[np.ndarray, " p"],
    count: int,
    num_people: int,
) -> Ordering:
    """Returns the order of time of `count` chunks, unless another costs much less.

    `landmark` and `chunk` are `p` distinct pairs of a landmark and a chunk that
    observes it, sorted by landmark.
    """
    in_time = Ordering(None, 1)
    begin = np.flatnonzero(np.diff(landmark, prepend=-1))
    own = num_people * PERSON_COORDINATES

    def cost(place, reach):
        """Returns the multiplications to factorise chunks and eliminate landmarks."""
        at = place[chunk]
        span = np.maximum.reduceat(at, begin) - np.minimum.reduceat(at, begin) + 1.0
        rows = reach * own + max(span.max() - 1, reach) * CAMERAS
        return count * (own + CAMERAS) * rows**2 + 3 * CAMERAS**2 * np.sum(span**2)

    if not 3 < count <= _MAX_CHUNKS:
        return in_time
    order = _spectral(landmark, chunk, begin, count)
    place = np.argsort(order)
    reach = int(np.abs(np.diff(place)).max())
    if cost(place, reach) > _MAX_COST_RATIO * cost(np.arange(count), 1):
        return in_time
    return Ordering(order, reach)


def _spectral(landmark, chunk, begin, count) -> Int[np.ndarray, " c"]:
    # The logarithm, as one landmark widens the band as much as a hundred.
    shared = np.log1p(_shared(landmark, chunk, begin, count))
    k = np.arange(count - 1)
    # Neighbours in time are always connected: people couple them, and the graph must
    # not fall apart where tracking was interrupted.
    in_time = 1 + shared[k, k + 1].mean()
    shared[k, k + 1] += in_time
    shared[k + 1, k] += in_time
    np.fill_diagonal(shared, 0)
    _, vectors = np.linalg.eigh(np.diag(shared.sum(axis=1)) - shared)
    order = np.argsort(vectors[:, 1], kind="stable")
    return order if order[0] < order[-1] else order[::-1]


def _shared(landmark, chunk, begin, count) -> Float[np.ndarray, "c c"]:
    """Returns the number of landmarks that both of two chunks observe."""
    shared = np.zeros((count, count))
    row = np.searchsorted(landmark[begin], landmark)
    for first in range(0, len(begin), _LANDMARK_BATCH):
        here = slice(*np.searchsorted(row, [first, first + _LANDMARK_BATCH]))
        observes = np.zeros((_LANDMARK_BATCH, count), np.float32)
        observes[row[here] - first, chunk[here]] = 1
        shared += observes.T @ observes
    return shared


def choose_long_tracks(
    span: Int[np.ndarray, " l"], num_chunks: int, own: int, reach: int, size: int
) -> Int[np.ndarray, " k"]:
    """Returns the landmarks to be eliminated with the globals, longest track first.

    Their number `k` is a multiple of `size`; it is 0 unless this is clearly cheaper.

    Args:
        span: number of chunks from the first to the last one that observes each
            landmark, both included, in the order of elimination; before that order is
            known, the number of chunks that observe it. 0 for landmarks without
            observations.
        num_chunks: number of chunks in the video.
        own: number of coordinates of people that are left in each chunk after its inner
            frames are eliminated.
        reach: largest distance, in the order of elimination, between chunks that are
            adjacent in time.
        size: number of landmarks in a group.
    """
    order = np.argsort(-span, kind="stable")
    ranked = span[order].astype(float)
    most = _MAX_LANDMARK_SHARE * np.sum(span > 0)
    counts = [0, *(size * n for n in _GROUP_COUNTS if size * n <= most)]
    pivot = own + CAMERAS

    def cost(count):
        """Returns the multiplications to factorise the chain, eliminate the remaining
        landmarks and build the tables, with `count` long tracks."""
        rest = ranked[count:]
        width = int(max(rest[0] - 1, reach))
        back = np.arange(width)
        people = own * (back < reach)
        rows = CAMERAS * (width - back) + people + 3 * count
        chunk = np.sum(rows * (CAMERAS + people)) + pivot * (rows[:1].sum() + pivot)
        chunk += (3 * count) ** 2
        tables = _TABLE_CHUNK_COST * CHUNK * (rest.sum() + count * num_chunks)
        return num_chunks * pivot * chunk + 1.5 * CAMERAS**2 * np.sum(rest**2) + tables

    if len(counts) == 1:
        return order[:0]
    costs = [cost(count) for count in counts]
    best = int(np.argmin(costs))
    return order[
        : counts[best] if costs[best] < _MAX_LONG_TRACK_COST_RATIO * costs[0] else 0
    ]
