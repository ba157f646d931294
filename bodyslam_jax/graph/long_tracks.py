"""Selects the landmarks with long tracks, which are eliminated with the globals.

The longest track determines the bandwidth of the reduced camera matrix. A few
landmarks that are observed much longer than all others are therefore eliminated after
the cameras: they widen the arrow of the globals, and the band becomes as narrow as the
other landmarks allow. Runs in NumPy when a problem is made.
"""

import numpy as np
from jaxtyping import Int

from bodyslam_jax.graph.ordering import CAMERAS, CHUNK

_TABLE_CHUNK_COST = 5000.0
"""Cost of one chunk of a landmark's table, in multiplications."""
_MAX_COST_RATIO = 0.8
"""The cost must fall below this share of the cost without long tracks."""
_GROUP_COUNTS = (1, 2, 4, 8, 16)
"""Allowed numbers of groups: few, so that videos share a program."""
_MAX_LANDMARK_SHARE = 0.1
"""Largest share of all landmarks."""


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
    return order[: counts[best] if costs[best] < _MAX_COST_RATIO * costs[0] else 0]
