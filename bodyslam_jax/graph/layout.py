"""Where the observations of landmarks lie in dense blocks; NumPy, at the door.

Tracks are nearly contiguous in time. So frames are cut into chunks, landmarks are put
into groups that lie within the same few, and each group is a dense table of frames by
landmarks with holes: no list of pairs is ever made, and the reduced camera matrix is
formed by a few matrix products. Where places are seen again, chunks stand in another
order than that of time (`ordering.py`). Shapes are rounded up, so that videos of about
the same length compile once.
"""

import dataclasses
import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from bodyslam_jax.graph.factor import JOINTS, Limbs
from bodyslam_jax.graph.long_tracks import choose_lasting
from bodyslam_jax.graph.ordering import CHUNK, PERSON, order_chunks

_WIDTHS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 48, 64, 96, 128, 192, 256, 512)
_SIZE = 24
"""Landmarks in a group. Its best value is between 16 and 32, and flat; one that follows
the tracks would make videos of the same length compile anew."""
_MAX_BUCKETS = 3


class Bucket(eqx.Module):
    """`n` groups of `g` landmarks that span `width` chunks (`f` frames) each."""

    first_chunk: Int[Array, " n"]
    """The place where its chunks begin."""
    landmark: Int[Array, "n g"]
    """Row in the state; the number of landmarks for padding."""
    row: Int[Array, "n f g"]
    """Row in the measurements; the number of measurements where there is none."""
    width: int = eqx.field(static=True)
    lasting: bool = eqx.field(static=True, default=False)
    """Whether its landmarks are eliminated last, with the globals
    (`long_tracks.py`)."""


class Layout(eqx.Module):
    """How a problem of `t` frames is cut: static sizes and index tables."""

    buckets: tuple[Bucket, ...]
    num_chunks: int = eqx.field(static=True)
    """Chunks, rounded up to a size that other videos share."""
    bandwidth: int = eqx.field(static=True)
    """Places that a landmark, or a factor over frames, can connect; 2 or more."""
    order: Int[Array, " c"] | None = None
    """The chunk at each place; `None` in the order of time."""
    reach: int = eqx.field(static=True, default=1)
    """Places between a chunk and the next in time, at most."""
    limbs: Limbs = eqx.field(static=True, default=(JOINTS,))
    """Joints that factors see together, as those of one leg; narrow limbs first. Of
    joints in none, such as hands that no keypoint sees, each is a chain by itself."""

    @property
    def joints(self) -> tuple[int, ...]:
        """All joints that are in a limb, limb after limb."""
        return sum(self.limbs, ())

    @property
    def lasting(self) -> int:
        """Room for landmarks that are eliminated last."""
        return sum(b.landmark.size for b in self.buckets if b.lasting)


