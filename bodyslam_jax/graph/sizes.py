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
    """The sizes of a problem that one compiled program can hold."""

    chunks: int
    landmarks: int
    observations: int
    widths: tuple[int, ...]
    """Numbers of chunks that narrow and wide tables span: the longest track."""
    groups: tuple[int, ...]
    """Numbers of groups of landmarks in narrow and wide tables."""


CHUNK_LANDMARKS = 128
"""Number of landmarks for each chunk of ten frames."""
CHUNK_OBSERVATIONS = 2304
"""Number of observations for each chunk; the front end tracks 200 points."""
NARROW_CHUNKS, WIDE_CHUNKS = 3, 10
"""Number of chunks that a table spans. The landmarks of the joint graph span 90 frames
at most (`Structure.landmark_span`), which are in 10 chunks."""
LONG_TRACK_CHUNKS = 20
"""Number of chunks that a wide table spans for long tracks (bundle adjustment)."""
_MAX_LONG_TRACK_CHUNKS = 40
"""Largest number of chunks with a size for longer tracks: their covariances take memory
in proportion to the number of chunks and the square of the bandwidth."""
_MIN_DENSE_FRAMES, _MIN_LANDMARKS_PER_FRAME = 200, 6.4
"""Number of frames, and landmarks for each, from which on a problem without people
saves more in three solves with sizes of its own than their compilation takes."""


def is_dense(num_frames: int, num_landmarks: int, num_people: int) -> bool:
    """Returns True if sizes of its own are faster, compilation included."""
    many = num_landmarks > _MIN_LANDMARKS_PER_FRAME * num_frames
    return num_people == 0 and num_frames >= _MIN_DENSE_FRAMES and many


def _size(chunks: int, narrow: int, wide: int) -> Size:
    wide = min(wide, chunks)
    of_narrow, of_wide = 4 * chunks + 4, -(-12 * chunks // wide) + 4
    return Size(
        chunks=chunks,
        landmarks=CHUNK_LANDMARKS * chunks,
        observations=CHUNK_OBSERVATIONS * chunks,
        widths=(narrow, wide) if narrow < wide else (wide,),
        groups=(of_narrow, of_wide) if narrow < wide else (of_narrow + of_wide,),
    )


_CHUNK_COUNTS = tuple(length // CHUNK for length in LENGTHS)
SIZES = tuple(
    sorted(
        {
            _size(n, NARROW_CHUNKS, WIDE_CHUNKS if n > WIDE_CHUNKS + 2 else n)
            for n in _CHUNK_COUNTS
        }
        | {
            _size(n, NARROW_CHUNKS + 1, LONG_TRACK_CHUNKS)
            for n in _CHUNK_COUNTS
            if WIDE_CHUNKS + 2 < n <= _MAX_LONG_TRACK_CHUNKS
        }
    )
)
"""All sizes, in the order in which they are tried."""
