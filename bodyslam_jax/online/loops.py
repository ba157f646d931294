"""Closes loops of the live map: keyframes that see a place again tell its drift.

The window's map is never moved. A *correction* takes it to a map without drift: a
similarity for each keyframe, interpolated between them. Estimates and the result are
corrected, and s in the window follows the drift of the unit (`Window.follow`).

A keyframe is compared with places as soon as the window has its camera, by the thread
that solves windows. Poses of successive keyframes, and of those that see one place, are
the edges of a graph of similarities (`sfm.pose_graph`). An edge that is no likely drift
is refused: two places may look alike.
"""

import dataclasses
from collections import deque

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.graph import CHUNK
from bodyslam_jax.io.camera.calibration import as_opencv
from bodyslam_jax.online.window import SCALE_WALK, Solved
from bodyslam_jax.online.window_content import FRAMES
from bodyslam_jax.sfm.places import Place, sighting
from bodyslam_jax.sfm.pose_graph import Edge, Nodes, PoseGraph
from bodyslam_jax.types import Intrinsics

_MAX_PLACES = 100
"""Largest number of keyframes whose descriptors are kept: 3 MB. Two minutes at one in
two seconds, and more where places are seen again."""
_NUM_RECENT = 30
"""Number of newest keyframes that keep their descriptors: a minute."""
_WALK = np.array([0.003] * 3 + [0.01] * 3 + [SCALE_WALK])
"""Standard deviation of the drift in a second: rotation (rad), translation over depth,
and logarithm of the unit; above what is measured in a rendered room
(`benchmarks/online.md`)."""
_MAX_SQUARED_ERROR = 24.3
"""Largest squared normalised error of a loop: a chance of 0.001 with 7 degrees of
freedom."""
_MAX_ERROR_PX = 3.0
"""Reprojection error of a point that fits a place, px at 640x480."""
_MAX_EDGES = 3
"""Largest number of earlier places that a keyframe is tied to."""
_SHARE_WAITING = 100
"""A hundredth of the keyframes, and at least one, is waited for between two solves of
the graph, so that time a frame does not grow."""


