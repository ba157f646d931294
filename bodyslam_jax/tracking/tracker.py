"""Assigns the detections of each frame to people, over frames and short gaps.

This is the one association of the package: of people whom its networks find, in a video
or live, and of keypoints and bodies in files without numbers. A detection continues a
tracklet if position, size and, where images show them, colours of clothes agree. Of all
assignments the one with the least total cost is chosen, in which a tracklet or a
detection may stay alone. Tracklets of one person are joined later by clothes
(`people.linking`), so that two tracklets of one person do less harm than one of two.
"""

import dataclasses
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from bodyslam_jax.tracking.appearance import difference, mean_look

_GATE_HEIGHTS, _GATE_GROWTH_HEIGHTS_PER_S = 0.18, 0.6
"""Gate on the distance from the predicted position, relative to the person's size in
the image, and its growth with the time since the last detection (`benchmarks/video.md`,
which also has the figures of other gates)."""
_VELOCITY_DECAY_S = 0.5
"""Time constant with which the predicted velocity decays."""
_VELOCITY_SMOOTHING_S = 0.1
"""Time constant of the velocity's moving average."""
MAX_SIZE_RATIO, _MAX_SIZE_RATIO_FEW = 1.7, 2.5
"""Ratio of sizes above which a detection is of another person, by many and by few
common keypoints, of which a bent limb is a large part."""
_MANY_KEYPOINTS, _FEW_KEYPOINTS = 8, 3
"""Number of common keypoints from which a size is accurate, and from which sizes and
motions are compared."""
MAX_COLOUR_DIFFERENCE = 30.0
"""Difference of colours (`appearance.difference`) from which it is another person."""
_RECENT_FRAMES = 45
"""Number of frames over which the colours of a person are averaged."""
LONG_GAP_FRAMES = 3
"""Frames without a detection after which only an unoccluded one continues a track."""
_PLACE_WEIGHT, _SIZE_WEIGHT, _LOOK_WEIGHT = 0.6, 0.1, 0.3
"""Weights of the three parts of a cost, each relative to its gate."""


@dataclasses.dataclass(frozen=True)
class PointSet:
    """Properties of a detector's keypoints."""

    min_confidence: float
    """Confidence up to which the position of a keypoint is a guess, and is not used."""
    mirrored: tuple[int, ...] | None = None
    """For each keypoint the one on the other side of the body, for which a detector may
    take it; `None` if there are no sides."""
    remembered: bool = True
    """Whether a hidden keypoint is moved along with the others, so that a half hidden
    person keeps their size. Of MoveNet, which guesses all keypoints, tracks of people
    who overlap are exchanged by it (`benchmarks/video.md`)."""


@dataclasses.dataclass
class Tracklet:
    """Detections of one person, in order of time, with short gaps only."""

    number: int
    frames: list[int]
    points: list[Float[np.ndarray, "k 3"]]
    """Keypoints: u px, v px, confidence."""
    looks: list[Float[np.ndarray, " d"]]
    """Descriptors of clothes (`appearance.describe`); NaN where they are unknown, of
    size 0 without images."""
    kind: PointSet
    fps: float
    """Frame rate, 1/s."""
    max_gap: float
    """Number of frames over which a hidden keypoint moves along with the others."""

    def __post_init__(self) -> None:
        self.velocity = np.zeros(2)
        """Smoothed velocity of the keypoints in the last frame, px per frame."""
        self.whole = self.points[0]
        """Keypoints in the last frame, with hidden ones that are remembered."""
        self.hidden = np.zeros(len(self.whole))
        """Frames since each keypoint was last detected."""

    @property
    def look(self) -> Float[np.ndarray, " d"]:
        """Mean descriptor of the clothes over the last frames."""
        return mean_look(np.stack(self.looks[-_RECENT_FRAMES:]))

    def expected(self, frame: int) -> Float[np.ndarray, "k 3"]:
        """Returns the predicted keypoints in a later frame, with decaying velocity."""
        points = self.whole.copy()
        points[:, :2] += self._motion(frame)
        return points

    def _motion(self, frame: int) -> Float[np.ndarray, " 2"]:
        time = _VELOCITY_DECAY_S * self.fps
        return self.velocity * time * (1 - np.exp((self.frames[-1] - frame) / time))

    def extend(self, frame: int, points: np.ndarray, look: np.ndarray) -> None:
        """Appends a detection in a later frame, and updates the velocity."""
        gap = frame - self.frames[-1]
        sure = points[:, 2] > self.kind.min_confidence
        known = self.whole[:, 2] > self.kind.min_confidence
        moved = self._motion(frame)
        if (sure & known).sum() >= _FEW_KEYPOINTS:
            moved = np.median((points - self.whole)[sure & known, :2], axis=0)
            share = 1 - np.exp(-gap / (_VELOCITY_SMOOTHING_S * self.fps))
            if len(self.frames) == 1:
                share = 1.0  # There is no velocity to smooth with yet.
            self.velocity = (1 - share) * self.velocity + share * moved / gap
        self.hidden = np.where(sure, 0, self.hidden + gap)
        kept = ~sure & known & (self.hidden <= self.max_gap) & self.kind.remembered
        before, self.whole = self.whole, points.copy()
        self.whole[kept] = before[kept]
        self.whole[kept, :2] += moved
        self.frames.append(frame)
        self.points.append(points)
        self.looks.append(look)

    def prepend(self, frame: int, points: np.ndarray, look: np.ndarray) -> None:
        """Adds a detection in a frame before the first one."""
        self.frames.insert(0, frame)
        self.points.insert(0, points)
        self.looks.insert(0, look)