def round_up(count: int, parts: int = 4) -> int:
    """The next of a few sizes, each above the one before by at most one in `parts` (a
    power of 2)."""
    if count <= parts:
        return max(count, 1)
    step = max(2 ** int(np.log2(count)) // parts, 1)
    return -(-count // step) * step


def make_layout(
    num_frames: int,
    num_landmarks: int,
    frame: Int[np.ndarray, " m"],
    landmark: Int[np.ndarray, " m"],
    num_people: int = 0,
    limbs: Limbs = (JOINTS,),
) -> Layout:
    """Groups `m` observations of landmarks; every index is known to be in range."""
    count = -(-num_frames // CHUNK)
    num_chunks = round_up(count, parts=8)
    if len(frame) == 0:
        return Layout((), num_chunks, 2, limbs=limbs)
    own = num_people * PERSON
    pairs = np.unique(landmark.astype(int) * count + frame // CHUNK)
    # In no order is a landmark's span below the number of chunks that see it.
    least = np.bincount(pairs // count, minlength=num_landmarks)
    lasting = choose_lasting(least, num_chunks, own, 1, _SIZE)
    rest = pairs[~np.isin(pairs // count, lasting)]
    order, reach = order_chunks(*divmod(rest, count), count, num_people)
    if order is not None:
        # Padding is last, and nothing couples it with the rest.
        order = np.append(order, np.arange(count, num_chunks))
        # From here on a frame is where it stands.
        frame = np.argsort(order)[frame // CHUNK] * CHUNK + frame % CHUNK
    start, span = _spans(num_landmarks, frame, landmark)
    lasting = choose_lasting(span, num_chunks, own, reach, _SIZE)
    soon = span > 0
    soon[lasting] = False
    widths = _choose_widths(span[soon], num_chunks)
    rows = np.lexsort((frame, landmark))
    begin = np.searchsorted(landmark[rows], np.arange(num_landmarks + 1))
    members = np.flatnonzero(soon)
    tracks = start[members], start[members] + span[members]
    buckets = [
        _fill(chunks, [members[group] for group in groups], width, frame, rows, begin)
        for width, chunks, groups in _pack(*tracks, widths, num_chunks)
    ]
    if len(lasting):
        lasting = lasting[np.argsort(start[lasting], kind="stable")]
        groups = np.split(lasting, len(lasting) // _SIZE)
        needed = max(np.ptp(np.r_[start[k], start[k] + span[k]]) for k in groups)
        width = next(w for w in _allowed(num_chunks) if w >= needed)
        chunks = [min(start[k].min(), num_chunks - width) for k in groups]
        filled = _fill(chunks, groups, width, frame, rows, begin)
        buckets.append(dataclasses.replace(filled, lasting=True))
    if order is not None:
        order = jnp.asarray(order, jnp.int32)
        reach = min(next((w for w in _WIDTHS if reach <= w), reach), num_chunks - 1)
    bandwidth = max(widths[-1], reach + 1)
    return Layout(tuple(buckets), num_chunks, bandwidth, order, reach, limbs)


def _spans(num_landmarks, frame, landmark):
    """The chunk in which each landmark is seen first, and how many there are to the
    last; 0 of landmarks that are not seen."""
    first = np.full(num_landmarks, np.iinfo(np.int32).max)
    last = np.full(num_landmarks, -1)
    np.minimum.at(first, landmark, frame)
    np.maximum.at(last, landmark, frame)
    seen = last >= 0
    start = np.where(seen, first // CHUNK, 0)
    return start, np.where(seen, last // CHUNK - start + 1, 0)


def _allowed(num_chunks):
    """Widths that tables may have."""
    return [w for w in _WIDTHS if w < num_chunks] + [num_chunks]


def _choose_widths(span, num_chunks):
    """At most three widths, so that tables hold few empty products; one more must save
    a tenth of them, as it costs compilation and wide groups take short tracks along.
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


def _pack(start, stop, widths, num_chunks):
    """Groups of up to `_SIZE` landmarks, the longest tracks first: of each width, the
    first chunk of each group and its members.

    A group takes what begins and ends within it, shorter tracks too where there is
    room, and the number of groups is rounded up with shorter tracks: empty places cost
    as much as full ones.
    """
    order = np.lexsort((stop, start))
    start, stop = start[order], stop[order]
    first = np.searchsorted(start, np.arange(num_chunks + 1))
    free = np.ones(len(order), bool)
    buckets = []
    for lower, width in zip((*widths[-2::-1], 0), widths[::-1], strict=True):
        due = stop - start > lower
        chunks, groups = [], []
        while free.any():
            left = free & due
            if not left.any():
                if len(groups) in (0, round_up(len(groups), parts=2)):
                    break
                left = free
            chunk = min(int(start[np.argmax(left)]), num_chunks - width)
            near = slice(first[chunk], first[chunk + width])
            fits = free[near] & (stop[near] <= chunk + width)
            taken = np.concatenate(
                [np.flatnonzero(fits & due[near]), np.flatnonzero(fits & ~due[near])]
            )
            taken = near.start + taken[:_SIZE]
            free[taken] = False
            chunks.append(chunk)
            groups.append(order[taken])
        if groups:
            buckets.append((width, chunks, groups))
    return buckets


def _fill(chunks, groups, width, frame, rows, begin):
    """The tables of one bucket."""
    num_rows, num_landmarks = len(rows), len(begin) - 1
    n = round_up(len(groups))
    first_chunk = np.zeros(n, np.int32)
    first_chunk[: len(groups)] = chunks
    table = np.full((n, _SIZE), num_landmarks, np.int32)
    count = np.array([len(group) for group in groups])
    group = np.repeat(np.arange(len(groups)), count)
    slot = np.concatenate([np.arange(c) for c in count])
    members = np.concatenate(groups)
    table[group, slot] = members
    row = np.full((n, width * CHUNK, _SIZE), num_rows, np.int32)
    length = begin[members + 1] - begin[members]
    which = np.repeat(np.arange(len(members)), length)
    within = np.arange(length.sum()) - np.repeat(np.cumsum(length) - length, length)
    source = rows[begin[members][which] + within]
    at = frame[source] - first_chunk[group][which] * CHUNK
    row[group[which], at, slot[which]] = source
    return Bucket(jnp.asarray(first_chunk), jnp.asarray(table), jnp.asarray(row), width)
