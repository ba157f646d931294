"""Undoes temporary exchanges of identities between two people, in keypoints or in
bodies: trackers make them where people cross or occlude each other."""

import dataclasses
import itertools
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import median_filter

from bodyslam_jax.diagnostics.agreement.image_points import (
    People,
    centred,
    distances,
    project,
)
from bodyslam_jax.types import Sequence

_MIN_EXCHANGE_GAIN = 0.1
"""Decrease of the distance, in sizes of a person, from which an exchange is
accepted."""
_MIN_EXCHANGED_FRAMES = 5
_MEDIAN_WINDOW_FRAMES = 9
"""Window of the median filter that removes outliers of single frames."""
_MIN_JUMP_RATIO = 1.5
"""Ratio of the jumps of keypoints and bodies from which the kind that jumps further is
considered the exchanged one."""


def put_back_exchanges(
    sequence: Sequence, people: People, warn: Callable[[str], None]
) -> Sequence:
    """Returns the sequence with keypoints and bodies of the same person in the same row
    in all frames.

    Where neither kind jumps clearly further, bodies are changed to follow the
    keypoints.
    """
    projected = project(people.camera, people.bodies)
    apart = distances(people.keypoints, projected)
    rows = range(min(apart.shape[1:]))
    for i, j in itertools.combinations(rows, 2):
        at = np.zeros(len(apart), bool)
        for first, last in _stretches(apart[:, [i, j]][:, :, [i, j]]):
            at[first : last + 1] = True
        if not at.any():
            continue
        jumps = [
            _jump(points[:, [i, j]], at) for points in (people.keypoints, projected)
        ]
        what = "keypoints" if jumps[0] > _MIN_JUMP_RATIO * jumps[1] else "bodies"
        sure = max(jumps) > _MIN_JUMP_RATIO * min(jumps)
        sequence = _exchanged(sequence, what, (i, j), at)
        frames = np.flatnonzero(at)
        warn(
            f"{what} of persons {i} and {j} are exchanged in {len(frames)} frames "
            f"between {frames[0]} and {frames[-1]}: put back"
            + ("." if sure else ", so as to follow the keypoints.")
        )
    return sequence


def _stretches(
    apart: Float[np.ndarray, "t 2 2"],
) -> Iterator[tuple[int, int]]:
    """Yields the first and last frames of the stretches that fit better after an
    exchange."""
    gain = apart[:, 0, 0] + apart[:, 1, 1] - apart[:, 0, 1] - apart[:, 1, 0]
    (comparable,) = np.nonzero(np.isfinite(gain))
    if len(comparable) < _MIN_EXCHANGED_FRAMES:
        return
    smooth = median_filter(gain[comparable], _MEDIAN_WINDOW_FRAMES, mode="nearest")
    decided = np.abs(smooth) > _MIN_EXCHANGE_GAIN
    if not decided.any():
        return
    # Where both fit, as people cross, the last decision is kept.
    last = np.maximum.accumulate(np.where(decided, np.arange(len(comparable)), -1))
    exchanged = smooth[np.where(last >= 0, last, decided.argmax())] > 0
    edges = np.diff(np.concatenate([[False], exchanged, [False]]).astype(int))
    starts: Int[np.ndarray, " n"] = np.flatnonzero(edges == 1)
    ends = np.flatnonzero(edges == -1) - 1
    for first, last in zip(starts.tolist(), ends.tolist(), strict=True):
        if last - first + 1 >= _MIN_EXCHANGED_FRAMES:
            begin = 0 if first == 0 else int(comparable[first])
            end = (
                len(apart) - 1 if last == len(comparable) - 1 else int(comparable[last])
            )
            yield begin, end


def _jump(points: Float[np.ndarray, "t 2 14 2"], at: Bool[np.ndarray, " t"]) -> float:
    """Returns the largest displacement of either person, in sizes, across the start or
    end of a stretch."""
    middle, radius = centred(points)
    largest = 0.0
    for frame in np.flatnonzero(np.diff(at.astype(int))):
        for person in range(2):
            visible = np.flatnonzero(np.isfinite(radius[:, person]))
            before, after = visible[visible <= frame], visible[visible > frame]
            if len(before) and len(after):
                a, b = before[-1], after[0]
                moved = np.linalg.norm(middle[b, person] - middle[a, person])
                largest = max(largest, float(moved / radius[a, person]))
    return largest


def _exchanged(sequence: Sequence, what: str, pair, at) -> Sequence:
    bundle = getattr(sequence, what)
    arrays = {k: v for k, v in vars(bundle).items() if isinstance(v, np.ndarray)}
    i, j = pair
    changed = {}
    for name, array in arrays.items():
        array = array.copy()
        array[i, at], array[j, at] = arrays[name][j, at], arrays[name][i, at]
        changed[name] = array
    return dataclasses.replace(
        sequence, **{what: dataclasses.replace(bundle, **changed)}
    )