@dataclasses.dataclass(frozen=True)
class Correction:
    """Similarities from the window's map to the map without drift, by slot."""

    slots: Int[np.ndarray, " n"]
    R: Float[np.ndarray, "n 3 3"]
    t: Float[np.ndarray, "n 3"]
    scale: Float[np.ndarray, " n"]

    def at(
        self, slots: Int[np.ndarray, " m"], T_WC: Float[np.ndarray, "m 4 4"]
    ) -> tuple[Float[np.ndarray, "m 4 4"], Float[np.ndarray, " m"]]:
        """Returns corrected poses of cameras of these slots, and corrected units per
        unit of the window's map there; before the first keyframe and after the last
        one by theirs."""
        after = np.searchsorted(self.slots, slots, side="right")
        after = np.minimum(after, len(self.slots) - 1)
        before = np.maximum(after - 1, 0)
        gap = np.maximum(self.slots[after] - self.slots[before], 1)
        share = np.clip((slots - self.slots[before]) / gap, 0.0, 1.0)
        a, b = (self._moved(k, T_WC) for k in (before, after))
        found = a.copy()
        found[:, :3, 3] += share[:, None] * (b[:, :3, 3] - a[:, :3, 3])
        found[:, :3, :3] = so3.interpolate(a[:, :3, :3], b[:, :3, :3], share)
        scale = self.scale[before] ** (1 - share) * self.scale[after] ** share
        return found, scale

    @property
    def unit(self) -> float:
        """Returns the corrected units per unit of the window's map now."""
        return float(self.scale[-1])

    def of(self, solved: Solved, unit: float) -> Solved:
        """Returns a window whose s was of `unit` in the map without drift."""
        slots = solved.first + np.arange(len(solved.times))
        return dataclasses.replace(
            solved,
            T_WC=self.at(slots, solved.T_WC)[0],
            scale=solved.scale / unit,
            scale_sigma=solved.scale_sigma / unit,
        )

    def now(self, T_WC: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "4 4"]:
        """Returns the corrected pose of the newest camera."""
        return self._moved(np.array([-1]), T_WC[None])[0]

    def back(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Returns where points of the map without drift are in the window's map now."""
        return (points - self.t[-1]) @ self.R[-1] / self.scale[-1]

    def _moved(self, k: np.ndarray, T_WC: np.ndarray) -> np.ndarray:
        found = T_WC.copy()
        found[:, :3, :3] = self.R[k] @ T_WC[:, :3, :3]
        turned = (self.R[k] @ T_WC[:, :3, 3:])[..., 0]
        found[:, :3, 3] = self.scale[k, None] * turned + self.t[k]
        return found


NO_CORRECTION = Correction(
    np.zeros(1, int), np.eye(3)[None], np.zeros((1, 3)), np.ones(1)
)


@dataclasses.dataclass
class _Keyframe:
    """A keyframe in the window's map."""

    time: float
    slot: int
    since: Float[np.ndarray, "4 4"]
    """Its camera relative to that of the slot, map units."""
    T_WC: Float[np.ndarray, "4 4"]
    depth: float
    place: Place | None
    """`None` where its descriptors are not kept."""
    seen_again: bool = False
    """True if it saw a place that was known."""


class Loops:
    """The keyframes of one map, and the correction by what they saw again."""

    def __init__(self, intrinsics: Intrinsics) -> None:
        K, _ = as_opencv(intrinsics.params)
        size = np.array([intrinsics.width, intrinsics.height])
        self.threshold = _MAX_ERROR_PX * max(size.max() / 640, 1.0) / float(K[0, 0])
        self.extent = size / (2 * K[0, 0])
        self.new: deque[_Keyframe] = deque()
        """Keyframes whose camera the window has not solved; added by one thread and
        taken by another."""
        self.keyframes: list[_Keyframe] = []
        self.edges: list[Edge] = []
        """Those of loops."""
        self.refused = 0
        """Number of loops that are no likely drift."""
        self.waiting = 0
        """Keyframes that saw a place again since the last solve of the graph."""
        self.correction = NO_CORRECTION

    def add(
        self, place: Place, time: float, slot: int, since: np.ndarray, T: np.ndarray
    ) -> None:
        """Adds the keyframe of a place."""
        self.new.append(_Keyframe(time, slot, since, T, place.depth, place))

    def placed(self, place: Place, points: np.ndarray) -> np.ndarray:
        """Returns points in the frame of a place's camera in the window's map now."""
        for keyframe in [*self.keyframes, *self.new]:
            if keyframe.place is place:
                slot = np.array([keyframe.slot])
                T, scale = self.correction.at(slot, keyframe.T_WC[None])
                there = scale * points @ T[0, :3, :3].T + T[0, :3, 3]
                return self.correction.back(there)
        raise ValueError("place: not of this map.")

    @property
    def places(self) -> list[Place]:
        """Returns all places, the newest first."""
        found = [k.place for k in [*self.keyframes, *self.new]]
        return [place for place in reversed(found) if place is not None]

    def close(self, windows: list[Solved]) -> Correction | None:
        """Takes over the cameras of solved windows, and compares their new keyframes
        with earlier places; returns a new correction if they tell the drift."""
        end = windows[-1].first + len(windows[-1].times)
        first = len(self.keyframes)
        while self.new and self.new[0].slot < end:
            # In this order: `places` of another thread has it all the time.
            self.keyframes.append(self.new[0])
            self.new.popleft()
        for solved in windows:
            self._take(solved)
        found = []
        if not windows[-1].fixed:
            for j in range(first, len(self.keyframes)):
                found += self._sightings(j)
        if found:
            likely = self._graph().squared_error(found) < _MAX_SQUARED_ERROR
            self.refused += int((~likely).sum())
            good = [edge for edge, ok in zip(found, likely, strict=True) if ok]
            self.edges += good
            again = {edge.b for edge in good}
            self.waiting += len(again)
            for j in again:
                self.keyframes[j].seen_again = True
        self._forget()
        if self.waiting <= len(self.keyframes) // _SHARE_WAITING:
            return None
        self.waiting = 0
        return self._correction(self._graph().solve())

    def _take(self, solved: Solved) -> None:
        for keyframe in reversed(self.keyframes):
            k = keyframe.slot - solved.first
            if k < CHUNK:
                break
            if k < len(solved.times):
                keyframe.T_WC = solved.T_WC[k] @ keyframe.since

    def _sightings(self, j: int) -> list[Edge]:
        """Returns the relative poses of a keyframe and the oldest places that it
        sees."""
        found, now = [], self.keyframes[j]
        for i, then in enumerate(self.keyframes[:j]):
            if then.slot > now.slot - FRAMES or len(found) == _MAX_EDGES:
                break
            if then.place is None or now.place is None:
                continue
            seen = sighting(then.place, now.place, self.threshold, self.extent)
            if seen is not None:
                given = seen.T, seen.log_ratio, seen.covariance
                found.append(Edge(i, j, *given, loop=True))
        return found

    def _graph(self) -> PoseGraph:
        T = np.array([k.T_WC for k in self.keyframes])
        T, scale = self.correction.at(self._slots(), T)
        nodes = Nodes(T[:, :3, :3], T[:, :3, 3], np.log(scale))
        edges = []
        for i, (a, b) in enumerate(zip(self.keyframes, self.keyframes[1:])):
            sigma = _WALK * np.sqrt(b.time - a.time)
            sigma[3:6] *= a.depth
            T_ab = np.linalg.inv(a.T_WC) @ b.T_WC
            edges.append(Edge(i, i + 1, T_ab, 0.0, np.diag(sigma**2)))
        return PoseGraph(nodes, edges + self.edges)

    def _correction(self, nodes: Nodes) -> Correction:
        T = np.array([k.T_WC for k in self.keyframes])
        R = nodes.R @ np.swapaxes(T[:, :3, :3], 1, 2)
        scale = np.exp(nodes.log_unit)
        t = nodes.t - scale[:, None] * (R @ T[:, :3, 3:])[..., 0]
        return Correction(self._slots(), so3.nearest(R), t, scale)

    def _slots(self) -> Int[np.ndarray, " n"]:
        return np.array([k.slot for k in self.keyframes], int)

    def _forget(self) -> None:
        """Drops descriptors of more than `_MAX_PLACES` keyframes: of those that saw a
        known place, else of those with the closest neighbours in time."""
        kept = [k for k in self.keyframes if k.place is not None]
        while len(kept) > _MAX_PLACES:
            older = range(1, len(kept) - _NUM_RECENT)
            again = [i for i in older if kept[i].seen_again]
            gap = lambda i: kept[i + 1].time - kept[i - 1].time
            kept.pop(again[0] if again else min(older, key=gap)).place = None
