"""Tracks people online over frames and short gaps.

Detections are assigned to tracklets by predicted position, size and colours of clothes.
All three must agree: two tracklets of one person, which `linking` joins later, are
preferred to one tracklet of two people.
"""

import dataclasses
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from bodyslam_jax.people.appearance import difference, mean_look
from bodyslam_jax.people.movenet import box_size, sure_points

_GATE_HEIGHTS = 0.15
"""Gate on the distance from the predicted position after one frame, relative to the
person's height in the image."""
_GATE_GROWTH_HEIGHTS_PER_S = 0.8
"""Growth of the gate for each second without a detection."""
_VELOCITY_DECAY_S = 0.5
"""Time constant with which the predicted velocity decays."""
_VELOCITY_SMOOTHING_S = 0.1
"""Time constant of the velocity's moving average."""
MAX_SIZE_RATIO = 1.6
"""Ratio of sizes in the image above which a detection is of another person."""
MAX_COLOUR_DIFFERENCE = 30.0
"""Difference of colours (`appearance.difference`) from which it is another person."""
_RECENT_FRAMES = 45
"""Number of frames over which the colours of a person are averaged."""
LONG_GAP_FRAMES = 3
"""Frames without a detection after which only an unoccluded one continues a track."""
_MIN_COMMON_KEYPOINTS = 3
"""Number of common keypoints from which two detections are compared."""
_TRUNK_HEIGHT_RATIO = 0.3
"""Length of the trunk as a share of the height."""


@dataclasses.dataclass
class Tracklet:
    """Detections of one person, in order of time, with short gaps only."""

    number: int
    frames: list[int]
    points: list[Float[np.ndarray, "17 3"]]
    looks: list[Float[np.ndarray, " d"]]
    velocity: Float[np.ndarray, " 2"] = dataclasses.field(
        default_factory=lambda: np.zeros(2)
    )
    """Smoothed velocity of the keypoints in the last frame, px per frame."""

    @property
    def look(self) -> Float[np.ndarray, " d"]:
        """Mean descriptor of the clothes over the last frames."""
        return mean_look(np.stack(self.looks[-_RECENT_FRAMES:]))

    def expected(self, frame: int, fps: float) -> Float[np.ndarray, "17 3"]:
        """Returns the predicted keypoints in a later frame, with decaying velocity."""
        time = _VELOCITY_DECAY_S * fps
        steps = time * (1 - np.exp(-(frame - self.frames[-1]) / time))
        points = self.points[-1].copy()
        points[:, :2] += steps * self.velocity
        return points

    def extend(
        self, frame: int, points: np.ndarray, look: np.ndarray, fps: float
    ) -> None:
        """Appends a detection in a later frame, and updates the velocity."""
        before = self.points[-1]
        both = sure_points(points) & sure_points(before)
        if both.any():
            gap = frame - self.frames[-1]
            moved = np.median((points - before)[both, :2], axis=0) / gap
            share = 1 - np.exp(-gap / (_VELOCITY_SMOOTHING_S * fps))
            if len(self.frames) == 1:
                share = 1.0
            self.velocity = (1 - share) * self.velocity + share * moved
        self.frames.append(frame)
        self.points.append(points)
        self.looks.append(look)

    def prepend(self, frame: int, points: np.ndarray, look: np.ndarray) -> None:
        """Adds a detection in a frame before the first one."""
        self.frames.insert(0, frame)
        self.points.insert(0, points)
        self.looks.insert(0, look)


def between(tracklet: Tracklet) -> list[tuple[int, Float[np.ndarray, "17 3"]]]:
    """Returns frame and linearly interpolated keypoints for the gaps of a tracklet."""
    found = []
    ends = zip(tracklet.frames, tracklet.points, strict=True)
    for (first, a), (last, b) in pairwise(ends):
        for frame in range(first + 1, last):
            share = (frame - first) / (last - first)
            found.append((frame, a + share * (b - a)))
    return found