def between(tracklet: Tracklet) -> list[tuple[int, Float[np.ndarray, "k 3"]]]:
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

    def __init__(self, fps: float, max_gap: float, kind: PointSet) -> None:
        """Begins without people.

        Args:
            fps: frame rate, 1/s.
            max_gap: time without a detection after which a tracklet ends, s; at least a
                frame.
            kind: the detector's keypoints.
        """
        self.fps, self.kind = fps, kind
        self.max_gap = max(1.0, max_gap * fps)
        self.tracklets: list[Tracklet] = []

    def alive(self, frame: int) -> list[Tracklet]:
        """Returns the tracklets that a detection in `frame` may continue."""
        return [t for t in self.tracklets if frame - t.frames[-1] <= self.max_gap]

    def update(
        self,
        frame: int,
        points: Float[np.ndarray, "n k 3"],
        looks: Float[np.ndarray, "n d"] | None = None,
        may_return: Bool[np.ndarray, " n"] | None = None,
        may_start: Bool[np.ndarray, " n"] | None = None,
    ) -> Int[np.ndarray, " n"]:
        """Returns the number of the tracklet that each detection continues or begins.

        Args:
            looks: descriptors of clothes, if there are images.
            may_return: which detections may continue a track after a longer gap; all by
                default.
            may_start: which detections are confident enough to begin a track, all by
                default; the others get -1 if they continue none.
        """
        every, who = np.ones(len(points), bool), np.full(len(points), -1)
        looks = np.zeros((len(points), 0)) if looks is None else looks
        alive = self.alive(frame)
        if alive and len(points):
            gaps = np.array([frame - t.frames[-1] for t in alive])
            expected = np.stack([t.expected(frame) for t in alive])
            clothes = np.stack([t.look for t in alive])
            cost = self._cost(expected, clothes, gaps, points, looks)
            far = (gaps > LONG_GAP_FRAMES)[:, None]
            cost[far & ~(every if may_return is None else may_return)] = 1.0
            for i, j in zip(*linear_sum_assignment(cost), strict=True):
                if cost[i, j] < 1:
                    alive[i].extend(frame, points[j], looks[j])
                    who[j] = alive[i].number
        for j in np.flatnonzero(
            (who < 0) & (every if may_start is None else may_start)
        ):
            who[j] = len(self.tracklets)
            first = [frame], [points[j]], [looks[j]]
            kind = self.kind, self.fps, self.max_gap
            self.tracklets.append(Tracklet(int(who[j]), *first, *kind))
        return who

    def cost_before(
        self,
        tracklet: Tracklet,
        points: Float[np.ndarray, "n k 3"],
        looks: Float[np.ndarray, "n d"],
    ) -> Float[np.ndarray, " n"]:
        """Returns the cost of detections in the frame before the tracklet's first: 0
        for a perfect match, 1 outside the gates."""
        first, look = tracklet.points[0][None], tracklet.look[None]
        return self._cost(first, look, np.ones(1), points, looks)[0]

    def _cost(
        self,
        expected: Float[np.ndarray, "a k 3"],
        expected_looks: Float[np.ndarray, "a d"],
        gaps: Float[np.ndarray, " a"] | Int[np.ndarray, " a"],
        points: Float[np.ndarray, "n k 3"],
        looks: Float[np.ndarray, "n d"],
    ) -> Float[np.ndarray, "a n"]:
        """Returns the cost of assigning each detection to each tracklet, which is that
        of leaving both alone, 1, outside a gate.

        It is the weighted sum of distance, change of size, and difference of colours;
        where colours are unknown, of what boxes do not share.

        Args:
            gaps: frames since the last detection of each tracklet.
        """
        least, mirrored = self.kind.min_confidence, self.kind.mirrored
        place = displacement(expected, points, least)
        if mirrored is not None:
            exchanged = displacement(expected, points[:, list(mirrored)], least)
            place = np.minimum(place, exchanged)
        gate = _GATE_HEIGHTS + _GATE_GROWTH_HEIGHTS_PER_S * gaps / self.fps
        place = place / gate[:, None]
        growth = _growth(expected, points, least)
        look = 1 - _overlap(expected, points, least)
        inside = (place < 1) & (growth < 1)
        if looks.shape[1]:
            for i, j in np.argwhere(inside):
                apart = difference(expected_looks[i], looks[j]) / MAX_COLOUR_DIFFERENCE
                look[i, j] = look[i, j] if np.isnan(apart) else apart
                inside[i, j] = not apart >= 1
        place = np.where(inside, place, 1.0)
        cost = _PLACE_WEIGHT * place + _SIZE_WEIGHT * growth + _LOOK_WEIGHT * look
        return np.where(inside, cost, 1.0)


