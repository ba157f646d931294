"""Tracks points from frame to frame of a running video, and recognises places.

Corners (Shi and Tomasi, 1994) spread over the image are followed by pyramidal
Lucas--Kanade there and back. ORB (Rublee et al., 2011) describes keyframes, so that a
camera that lost all points can be located again. Memory does not grow.
"""

import functools
from collections import deque
from collections.abc import Iterable

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.spatial import KDTree

from bodyslam_jax.io.camera.calibration import as_opencv, rays
from bodyslam_jax.sfm.features import epipolar_inliers, match, spread
from bodyslam_jax.sfm.places import MIN_MATCHES, Place
from bodyslam_jax.sfm.tracks import KLT_WINDOW_PX, MAX_ROUND_TRIP_PX, NUM_CELLS
from bodyslam_jax.types import Intrinsics

_MIN_TRACKED_SHARE = 0.85
"""Share of the wanted number of points below which new ones are detected."""
_BORDER_PX = 4
_RIGID_FRAMES = 10
"""Number of frames over which points must fit one rigid motion."""
_MAX_EPIPOLAR_PX = 1.5
"""Largest distance of a point from its epipolar line, px."""
_MIN_MOTION_PX = 3.0
"""Median motion over these frames, px, below which the epipolar test is not
informative."""
_NUM_FEATURES = 1000
_MAX_CORNER_DISTANCE_PX = 3.0
"""Largest distance of a tracked point from the corner that describes it, px."""
_MIN_CONTRAST = 8.0
"""Standard deviation of grey levels below which an image has no features."""