class Tracker:
    """Extends tracklets by each frame's detections."""

    def __init__(self, fps: float, max_gap: float) -> None:
        self.fps = fps
        self.max_gap = max_gap * fps
        self.tracklets: list[Tracklet] = []

    def alive(self, frame: int) -> list[Tracklet]:
        """Returns the tracklets that a detection in `frame` may continue."""
        return [t for t in self.tracklets if frame - t.frames[-1] <= self.max_gap]

    def update(
        self,
        frame: int,
        points: Float[np.ndarray, "n 17 3"],
        looks: Float[np.ndarray, "n d"],
        may_return: Bool[np.ndarray, " n"],
        may_start: Bool[np.ndarray, " n"],
    ) -> Int[np.ndarray, " n"]:
        """Returns the number of the tracklet that each detection continues or begins.

        Args:
            may_return: which detections may continue a track after a longer gap.
            may_start: which detections are confident enough to begin a track; the
                others get -1 if they continue none.
        """
        who = np.full(len(points), -1)
        alive = self.alive(frame)
        if alive and len(points):
            cost = np.array(
                [
                    [self.cost(t, frame, p, look) for p, look in zip(points, looks)]
                    for t in alive
                ]
            )
            away = np.array([frame - t.frames[-1] for t in alive])
            cost[(away > LONG_GAP_FRAMES)[:, None] & ~may_return] = 1e3
            rows, columns = linear_sum_assignment(np.minimum(cost, 1e3))
            for i, j in zip(rows, columns, strict=True):
                if cost[i, j] < 1:
                    alive[i].extend(frame, points[j], looks[j], self.fps)
                    who[j] = alive[i].number
        for j in np.flatnonzero((who < 0) & may_start):
            who[j] = len(self.tracklets)
            self.tracklets.append(
                Tracklet(int(who[j]), [frame], [points[j]], [looks[j]])
            )
        return who

    def cost(
        self, tracklet: Tracklet, frame: int, points: np.ndarray, look: np.ndarray
    ) -> float:
        """Returns the cost of assignment: 0 for a perfect match, 1 and more outside the
        gates."""
        away = frame - tracklet.frames[-1]
        reach = _GATE_HEIGHTS + _GATE_GROWTH_HEIGHTS_PER_S * (away - 1) / self.fps
        return _unlike(
            displacement(tracklet.expected(frame, self.fps), points) / reach,
            height(points) / height(tracklet.points[-1]),
            difference(tracklet.look, look),
        )

    def cost_before(
        self, tracklet: Tracklet, points: np.ndarray, look: np.ndarray
    ) -> float:
        """Returns the cost, as `cost`, for a detection in the frame before the
        tracklet's first."""
        first = tracklet.points[0]
        return _unlike(
            displacement(first, points) / _GATE_HEIGHTS,
            height(points) / height(first),
            difference(tracklet.look, look),
        )


def _unlike(place: float, growth: float, clothes: float) -> float:
    """Returns the weighted cost of assignment; 1000 if any of the three is outside its
    gate, else below 1.

    Args:
        place: distance in the image, relative to its gate.
        growth: ratio of the person's sizes in the image, gate `MAX_SIZE_RATIO`.
        clothes: difference of the clothes' colours, gate `MAX_COLOUR_DIFFERENCE`; NaN
            if unknown.
    """
    growth = abs(float(np.log(growth))) / np.log(MAX_SIZE_RATIO)
    clothes = 0.3 if np.isnan(clothes) else clothes / MAX_COLOUR_DIFFERENCE
    if max(place, growth, clothes) >= 1:
        return 1e3
    return 0.6 * place + 0.1 * growth + 0.3 * clothes


def displacement(a: Float[np.ndarray, "17 3"], b: Float[np.ndarray, "17 3"]) -> float:
    """Returns the median distance of two sets of keypoints, relative to the person's
    height.

    It is robust to a lost or exchanged limb, and infinite if too few keypoints are
    confident in both.
    """
    both = sure_points(a) & sure_points(b)
    if both.sum() < _MIN_COMMON_KEYPOINTS:
        return np.inf
    apart = np.median(np.linalg.norm((a - b)[both, :2], axis=1))
    return float(apart) / max(height(a), height(b))


def height(points: Float[np.ndarray, "17 3"]) -> float:
    """Returns the size of a person in the image (px), also if bent or partly hidden."""
    size = max(box_size(points), 1.0)
    if sure_points(points)[[5, 6, 11, 12]].all():
        trunk = points[[5, 6], :2].mean(0) - points[[11, 12], :2].mean(0)
        size = max(size, float(np.linalg.norm(trunk)) / _TRUNK_HEIGHT_RATIO)
    return size