def identify(
    detections: list[np.ndarray], fps: float, max_gap: float, kind: PointSet
) -> list[np.ndarray]:
    """Returns for each frame the number of the person that each of its `n` detections
    is of, (n,), from 0.

    Args:
        detections: for each frame keypoints (n, k, 3): u px, v px, confidence.
        fps, max_gap, kind: those of a `Tracker`.
    """
    tracker = Tracker(fps, max_gap, kind)
    return [tracker.update(k, points) for k, points in enumerate(detections)]


def displacement(
    a: Float[np.ndarray, "a k 3"], b: Float[np.ndarray, "n k 3"], least: float
) -> Float[np.ndarray, "a n"]:
    """Returns the median distance of each of `a` from each of `b`, relative to the size
    of the larger person.

    It is robust to a lost or exchanged limb, and infinite without a common keypoint.

    Args:
        least: confidence from which a keypoint is used.
    """
    both = _common(a, b, least)
    apart = np.linalg.norm(a[:, None, :, :2] - b[None, :, :, :2], axis=-1)
    apart = np.sort(np.where(both, apart, np.inf), axis=-1)
    count = np.maximum(both.sum(axis=-1, keepdims=True), 1)
    middle = np.concatenate([(count - 1) // 2, count // 2], axis=-1)
    middle = np.minimum(middle, apart.shape[-1] - 1)
    median = np.take_along_axis(apart, middle, axis=-1).mean(axis=-1)
    one, other = (_extent(*_box(p, p[..., 2] > least)) for p in (a, b))
    return median / np.maximum(np.maximum(one[:, None], other), 1.0)


def _growth(a: np.ndarray, b: np.ndarray, least: float) -> Float[np.ndarray, "a n"]:
    """Returns the change of size by common keypoints, relative to its gate; 0 if there
    are too few."""
    both = _common(a, b, least)
    before, after = (_extent(*_box(p, both)) for p in (a[:, None], b[None]))
    ratio = np.abs(np.log(np.maximum(after, 1.0) / np.maximum(before, 1.0)))
    count = both.sum(axis=-1)
    most = np.where(count >= _MANY_KEYPOINTS, MAX_SIZE_RATIO, _MAX_SIZE_RATIO_FEW)
    return np.where(count >= _FEW_KEYPOINTS, ratio / np.log(most), 0.0)


def _overlap(a: np.ndarray, b: np.ndarray, least: float) -> Float[np.ndarray, "a n"]:
    """Returns the intersection over union of the boxes around two people."""
    (low, high), (lower, higher) = (_box(p, p[..., 2] > least) for p in (a, b))
    area = lambda low, high: np.maximum(high - low, 0.0).prod(axis=-1)
    shared = area(np.maximum(low[:, None], lower), np.minimum(high[:, None], higher))
    union = area(low, high)[:, None] + area(lower, higher) - shared
    return shared / np.where(union > 0, union, 1.0)


def _common(a: np.ndarray, b: np.ndarray, least: float) -> Bool[np.ndarray, "a n k"]:
    return (a[:, None, :, 2] > least) & (b[None, :, :, 2] > least)


def _box(points: np.ndarray, chosen: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the lowest and highest u and v of the chosen keypoints, px; inf and -inf
    if there are none."""
    uv, chosen = points[..., :2], chosen[..., None]
    low = np.where(chosen, uv, np.inf).min(axis=-2)
    return low, np.where(chosen, uv, -np.inf).max(axis=-2)


def _extent(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Returns the longer side of a box, px."""
    return np.maximum(high - low, 0.0).max(axis=-1)
