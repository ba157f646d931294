"""Tracks that are of one person: followed twice, or stray points of somebody there."""

from collections.abc import Mapping, Sequence

import numpy as np

Track = Mapping[int, np.ndarray]
"""Keypoints (k, 3) of a person by frame: u px, v px, confidence."""

_TWICE = 0.15
"""Distance of two sets of keypoints (median), of the person's size, below which they
are of one person: of people side by side it is a third, as wide as they are."""
_MOST = 0.8
"""Share of the frames that two tracks have in common in which that must be so."""
_FEWEST_FRAMES, _SHARED = 3, 0.15
"""Frames, and their share of the shorter track, from which tracks are compared."""
_FEWEST_POINTS = 5
_INSIDE = 0.5
"""Share of stray points that are in the box of the person whose they are."""
_ROOM = 0.15
"""What is added to that box on all sides, of its larger side."""


def doubles(people: Sequence[Track], least: float) -> dict[int, int]:
    """Those of `people` who are at one place at one time with an earlier one of the
    list, and who that is.

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
    """Whether most of a track lies where somebody else of `people` is, `gap` frames
    before or after at most."""
    within = [
        any(_inside(points, person, frame, gap, least) for person in people)
        for frame, points in track.items()
    ]
    return bool(np.mean(within) > _INSIDE)


def _one_place(a: Track, b: Track, least: float) -> bool:
    shared = sorted(a.keys() & b.keys())
    fewest = max(_FEWEST_FRAMES, _SHARED * min(len(a), len(b)))
    if len(shared) < fewest:
        return False
    near = [_apart(a[k], b[k], least) < _TWICE for k in shared]
    return bool(np.mean(near) >= _MOST)


def _apart(a: np.ndarray, b: np.ndarray, least: float) -> float:
    both = (a[:, 2] > least) & (b[:, 2] > least)
    if both.sum() < _FEWEST_POINTS:
        return np.inf
    size = max(float(np.ptp(p[p[:, 2] > least, :2], axis=0).max()) for p in (a, b))
    away = np.linalg.norm((a - b)[both, :2], axis=1)
    return float(np.median(away)) / max(size, 1.0)


def _inside(
    points: np.ndarray, person: Track, frame: int, gap: int, least: float
) -> bool:
    """Whether most of the points are in a person's box in the nearest frame."""
    nearest = min(person, key=lambda k: abs(k - frame))
    if abs(nearest - frame) > gap:
        return False
    low, high = _box(person[nearest], least)
    if not np.isfinite(low).all():
        return False
    room = _ROOM * float((high - low).max())
    uv = points[points[:, 2] > least, :2]
    inside = ((uv >= low - room) & (uv <= high + room)).all(axis=1)
    return bool(len(uv)) and bool(inside.mean() > _INSIDE)


def _box(points: np.ndarray, least: float) -> tuple[np.ndarray, np.ndarray]:
    uv = points[points[:, 2] > least, :2]
    if not len(uv):
        return np.full(2, np.inf), np.full(2, -np.inf)
    return uv.min(axis=0), uv.max(axis=0)
