"""Associates unordered detections in each frame to people tracked through the video.

Hungarian assignment, with costs from keypoint distances (relative to the person's size)
and box overlap, to positions predicted at constant velocity.

Duplicate tracks of one person, and tracks of stray points of another person, are
removed.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import linear_sum_assignment

from bodyslam_jax.body.skeleton import BODY25_MIRRORED
from bodyslam_jax.config import Association
from bodyslam_jax.io.keypoints.reader import Detections
from bodyslam_jax.types import Keypoints

_MIN_SIZE_POINTS, _MIN_RELIABLE_SIZE_POINTS = 3, 8
"""Number of common keypoints from which sizes are compared, and from which they are
reliable."""
_MAX_GROWTH_FEW_POINTS, _MAX_GROWTH = 2.5, 1.7
"""Largest ratio of sizes of one person, by few and by many common keypoints."""
_MIN_CONFIDENCE = 0.05
"""Least confidence of a detected keypoint."""
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


@dataclasses.dataclass
class _Person:
    number: int
    frame: int
    """The last frame in which the person was detected."""
    points: np.ndarray
    """(25, 3): u px, v px, confidence; hidden keypoints are moved along with the
    others."""
    velocity: np.ndarray
    """(2,): px per frame."""
    hidden: np.ndarray
    """(25,): frames since each keypoint was last detected."""

    def predict(self, frame: int) -> np.ndarray:
        """Returns keypoints (25, 3) predicted for `frame`, over at most five frames of
        motion."""
        gap = min(frame - self.frame, 5)
        last = self.points.copy()
        last[:, :2] += gap * self.velocity
        return last

    def extend(self, frame: int, points: np.ndarray, max_gap: int) -> None:
        gap = frame - self.frame
        present = points[:, 2] > _MIN_CONFIDENCE
        both = present & (self.points[:, 2] > _MIN_CONFIDENCE)
        moved = self.velocity
        if both.sum() >= _MIN_SIZE_POINTS:
            moved = np.median((points - self.points)[both, :2], axis=0) / gap
            self.velocity = 0.7 * self.velocity + 0.3 * moved
        # Hidden keypoints are kept, so that a half hidden person keeps their size.
        self.hidden = np.where(present, 0, self.hidden + gap)
        kept = (
            ~present & (self.points[:, 2] > _MIN_CONFIDENCE) & (self.hidden <= max_gap)
        )
        points = points.copy()
        points[kept] = self.points[kept]
        points[kept, :2] += gap * moved
        self.frame, self.points = frame, points


@dataclasses.dataclass(frozen=True)
class _Track:
    """All detections of one person."""

    frames: list[int]
    points: list[np.ndarray]

    def presence(self) -> float:
        """Returns the sum over frames of confidence times size; it ranks people."""
        return sum(float(p[:, 2].sum()) * _size(p) for p in self.points)


def associate(
    detections: Detections,
    config: Association,
    fps: float,
    given: list[np.ndarray] | None = None,
) -> tuple[Keypoints, tuple[str, ...]]:
    """Returns the people in the detections of `t` frames, in the order of their
    presence, and warnings.

    Two at one place at one time are one person. People detected for less than
    `config.min_duration` are dropped, unless everybody is; and so are those with the
    least presence beyond `config.max_people`.

    Args:
        fps: frame rate, 1/s.
        given: for each frame the number of the person that each detection is of, if a
            detector tracks people; they keep the order of their numbers then.
    """
    found = given
    if found is None:
        found = identify(detections, max(1, round(config.max_gap * fps)))
    least = min(max(1, round(config.min_duration * fps)), len(detections))
    people, twice = _once(_collect(detections, found), least)
    kept = [p for p in people if len(p.frames) >= least] or people
    others = [dict(zip(p.frames, p.points, strict=True)) for p in kept]
    gap = max(1, round(config.max_gap * fps))
    brief = sum(
        not is_stray(
            dict(zip(p.frames, p.points, strict=True)), others, gap, _MIN_CONFIDENCE
        )
        for p in people
        if not any(p is k for k in kept)
    )
    best = sorted(kept, key=_Track.presence, reverse=True)[: config.max_people]
    warnings = [
        f"keypoints of {n + 1} numbers are of one person, at one place at one time: "
        "taken together."
        for n in twice
    ]
    if len(kept) > len(best):
        dropped = len(kept) - len(best)
        warnings.append(f"{dropped} less visible people dropped (max_people).")
    if brief:
        who = "1 person" if brief == 1 else f"{brief} people"
        warnings.append(
            f"{who} detected for less than {config.min_duration:g} s dropped "
            "(min_duration)."
        )
    if given is None:
        warnings += _returns(best)
    else:
        best = [p for p in kept if any(p is b for b in best)]
    uvc = np.zeros((len(best), len(detections), 25, 3))
    for row, person in zip(uvc, best, strict=True):
        row[person.frames] = np.stack(person.points)
    return Keypoints(uvc[..., :2], uvc[..., 2]), tuple(warnings)


def identify(detections: Detections, max_gap: int) -> list[np.ndarray]:
    """Returns for each frame the number of the person that each of its `n` detections
    is of, (n,), from 0.

    Args:
        max_gap: frames without a detection after which a person is not recognised.
    """
    people: list[_Person] = []
    found = []
    for frame, detected in enumerate(detections):
        alive = [p for p in people if frame - p.frame <= max_gap]
        who = np.full(len(detected), -1)
        if alive and len(detected):
            cost = np.array([[_cost(p, frame, d) for d in detected] for p in alive])
            rows, columns = linear_sum_assignment(np.minimum(cost, 1e3))
            for i, j in zip(rows, columns, strict=True):
                if cost[i, j] < 1:
                    alive[i].extend(frame, detected[j], max_gap)
                    who[j] = alive[i].number
        for j in np.flatnonzero(who < 0):
            who[j] = len(people)
            hidden = np.zeros(len(detected[j]), int)
            people.append(_Person(len(people), frame, detected[j], np.zeros(2), hidden))
        found.append(who)
    return found


def _collect(detections: Detections, found: list[np.ndarray]) -> list[_Track]:
    people: dict[int, _Track] = {}
    for frame, (detected, who) in enumerate(zip(detections, found, strict=True)):
        for points, number in zip(detected, who.tolist(), strict=True):
            person = people.setdefault(number, _Track([], []))
            person.frames.append(frame)
            person.points.append(points)
    return [people[number] for number in sorted(people)]


def _once(people: list[_Track], least: int) -> tuple[list[_Track], list[int]]:
    """Returns every person once, and for each person with several tracks of `least`
    frames or more the number of additional tracks. Detections of the track with the
    higher presence are kept."""
    order = sorted(range(len(people)), key=lambda i: -people[i].presence())
    tracks = [dict(zip(p.frames, p.points, strict=True)) for p in people]
    found = {
        order[i]: order[j]
        for i, j in doubles([tracks[i] for i in order], _MIN_CONFIDENCE).items()
    }
    for double, person in found.items():
        for frame, points in tracks[double].items():
            tracks[person].setdefault(frame, points)
    kept = []
    for i, track in enumerate(tracks):
        if i not in found:
            frames = sorted(track)
            kept.append(_Track(frames, [track[k] for k in frames]))
    long = [person for i, person in found.items() if len(people[i].frames) >= least]
    counts = [long.count(person) for person in dict.fromkeys(long)]
    return kept, counts


def _returns(people: list[_Track]) -> list[str]:
    """Returns warnings about people who appear after another has left: both may be one
    person."""
    warnings = []
    for j, person in enumerate(people):
        begin = person.frames[0]
        gone = [i for i, p in enumerate(people) if p.frames[-1] < begin]
        if gone:
            i = max(gone, key=lambda i: people[i].frames[-1])
            warnings.append(
                f"person {j} may be person {i}: the one begins in frame {begin}, the "
                f"other ends in frame {people[i].frames[-1]}."
            )
    return warnings


def _cost(person: _Person, frame: int, points: np.ndarray) -> float:
    """Returns the cost of assigning a detection to a person: 0 at the predicted
    position; from 1 on it is another person."""
    expected = person.predict(frame)
    both = (points[:, 2] > _MIN_CONFIDENCE) & (expected[:, 2] > _MIN_CONFIDENCE)
    if not both.any():
        return np.inf
    size = max(_size(points), _size(expected), 1.0)
    # The median tolerates a swapped or lost limb. A detection whose left and right are
    # exchanged altogether is of the same person, too.
    other = points[list(BODY25_MIRRORED)]
    crossed = (other[:, 2] > _MIN_CONFIDENCE) & (expected[:, 2] > _MIN_CONFIDENCE)
    away = lambda p, both: np.median(np.linalg.norm((p - expected)[both, :2], axis=-1))
    distance = away(points, both)
    if crossed.any():
        distance = min(distance, away(other, crossed))
    distance = distance / size
    gap = frame - person.frame
    reach = 0.2 + 0.02 * (gap - 1)
    if not _as_large(points, expected):
        return np.inf
    return float(0.7 * distance / reach + 0.3 * (1 - _overlap(points, expected)))


def _as_large(points: np.ndarray, expected: np.ndarray) -> bool:
    """Returns True if the sizes, by common keypoints, can be those of one person."""
    both = (points[:, 2] > _MIN_CONFIDENCE) & (expected[:, 2] > _MIN_CONFIDENCE)
    if both.sum() < _MIN_SIZE_POINTS:
        return True
    most = (
        _MAX_GROWTH
        if both.sum() >= _MIN_RELIABLE_SIZE_POINTS
        else _MAX_GROWTH_FEW_POINTS
    )
    growth = _size(points[both]) / max(_size(expected[both]), 1.0)
    return 1 / most < growth < most


def _box(points: np.ndarray) -> np.ndarray:
    uv = points[points[:, 2] > _MIN_CONFIDENCE][:, :2]
    if not len(uv):
        return np.zeros((2, 2))
    return np.stack([uv.min(axis=0), uv.max(axis=0)])


def _size(points: np.ndarray) -> float:
    """Returns the longer side of the box around a person, px."""
    box = _box(points)
    return float((box[1] - box[0]).max())


def _overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Returns the intersection over union of the boxes around two people."""
    p, q = _box(a), _box(b)
    shared = np.clip(np.minimum(p[1], q[1]) - np.maximum(p[0], q[0]), 0, None).prod()
    union = (p[1] - p[0]).prod() + (q[1] - q[0]).prod() - shared
    return float(shared / union) if union > 0 else 0.0


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
    both = (a[:, 2] > least) & (b[:, 2] > least)
    if both.sum() < _MIN_POINTS:
        return np.inf
    size = max(float(np.ptp(p[p[:, 2] > least, :2], axis=0).max()) for p in (a, b))
    away = np.linalg.norm((a - b)[both, :2], axis=1)
    return float(np.median(away)) / max(size, 1.0)


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
