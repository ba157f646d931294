"""Detections in no order -> people: who is who from frame to frame.

Hungarian assignment on a mix of keypoint distance and box overlap, both relative to the
person's size, against positions predicted at constant velocity.
"""

import dataclasses

import numpy as np
from scipy.optimize import linear_sum_assignment

from bodyslam_jax.config import Association
from bodyslam_jax.frontend._keypoints import Detections
from bodyslam_jax.sequence import Keypoints

_SEEN = 0.05
"""Confidence from which a keypoint counts in comparing people."""


@dataclasses.dataclass
class _Person:
    frames: list[int]
    points: list[np.ndarray]
    velocity: np.ndarray

    def predict(self, frame: int) -> np.ndarray:
        """Keypoints (25, 3) expected in `frame`; motion fades while unseen."""
        gap = min(frame - self.frames[-1], 5)
        last = self.points[-1].copy()
        last[:, :2] += gap * self.velocity
        return last

    def extend(self, frame: int, points: np.ndarray) -> None:
        gap = frame - self.frames[-1]
        both = (points[:, 2] > _SEEN) & (self.points[-1][:, 2] > _SEEN)
        if both.any():
            moved = np.median((points - self.points[-1])[both, :2], axis=0) / gap
            self.velocity = 0.7 * self.velocity + 0.3 * moved
        self.frames.append(frame)
        self.points.append(points)


def associate(
    detections: Detections, config: Association, fps: float
) -> tuple[Keypoints, tuple[str, ...]]:
    """People found in the detections of `t` frames, the best seen first.

    Whoever is seen for less than `config.min_duration` is dropped, unless that is
    everybody, and so is who is beyond `config.max_people`.
    """
    people = _follow(detections, max(1, round(config.max_gap * fps)))
    least = min(max(1, round(config.min_duration * fps)), len(detections))
    kept = [p for p in people if len(p.frames) >= least] or people
    kept = sorted(kept, key=_presence, reverse=True)
    warnings: tuple[str, ...] = ()
    if len(kept) > config.max_people:
        dropped = len(kept) - config.max_people
        warnings = (f"{dropped} less visible people dropped (max_people).",)
        kept = kept[: config.max_people]
    uvc = np.zeros((len(kept), len(detections), 25, 3))
    for row, person in zip(uvc, kept, strict=True):
        row[person.frames] = np.stack(person.points)
    return Keypoints(uvc[..., :2], uvc[..., 2]), warnings


def _presence(person: _Person) -> float:
    """How much there is to see of a person: confidence times size, over time."""
    return sum(float(p[:, 2].sum()) * _size(p) for p in person.points)


def _follow(detections: Detections, max_gap: int) -> list[_Person]:
    people: list[_Person] = []
    for frame, found in enumerate(detections):
        alive = [p for p in people if frame - p.frames[-1] <= max_gap]
        free = set(range(len(found)))
        if alive and len(found):
            cost = np.array([[_cost(p, frame, d) for d in found] for p in alive])
            rows, columns = linear_sum_assignment(np.minimum(cost, 1e3))
            for i, j in zip(rows, columns, strict=True):
                if cost[i, j] < 1:
                    alive[i].extend(frame, found[j])
                    free.discard(j)
        for j in sorted(free):
            people.append(_Person([frame], [found[j]], np.zeros(2)))
    return people


def _cost(person: _Person, frame: int, points: np.ndarray) -> float:
    """0 for the same place, 1 where it may no longer be the same person."""
    expected = person.predict(frame)
    both = (points[:, 2] > _SEEN) & (expected[:, 2] > _SEEN)
    if not both.any():
        return np.inf
    size = max(_size(points), _size(expected), 1.0)
    # The median forgives a swapped or lost limb, which a mean would not.
    distance = np.median(np.linalg.norm((points - expected)[both, :2], axis=-1)) / size
    gap = frame - person.frames[-1]
    reach = 0.2 + 0.02 * (gap - 1)
    ratio = _size(points) / max(_size(expected), 1.0)
    if not 0.4 < ratio < 2.5:
        return np.inf
    return float(0.7 * distance / reach + 0.3 * (1 - _overlap(points, expected)))


def _box(points: np.ndarray) -> np.ndarray:
    seen = points[points[:, 2] > _SEEN][:, :2]
    if not len(seen):
        return np.zeros((2, 2))
    return np.stack([seen.min(axis=0), seen.max(axis=0)])


def _size(points: np.ndarray) -> float:
    """Longer side of the box around a person, px."""
    box = _box(points)
    return float((box[1] - box[0]).max())


def _overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of the boxes around two people."""
    p, q = _box(a), _box(b)
    shared = np.clip(np.minimum(p[1], q[1]) - np.maximum(p[0], q[0]), 0, None).prod()
    union = (p[1] - p[0]).prod() + (q[1] - q[0]).prod() - shared
    return float(shared / union) if union > 0 else 0.0
