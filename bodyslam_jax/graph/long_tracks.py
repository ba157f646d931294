"""Which landmarks last so long that they are eliminated last; NumPy, at the door.

The longest track tells how wide the band of the camera matrix is for all. A few
landmarks that are seen much longer than all others are eliminated after the cameras in
place of before: they widen the arrow of globals, and the band is as wide as the others
need.
"""

import numpy as np
from jaxtyping import Int

from bodyslam_jax.graph.ordering import CAMERAS, CHUNK

_PLACE = 5000.0
"""Products that take as long as one place of a landmark's table."""
_GAIN = 0.8
"""They must save this much of all products."""
_GROUPS = (1, 2, 4, 8, 16)
"""How many groups there may be: few sizes, so that videos share a program."""
_SHARE = 0.1
"""Of all landmarks, at most."""


def choose_lasting(
    span: Int[np.ndarray, " l"], num_chunks: int, own: int, reach: int, size: int
) -> Int[np.ndarray, " k"]:
    """The landmarks, none or some groups of `size`, that are best eliminated last.

    Args:
        span: places from the first chunk that sees a landmark to the last, both
            counted, or how many see it, while they are not in their places yet; 0 for
            landmarks that are not seen.
        own: coordinates that people keep of a chunk.
        reach: places between a chunk and the next in time.
    """
    order = np.argsort(-span, kind="stable")
    ranked = span[order].astype(float)
    most = _SHARE * np.sum(span > 0)
    counts = [0, *(size * n for n in _GROUPS if size * n <= most)]
    pivot = own + CAMERAS

    def cost(count):
        """Products of tables, of landmarks' elimination, and of all chunks'."""
        rest = ranked[count:]
        width = int(max(rest[0] - 1, reach))
        back = np.arange(width)
        people = own * (back < reach)
        rows = CAMERAS * (width - back) + people + 3 * count
        chunk = np.sum(rows * (CAMERAS + people)) + pivot * (rows[:1].sum() + pivot)
        chunk += (3 * count) ** 2
        tables = _PLACE * CHUNK * (rest.sum() + count * num_chunks)
        return num_chunks * pivot * chunk + 1.5 * CAMERAS**2 * np.sum(rest**2) + tables

    if len(counts) == 1:
        return order[:0]
    costs = [cost(count) for count in counts]
    best = int(np.argmin(costs))
    return order[: counts[best] if costs[best] < _GAIN * costs[0] else 0]
