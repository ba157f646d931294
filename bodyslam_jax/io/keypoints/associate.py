"""Associates unordered detections in each frame to people tracked through the video.

Hungarian assignment, with costs from keypoint distances (relative to the person's size)
and box overlap, to positions predicted at constant velocity.
"""

import dataclasses

import numpy as np
from scipy.optimize import linear_sum_assignment

from bodyslam_jax.body.skeleton import BODY25_MIRRORED
from bodyslam_jax.config import Association
from bodyslam_jax.io.keypoints.doubles import doubles, is_stray
from bodyslam_jax.io.keypoints.reader import Detections
from bodyslam_jax.types import Keypoints

_MIN_SIZE_POINTS, _MIN_RELIABLE_SIZE_POINTS = 3, 8
"""Number of common keypoints from which sizes are compared, and from which they are
reliable."""
_MAX_GROWTH_FEW_POINTS, _MAX_GROWTH = 2.5, 1.7
"""Largest ratio of sizes of one person, by few and by many common keypoints."""
_MIN_CONFIDENCE = 0.05
"""Least confidence of a detected keypoint."""


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
