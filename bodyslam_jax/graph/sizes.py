"""The sizes that the solver's programs are compiled for.

A problem is padded to the first size that holds it, so that videos of any length, and
with any tracks, share a few programs. All sizes of one problem follow from its number
of chunks: frames, landmarks, observations, and the tables of landmarks.

Empty rows of tables cost time. With people that is a tenth of an iteration, and with
few landmarks it is little. Without people, and with many landmarks, it would be half of
an iteration: such a problem has sizes of its own by default (`is_dense`).
"""

from typing import NamedTuple

from bodyslam_jax.geometry.lengths import LENGTHS
from bodyslam_jax.graph.ordering import CHUNK


class Size(NamedTuple):
    """What one program can hold."""

    chunks: int
    landmarks: int
    observations: int
    widths: tuple[int, ...]
    """Chunks that narrow and wide tables span: the longest track."""
    groups: tuple[int, ...]
    """Groups of landmarks in narrow and wide tables."""


LANDMARKS = 128
"""Landmarks for each chunk of ten frames."""
OBSERVATIONS = 2304
"""Observations for each chunk: the front end tracks 200 points at any time."""
NARROW, WIDE = 3, 10
"""Chunks that a table spans. The landmarks of the joint graph span 90 frames at most
(`Structure.landmark_span`), which are in 10 chunks."""
LONGEST = 20
"""Chunks that a wide table spans where tracks are longer, as in bundle adjustment."""
_MOST = 40
"""Chunks up to which there is a size for longer tracks: their covariances take memory
in proportion to the number of chunks and the square of the bandwidth."""
_LONG, _DENSE = 200, 6.4
"""Number of frames, and landmarks for each, from which on a problem without people
saves more in three solves with sizes of its own than their compilation takes."""


def is_dense(num_frames: int, num_landmarks: int, num_people: int) -> bool:
    """Whether a problem is faster, by its compilation too, in sizes of its own."""
    many = num_landmarks > _DENSE * num_frames
    return num_people == 0 and num_frames >= _LONG and many


def _size(chunks: int, narrow: int, wide: int) -> Size:
    wide = min(wide, chunks)
    of_narrow, of_wide = 4 * chunks + 4, -(-12 * chunks // wide) + 4
    return Size(
        chunks=chunks,
        landmarks=LANDMARKS * chunks,
        observations=OBSERVATIONS * chunks,
        widths=(narrow, wide) if narrow < wide else (wide,),
        groups=(of_narrow, of_wide) if narrow < wide else (of_narrow + of_wide,),
    )


_CHUNKS = tuple(length // CHUNK for length in LENGTHS)
SIZES = tuple(
    sorted(
        {_size(n, NARROW, WIDE if n > WIDE + 2 else n) for n in _CHUNKS}
        | {_size(n, NARROW + 1, LONGEST) for n in _CHUNKS if WIDE + 2 < n <= _MOST}
    )
)
"""In the order in which they are tried."""
