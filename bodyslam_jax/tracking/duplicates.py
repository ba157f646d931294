"""Finds tracks that are of a person who has another track at the same time."""

from collections.abc import Mapping, Sequence

import numpy as np

from bodyslam_jax.tracking.tracker import displacement

Track = Mapping[int, np.ndarray]
"""Keypoints (k, 3) of a person by frame: u px, v px, confidence."""
_MAX_DISTANCE = 0.15
"""Largest median distance of two sets of keypoints of one person, relative to the
person's size: of people side by side it is a third, as wide as they are."""
_MIN_CLOSE_SHARE = 0.8
"""Least share of the common frames of two tracks of one person in which their distance
is below that."""
_MIN_COMMON_FRAMES, _MIN_COMMON_SHARE = 3, 0.15
"""Least number of common frames of tracks that are compared, and least share of the
shorter track."""
_MIN_POINTS = 5
_MIN_INSIDE_SHARE = 0.5
"""Share of stray points that are in the box of the person to whom they belong."""
_BOX_MARGIN = 0.15
"""Margin of that box on all sides, relative to its longer side."""


def doubles(people: Sequence[Track], least: float) -> dict[int, int]:
    """Returns, for those of `people` who are at the position of an earlier one in the
    list at the same time, the index of that one.

    Args:
        least: confidence from which a keypoint counts.
    """
    found: dict[int, int] = {}
    for i, one in enumerate(people):
        for j in range(i):
            if j not in found and _one_place(one, people[j], least):
                found[i] = j
                break
    return found


def is_stray(track: Track, people: Sequence[Track], gap: int, least: float) -> bool:
    """Returns True if most of a track lies in the box of another one of `people`, at
    most `gap` frames before or after."""
    within = [
        any(_inside(points, person, frame, gap, least) for person in people)
        for frame, points in track.items()
    ]
    return bool(np.mean(within) > _MIN_INSIDE_SHARE)


def _one_place(a: Track, b: Track, least: float) -> bool:
    shared = sorted(a.keys() & b.keys())
    fewest = max(_MIN_COMMON_FRAMES, _MIN_COMMON_SHARE * min(len(a), len(b)))
    if len(shared) < fewest:
        return False
    near = [_apart(a[k], b[k], least) < _MAX_DISTANCE for k in shared]
    return bool(np.mean(near) >= _MIN_CLOSE_SHARE)


def _apart(a: np.ndarray, b: np.ndarray, least: float) -> float:
    if ((a[:, 2] > least) & (b[:, 2] > least)).sum() < _MIN_POINTS:
        return np.inf
    return float(displacement(a[None], b[None], least)[0, 0])


def _inside(
    points: np.ndarray, person: Track, frame: int, gap: int, least: float
) -> bool:
    """Returns True if most of the points are in a person's box in the nearest frame."""
    nearest = min(person, key=lambda k: abs(k - frame))
    if abs(nearest - frame) > gap:
        return False
    low, high = _widened_box(person[nearest], least)
    if not np.isfinite(low).all():
        return False
    room = _BOX_MARGIN * float((high - low).max())
    uv = points[points[:, 2] > least, :2]
    inside = ((uv >= low - room) & (uv <= high + room)).all(axis=1)
    return bool(len(uv)) and bool(inside.mean() > _MIN_INSIDE_SHARE)


def _widened_box(points: np.ndarray, least: float) -> tuple[np.ndarray, np.ndarray]:
    uv = points[points[:, 2] > least, :2]
    if not len(uv):
        return np.full(2, np.inf), np.full(2, -np.inf)
    return uv.min(axis=0), uv.max(axis=0)