class PointFollower:
    """The points that are tracked, and the last image."""

    def __init__(self, intrinsics: Intrinsics, wanted: int) -> None:
        self.size = intrinsics.width, intrinsics.height
        self.K, self.distortion = as_opencv(intrinsics.params)
        self.wanted = wanted
        self.ids, self.uv = np.zeros(0, np.int64), np.zeros((0, 2))
        self.step = np.zeros((0, 2))
        self.previous: np.ndarray | None = None
        self.recent: deque[tuple[np.ndarray, np.ndarray]] = deque(
            maxlen=_RIGID_FRAMES + 1
        )
        self.next_id = 0

    @property
    def orb(self) -> cv2.ORB:
        """The detector of corners, which has no state."""
        return _orb()

    def advance(
        self, gray: UInt8[np.ndarray, "y x"], mask: UInt8[np.ndarray, "y x"] | None
    ) -> tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]]:
        """Tracks the points to the next image; `mask` is not 0 where people are."""
        if (
            gray.std() < _MIN_CONTRAST
        ):  # Nothing to see; what comes next is compared with it.
            self._keep(np.zeros(len(self.ids), bool))
        if self.previous is not None and len(self.ids):
            self._follow(gray, mask)
            self._drop_moving()
        if len(self.ids) < _MIN_TRACKED_SHARE * self.wanted:
            self._refill(gray, mask)
        self.previous = gray
        self.recent.append((self.ids, self.uv))
        return self.ids, self.uv

    def add(self, uv: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, " n"]:
        """Adds points of the last image to be tracked; returns their numbers."""
        ids = np.arange(self.next_id, self.next_id + len(uv))
        self.next_id += len(uv)
        self.ids = np.concatenate([self.ids, ids])
        self.uv = np.concatenate([self.uv, uv])
        self.step = np.concatenate([self.step, np.zeros_like(uv)])
        return ids

    def describe(
        self,
        points: dict[int, Float[np.ndarray, " 3"]],
        T_WC: Float[np.ndarray, "4 4"],
    ) -> Place | None:
        """Returns the last image, whose camera is `T_WC`, as a place, with its corners
        that have a known position; `None` if there are too few."""
        known = np.array([i in points for i in self.ids.tolist()], bool)
        if known.sum() < MIN_MATCHES or self.previous is None:
            return None
        marks, descriptors = self.orb.detectAndCompute(self.previous, None)
        if descriptors is None:
            return None
        # Described are ORB's own corners, turned as it sees them, at the depth of the
        # known points next to them.
        ids, uv = self.ids[known], self.uv[known]
        corners = np.array([mark.pt for mark in marks])
        found = KDTree(uv).query(corners, distance_upper_bound=_MAX_CORNER_DISTANCE_PX)
        away, near = (np.asarray(x) for x in found)
        rows = np.flatnonzero(np.isfinite(away))
        where = np.array([points[i] for i in ids[near[rows]].tolist()]).reshape(-1, 3)
        depth = (where - T_WC[:3, 3]) @ T_WC[:3, 2]
        rows, depth = rows[depth > 0], depth[depth > 0]
        if len(rows) < MIN_MATCHES:
            return None
        xy = rays(corners[rows].astype(float), self.K, self.distortion)
        p_C = np.concatenate([xy, np.ones((len(xy), 1))], axis=1) * depth[:, None]
        return Place(descriptors[rows], p_C)

    def recognise(
        self, gray: UInt8[np.ndarray, "y x"], places: Iterable[Place]
    ) -> (
        tuple[
            Place,
            Float[np.ndarray, "n 3"],
            Float[np.ndarray, "n 2"],
        ]
        | None
    ):
        """Returns the place with the most matches, their points in the frame of its
        camera, and their pixels in the image."""
        found, descriptors = self.orb.detectAndCompute(gray, None)
        if descriptors is None or len(found) < MIN_MATCHES:
            return None
        uv = np.array([p.pt for p in found])
        best = None
        for place in places:
            pairs = match(place.descriptors, descriptors)
            if len(pairs) >= MIN_MATCHES and (
                best is None or len(pairs) > len(best[1])
            ):
                best = place, place.points[pairs[:, 0]], uv[pairs[:, 1]]
        return best

    def _keep(self, kept: np.ndarray) -> None:
        self.ids, self.uv = self.ids[kept], self.uv[kept]
        self.step = self.step[kept]

    def _follow(self, gray: np.ndarray, mask: np.ndarray | None) -> None:
        assert self.previous is not None
        uv, ok = _flow(self.previous, gray, self.uv, self.uv + self.step)
        back, ok_back = _flow(gray, self.previous, uv, self.uv)
        ok &= ok_back & (np.linalg.norm(back - self.uv, axis=1) < MAX_ROUND_TRIP_PX)
        ok &= self._inside(uv, mask)
        self.step, self.uv = uv - self.uv, uv
        self._keep(ok)

    def _drop_moving(self) -> None:
        """Drops points that do not fit one rigid motion over the last frames."""
        if not self.recent:
            return
        ids, uv = self.recent[0]
        _, now, then = np.intersect1d(self.ids, ids, return_indices=True)
        moved = np.linalg.norm(self.uv[now] - uv[then], axis=1)
        if not len(now) or np.median(moved) < _MIN_MOTION_PX:
            return
        a, b = (rays(x, self.K, self.distortion) for x in (uv[then], self.uv[now]))
        inlier = epipolar_inliers(a, b, _MAX_EPIPOLAR_PX / self.K[0, 0])
        kept = np.ones(len(self.ids), bool)
        kept[now[~inlier]] = False
        self._keep(kept)

    def _inside(self, uv: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
        width, height = self.size
        low, high = _BORDER_PX, np.array([width, height]) - _BORDER_PX
        ok = np.array(np.logical_and(uv >= low, uv < high).all(axis=1))
        if mask is not None:
            at = np.clip(np.rint(uv), 0, [width - 1, height - 1]).astype(int)
            ok &= mask[at[:, 1], at[:, 0]] == 0
        return ok

    def _refill(self, gray: np.ndarray, mask: np.ndarray | None) -> None:
        free = None if mask is None else cv2.bitwise_not(mask)
        found = cv2.goodFeaturesToTrack(gray, 3 * self.wanted, 0.005, 7, mask=free)
        if found is None:
            return
        uv = found.reshape(-1, 2).astype(float)
        uv = uv[self._inside(uv, mask)]
        if not len(uv):
            return
        cell = -(-max(self.size) // NUM_CELLS)
        occupied = np.unique((uv // cell).astype(int), axis=0)
        quota = -(-self.wanted // max(len(occupied), 1))
        chosen = spread(
            uv,
            np.arange(len(uv), 0, -1, dtype=float),  # The strongest come first.
            self.uv,
            size=self.size,
            cell=cell,
            quota=quota,
            distance=0.15 * cell,
        )[: max(0, self.wanted - len(self.ids))]
        self.add(uv[chosen])


@functools.cache
def _orb() -> cv2.ORB:
    return cv2.ORB.create(_NUM_FEATURES)


def _flow(
    a: np.ndarray, b: np.ndarray, uv: np.ndarray, guess: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    found, ok, _ = cv2.calcOpticalFlowPyrLK(
        a,
        b,
        uv.astype(np.float32).reshape(-1, 1, 2),
        guess.astype(np.float32).reshape(-1, 1, 2),
        winSize=(KLT_WINDOW_PX, KLT_WINDOW_PX),
        maxLevel=3,
        criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 20, 0.01),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=1e-4,
    )
    return found.reshape(-1, 2).astype(float), ok.ravel() > 0
