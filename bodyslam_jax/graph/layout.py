"""Layout of landmark observations in dense tables.

Tracks are nearly contiguous in time. Frames are cut into chunks, landmarks are grouped
by the chunks that observe them, and each group is a dense table of frames by landmarks
with empty entries. The reduced camera matrix is then formed by a few matrix products,
without a list of pairs of observations. With loop closures chunks are eliminated in
another order than that of time (`ordering.py`). Runs in NumPy when a problem is made.

A problem is padded to the first of a few common sizes that holds it, so that videos of
any length, and with any tracks, share programs; a problem that fits in none of them
gets sizes of its own. All sizes of one problem follow from its number of chunks:
frames, landmarks, observations, and the tables of landmarks. Empty rows of tables cost
time. With people that is a tenth of an iteration, and with few landmarks it is little.
Without people, and with many landmarks, it would be half of an iteration: such a
problem has sizes of its own by default (`is_dense`).
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from bodyslam_jax.geometry.lengths import LENGTHS, put, round_up
from bodyslam_jax.graph.ordering import (
    CHUNK,
    PERSON_COORDINATES,
    choose_long_tracks,
    order_chunks,
)

_WIDTHS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 48, 64, 96, 128, 192, 256, 512)
_GROUP_LANDMARKS = 24
"""Landmarks in a group. Run time has a flat minimum between 16 and 32; a size that
depended on the tracks would compile a program for each video."""
_MAX_BUCKETS = 3
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
_CHUNK_COUNTS = tuple(length // CHUNK for length in LENGTHS)


class Size(NamedTuple):
    """The sizes of a problem that one compiled program can hold."""

    chunks: int
    landmarks: int
    observations: int
    widths: tuple[int, ...]
    """Numbers of chunks that narrow and wide tables span: the longest track."""
    groups: tuple[int, ...]
    """Numbers of groups of landmarks in narrow and wide tables."""


class Bucket(eqx.Module):
    """`n` groups of `g` landmarks that span `width` chunks (`f` frames) each."""

    first_chunk: Int[Array, " n"]
    """Position of its first chunk in the order of elimination."""
    landmark: Int[Array, "n g"]
    """Row in the state; the number of landmarks for padding."""
    row: Int[Array, "n f g"]
    """Row in the measurements; the number of measurements for an empty entry."""
    width: int = eqx.field(static=True)
    lasting: bool = eqx.field(static=True, default=False)
    """Whether its landmarks have long tracks, and are eliminated with the globals
    (`ordering.py`)."""
    used: Int[Array, ""] | None = None
    """Number of groups that hold landmarks, the first ones; `None` for all."""


class Layout(eqx.Module):
    """The blocks of a problem of `t` frames: static sizes and index tables."""

    buckets: tuple[Bucket, ...]
    num_chunks: int = eqx.field(static=True)
    """Number of chunks, rounded up."""
    bandwidth: int = eqx.field(static=True)
    """Successive chunks that a landmark or a factor can connect; 2 or more."""
    order: Int[Array, " c"] | None = None
    """The chunk at each position of the elimination order; `None` for that of time."""
    reach: int = eqx.field(static=True, default=1)
    """Largest distance, in that order, of chunks adjacent in time."""
    num_landmarks: int = eqx.field(static=True, default=1)
    """Number of landmarks, rounded up: one more at least, for empty entries."""
    num_observations: int = eqx.field(static=True, default=1)
    """Number of observations, likewise."""
    used: Int[Array, ""] | None = None
    """Number of chunks that hold frames, the first in the order of elimination; `None`
    for all."""
    used_bandwidth: Int[Array, ""] | None = None
    """The bandwidth of these tracks; `None` for `bandwidth`."""

    def all_used(self) -> "Layout":
        """Returns the layout without the counts of used rows: loops over all rows are
        differentiable in reverse mode."""
        buckets = tuple(dataclasses.replace(b, used=None) for b in self.buckets)
        return dataclasses.replace(
            self, buckets=buckets, used=None, used_bandwidth=None
        )

    @property
    def lasting(self) -> int:
        """Returns the padded number of landmarks eliminated with the globals."""
        return sum(b.landmark.size for b in self.buckets if b.lasting)


class Tracks(NamedTuple):
    """What a layout is made of: `m` observations of landmarks."""

    num_frames: int
    num_landmarks: int
    frame: Int[np.ndarray, " m"]
    landmark: Int[np.ndarray, " m"]
    front: int
    """As in `make_layout`."""


def make_layout(
    num_frames: int,
    num_landmarks: int,
    frame: Int[np.ndarray, " m"],
    landmark: Int[np.ndarray, " m"],
    num_people: int = 0,
    *,
    common_sizes: bool = True,
    front: int = 0,
) -> Layout:
    """Groups `m` observations of landmarks in tables. Indices are not checked.

    Without `common_sizes`, or if none of these holds the problem, its tables are as
    large as it needs.

    `front` is the number of chunks that a `MarginalPrior` couples, the first ones. With
    it the order is that of time, and no landmark is lasting.
    """
    if common_sizes:
        tracks = Tracks(num_frames, num_landmarks, frame, landmark, front)
        found = layouts_of_one_size([tracks])
        if found is not None:
            return found[0]
    given = num_frames, num_landmarks, frame, landmark, num_people, front
    return _of_own_size(*given)


def layouts_of_one_size(problems: Sequence[Tracks]) -> list[Layout] | None:
    """Returns the layouts of problems in tables of the least common size that holds
    each of them, so that all have equal shapes; `None` if there is none."""
    for size in SIZES:
        found = []
        for tracks in problems:
            layout = _in_size(size, tracks)
            if layout is None:
                break
            found.append(layout)
        else:
            return found
    return None


def _in_size(size: Size, tracks: Tracks) -> Layout | None:
    """Returns the layout in tables of a given size; `None` if it does not fit."""
    num_frames, num_landmarks, frame, landmark, front = tracks
    count = -(-num_frames // CHUNK)
    fits = (
        count <= size.chunks
        and num_landmarks < size.landmarks
        and len(frame) < size.observations
    )
    if not fits:
        return None
    layout = Layout(
        buckets=(),
        num_chunks=size.chunks,
        bandwidth=max(front, 2),
        num_landmarks=size.landmarks,
        num_observations=size.observations,
        used=jnp.asarray(count, jnp.int32),
        used_bandwidth=jnp.asarray(max(front, 2), jnp.int32),
    )
    if len(frame) == 0:
        return layout
    start, span = _spans(num_landmarks, frame, landmark)
    if span.max() > size.widths[-1]:
        return None
    members = np.flatnonzero(span)
    ends = start[members], start[members] + span[members]
    packed = _pack(*ends, size.widths, size.chunks, size.groups)
    if packed is None:
        return None
    rows = np.lexsort((frame, landmark))
    begin = np.searchsorted(landmark[rows], np.arange(num_landmarks + 1))
    buckets = []
    for (width, chunks, groups), most in zip(packed, size.groups[::-1], strict=True):
        groups = [members[group] for group in groups]
        filled = _fill(chunks, groups, width, frame, rows, begin, most)
        used = jnp.asarray(len(groups), jnp.int32)
        buckets.append(dataclasses.replace(filled, used=used))
    return dataclasses.replace(
        layout,
        buckets=tuple(buckets),
        bandwidth=max(size.widths[-1], front, 2),
        used_bandwidth=jnp.asarray(max(span.max(), front, 2), jnp.int32),
    )


def _of_own_size(
    num_frames: int,
    num_landmarks: int,
    frame: Int[np.ndarray, " m"],
    landmark: Int[np.ndarray, " m"],
    num_people: int,
    front: int,
) -> Layout:
    """Returns the layout in tables of the problem's own size, rounded up: for many
    frames or landmarks, or long tracks, which fit in no common size."""
    count = -(-num_frames // CHUNK)
    num_chunks = round_up(count, parts=8)
    room = round_up(num_landmarks + 1), round_up(len(frame) + 1)
    if len(frame) == 0:
        return Layout((), num_chunks, max(front, 2), None, 1, *room)
    own = num_people * PERSON_COORDINATES
    pairs = np.unique(landmark.astype(int) * count + frame // CHUNK)
    # In any order, a landmark's span is at least the number of chunks that observe it.
    least = np.bincount(pairs // count, minlength=num_landmarks)
    lasting = choose_long_tracks(least, num_chunks, own, 1, _GROUP_LANDMARKS)
    rest = pairs[~np.isin(pairs // count, lasting)]
    order, reach = None, 1
    if not front:
        order, reach = order_chunks(*divmod(rest, count), count, num_people)
    if order is not None:
        # Padding comes last, and nothing couples it with the rest.
        order = np.append(order, np.arange(count, num_chunks))
        # From here on, frames are numbered in the order of elimination.
        frame = np.argsort(order)[frame // CHUNK] * CHUNK + frame % CHUNK
    start, span = _spans(num_landmarks, frame, landmark)
    lasting = choose_long_tracks(span, num_chunks, own, reach, _GROUP_LANDMARKS)
    if front:
        lasting = lasting[:0]
    soon = span > 0
    soon[lasting] = False
    widths = _choose_widths(span[soon], num_chunks)
    rows = np.lexsort((frame, landmark))
    begin = np.searchsorted(landmark[rows], np.arange(num_landmarks + 1))
    members = np.flatnonzero(soon)
    tracks = start[members], start[members] + span[members]
    buckets = [
        _fill(chunks, [members[group] for group in groups], width, frame, rows, begin)
        for width, chunks, groups in _pack(*tracks, widths, num_chunks) or ()
    ]
    if len(lasting):
        lasting = lasting[np.argsort(start[lasting], kind="stable")]
        groups = np.split(lasting, len(lasting) // _GROUP_LANDMARKS)
        needed = max(np.ptp(np.r_[start[k], start[k] + span[k]]) for k in groups)
        width = next(w for w in _allowed(num_chunks) if w >= needed)
        chunks = [min(start[k].min(), num_chunks - width) for k in groups]
        filled = _fill(chunks, groups, width, frame, rows, begin)
        buckets.append(dataclasses.replace(filled, lasting=True))
    if order is not None:
        order = jnp.asarray(order, jnp.int32)
        reach = min(next((w for w in _WIDTHS if reach <= w), reach), num_chunks - 1)
    bandwidth = max(widths[-1], reach + 1, front)
    return Layout(tuple(buckets), num_chunks, bandwidth, order, reach, *room)


def _spans(num_landmarks, frame, landmark):
    """Returns the first chunk that observes each landmark, and the number of chunks
    from it to the last; 0 for landmarks without observations."""
    first = np.full(num_landmarks, np.iinfo(np.int32).max)
    last = np.full(num_landmarks, -1)
    np.minimum.at(first, landmark, frame)
    np.maximum.at(last, landmark, frame)
    observed = last >= 0
    start = np.where(observed, first // CHUNK, 0)
    return start, np.where(observed, last // CHUNK - start + 1, 0)


def _allowed(num_chunks):
    """Returns the widths that tables may have, in chunks."""
    return [w for w in _WIDTHS if w < num_chunks] + [num_chunks]


def _choose_widths(span, num_chunks):
    """Returns at most three widths of tables, chosen to minimise empty entries.

    Each additional width must save a tenth of the cost: it adds to compilation, and
    wide groups can hold short tracks too.
    """
    allowed = _allowed(num_chunks)
    top = next(w for w in allowed if w >= span.max())
    below = [w for w in allowed if w < top]
    best, best_cost = (top,), np.inf
    for count in range(_MAX_BUCKETS):
        for lower in itertools.combinations(below, count):
            chosen = np.array((*lower, top))
            width = chosen[np.searchsorted(chosen, span)]
            cost = np.sum(width.astype(float) ** 2 + 7 * width) * (1 + 0.1 * count)
            if cost < best_cost:
                best, best_cost = tuple(chosen.tolist()), cost
    return best


def _pack(start, stop, widths, num_chunks, most=None):
    """Packs landmarks into groups of `_GROUP_LANDMARKS`, the longest tracks first.

    Returns, for each width, the first chunk of each group and its members.

    A group holds landmarks whose tracks begin and end within it, shorter ones where
    there is room. The number of groups is rounded up, filled with shorter tracks: empty
    entries cost as much as full ones.

    With `most`, the largest number of groups of each width, every width is in the
    result, and unused groups stay empty; it is `None` where the tracks do not fit.
    """
    order = np.lexsort((stop, start))
    start, stop = start[order], stop[order]
    first = np.searchsorted(start, np.arange(num_chunks + 1))
    free = np.ones(len(order), bool)
    buckets = []
    room = (None,) * len(widths) if most is None else most[::-1]
    for lower, width, limit in zip(
        (*widths[-2::-1], 0), widths[::-1], room, strict=True
    ):
        due = stop - start > lower
        chunks, groups = [], []
        while free.any():
            left = free & due
            if not left.any():
                full = round_up(len(groups), parts=2) if limit is None else len(groups)
                if len(groups) in (0, full):
                    break
                left = free
            if len(groups) == limit:
                return None
            chunk = min(int(start[np.argmax(left)]), num_chunks - width)
            near = slice(first[chunk], first[chunk + width])
            fits = free[near] & (stop[near] <= chunk + width)
            taken = np.concatenate(
                [np.flatnonzero(fits & due[near]), np.flatnonzero(fits & ~due[near])]
            )
            taken = near.start + taken[:_GROUP_LANDMARKS]
            free[taken] = False
            chunks.append(chunk)
            groups.append(order[taken])
        if groups or limit is not None:
            buckets.append((width, chunks, groups))
    return buckets


def _fill(chunks, groups, width, frame, rows, begin, n=None):
    """Returns one bucket of `n` groups, or of as many as there are, rounded up."""
    num_rows, num_landmarks = len(rows), len(begin) - 1
    n = round_up(len(groups)) if n is None else n
    first_chunk = np.zeros(n, np.int32)
    first_chunk[: len(groups)] = chunks
    table = np.full((n, _GROUP_LANDMARKS), num_landmarks, np.int32)
    count = np.array([len(group) for group in groups], int)
    group = np.repeat(np.arange(len(groups)), count)
    none = np.zeros(0, int)
    slot = np.concatenate([none, *(np.arange(c) for c in count)])
    members = np.concatenate([none, *groups])
    table[group, slot] = members
    row = np.full((n, width * CHUNK, _GROUP_LANDMARKS), num_rows, np.int32)
    length = begin[members + 1] - begin[members]
    which = np.repeat(np.arange(len(members)), length)
    within = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length, length)
    source = rows[begin[members][which] + within]
    at = frame[source] - first_chunk[group][which] * CHUNK
    row[group[which], at, slot[which]] = source
    return Bucket(put(first_chunk), put(table), put(row), width)


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
