"""Locates the camera of a running video on a map of points that grows with the video.

Two views with enough parallax begin a map; every other camera is resected from tracked
points with a known position; points are triangulated from keyframes. A camera that does
not fit the map is lost: it is relocalised by descriptors of keyframes, or a new map
begins. The unit of a map is arbitrary. Poses and points are refined elsewhere
(`online.window`) and returned (`corrected`).
"""

import dataclasses
from collections import deque

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.triangulation import triangulate, widest_angle
from bodyslam_jax.io.camera.calibration import as_opencv, rays
from bodyslam_jax.sfm.multiview import (
    epipolar_distance,
    relative_pose,
    resect,
    translation_is_told,
    turn_with_focal,
)
from bodyslam_jax.types import Intrinsics

_MAX_ERROR_PX = 3.0
"""Reprojection error of an inlier, px at 640x480."""
MIN_INLIERS = 12
"""Least number of inliers with which a camera is located."""
_MIN_INLIER_SHARE = 0.3
"""Least share of inliers among the known points."""
_MIN_FIRST_PARALLAX_RAD = np.radians(1.5)
"""Least median parallax of two views that begin a map, rad; where the camera moves and
none begins (`LiveMap.forwards`), that of `_MIN_FIRST_POINTS` points."""
_MIN_FIRST_POINTS = 40
_MIN_FIRST_INLIER_SHARE = 0.7
"""Least share of inliers of two views that begin a map."""
_MAX_WAITING_FRAMES = 240
"""Number of frames that are kept until two views begin a map."""
_LAGS_FRAMES = (15, 30, 60)
"""Ages of further frames with which a map may begin, as few points are tracked for
longer; each is tried once more than four times as many frames wait."""
_KEYFRAME_INTERVAL, _MIN_COMMON_SHARE = 5, 0.7
"""Largest number of frames between keyframes; share of the last keyframe's points below
which there is a new one."""
_NUM_KEYFRAMES = 12
"""Number of keyframes from which points are triangulated."""
_MIN_PARALLAX_RAD = np.radians(1.0)
"""Least parallax of a new point, rad."""
_FULL_PARALLAX_SHARE, _MIN_PARALLAX_FACTOR = 0.5, 0.2
"""Share of known points from which new ones need all of that parallax, and the least
share of it that they need."""
_MAX_OUTLIER_SHARE = 0.25
"""Largest share of outliers among the views of a new point: tracks have outliers."""
_MAX_ROTATION_ERROR_PX = 2.0
"""Largest median distance from a rotation, with the focal length free, of two views
that begin no map, px: what distortion of an unknown lens adds to noise."""


@dataclasses.dataclass(frozen=True)
class Keyframe:
    """A located frame from which points are triangulated."""

    T_WC: Float[np.ndarray, "4 4"]
    ids: Int[np.ndarray, " n"]
    xy: Float[np.ndarray, "n 2"]
    """Positions on the plane at depth 1."""


class LiveMap:
    """Points by the number of their track, keyframes, and the last camera."""

    def __init__(self, intrinsics: Intrinsics, focal_sigma: float) -> None:
        """**Arguments:** `focal_sigma`: relative standard deviation of the focal
        length, with which a rotation may explain the tracks before a map begins."""
        self.focal_sigma = focal_sigma
        self.K, self.distortion = as_opencv(intrinsics.params)
        size = max(intrinsics.width, intrinsics.height) / 640
        self.threshold = _MAX_ERROR_PX * max(size, 1.0) / float(self.K[0, 0])
        self.points: dict[int, Float[np.ndarray, " 3"]] = {}
        self.keyframes: deque[Keyframe] = deque(maxlen=_NUM_KEYFRAMES)
        self.waiting: deque[Keyframe] = deque(maxlen=_MAX_WAITING_FRAMES)
        self.moving = False
        """True if the last frame showed with an earlier one that the camera moves, with
        or without the parallax that a map needs."""
        self.forwards = False
        """True if the camera is taken to move along its view, where most points have
        little parallax, however far it moves."""
        self.T_WC = np.eye(4)
        self.step = np.eye(4)
        """The last motion, from camera to camera."""
        self.since = 0
        """Frames since the last keyframe."""

    @property
    def begun(self) -> bool:
        return len(self.points) > 0

    def begin(
        self, ids: Int[np.ndarray, " n"], uv: Float[np.ndarray, "n 2"]
    ) -> list[Float[np.ndarray, "4 4"] | None] | None:
        """Adds a frame and tries to begin a map with it and an earlier one.

        **Returns:** poses of all frames that were taken in, the newest last, `None` for
        those that do not fit; `None` as long as there is no map.
        """
        now = self.wait(ids, uv)
        count = len(self.waiting)
        tried = {0, count // 2, 3 * count // 4}
        tried |= {count - lag for lag in _LAGS_FRAMES if count > 4 * lag}
        self.moving = False
        for k in sorted(tried):
            if k < count - 5 and self._two_views(self.waiting[k], now):
                break
        else:
            return None
        found = [self._locate(f.ids, f.xy, None) for f in self.waiting]
        for frame, pose in zip(self.waiting, found, strict=True):
            if pose is not None:
                self._remember(pose, frame.ids, frame.xy)
        # Points of frames in between, by all that were located.
        found = [self._locate(f.ids, f.xy, T) for f, T in zip(self.waiting, found)]
        self.T_WC = found[-1] if found[-1] is not None else self.T_WC
        self.step = np.eye(4)
        self.waiting.clear()
        return found

    def wait(
        self, ids: Int[np.ndarray, " n"], uv: Float[np.ndarray, "n 2"]
    ) -> Keyframe:
        """Adds a frame without trying to begin a map, and returns it."""
        now = Keyframe(np.eye(4), ids, self._normalised(uv))
        self.waiting.append(now)
        return now

    def locate(
        self, ids: Int[np.ndarray, " n"], uv: Float[np.ndarray, "n 2"]
    ) -> Float[np.ndarray, "4 4"] | None:
        """Returns the pose of the next frame; `None` if it does not fit the map near
        the last pose."""
        xy = self._normalised(uv)
        found = self._locate(ids, xy, self.T_WC @ self.step)
        if found is None:
            self.step = np.eye(4)
            return None
        self.step = np.linalg.inv(self.T_WC) @ found
        self.T_WC = found
        self.since += 1
        last = self.keyframes[-1].ids if self.keyframes else ids[:0]
        left = np.isin(last, ids).mean() if len(last) else 0.0
        if self.since >= _KEYFRAME_INTERVAL or left < _MIN_COMMON_SHARE:
            self._remember(found, ids, xy)
            self.since = 0
        return found

    def relocated(
        self,
        points: Float[np.ndarray, "n 3"],
        uv: Float[np.ndarray, "n 2"],
    ) -> Float[np.ndarray, "4 4"] | None:
        """Returns the pose of a frame that shows known points, without a guess; `None`
        if too few fit."""
        found = resect(points, self._normalised(uv), self.threshold)
        if found is None or found[2].sum() < max(
            MIN_INLIERS, _MIN_INLIER_SHARE * len(points)
        ):
            return None
        self.T_WC, self.step = _pose(found[0], found[1]), np.eye(4)
        return self.T_WC

    def corrected(
        self,
        move: Float[np.ndarray, "4 4"],
        points: dict[int, Float[np.ndarray, " 3"]],
    ) -> None:
        """Moves the map as a whole, and sets `points` to their refined positions in the
        moved map."""
        turn, shift = move[:3, :3], move[:3, 3]
        self.points = {i: turn @ x + shift for i, x in self.points.items()}
        self.points.update(points)
        self.T_WC = move @ self.T_WC
        moved = [dataclasses.replace(k, T_WC=move @ k.T_WC) for k in self.keyframes]
        self.keyframes = deque(moved, maxlen=_NUM_KEYFRAMES)

    def forget(self, kept: Int[np.ndarray, " n"]) -> None:
        """Removes all points but these and those of keyframes."""
        here = set(kept.tolist()).union(*(k.ids.tolist() for k in self.keyframes))
        self.points = {i: x for i, x in self.points.items() if i in here}

    def _normalised(self, uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        return rays(np.asarray(uv, float).reshape(-1, 2), self.K, self.distortion)

    def _two_views(self, a: Keyframe, b: Keyframe) -> bool:
        _, i, j = np.intersect1d(a.ids, b.ids, return_indices=True)
        if len(i) < _MIN_FIRST_POINTS:
            return False
        xy_a, xy_b = a.xy[i], b.xy[j]
        pixel = self.threshold / _MAX_ERROR_PX
        if np.median(np.linalg.norm(xy_a - xy_b, axis=1)) < 5 * pixel:
            return False
        found = relative_pose(xy_a, xy_b, pixel)
        if found is None or found[2].mean() < _MIN_FIRST_INLIER_SHARE:
            return False
        R, t, good = found
        _, turned = turn_with_focal(xy_a, xy_b, pixel, self.focal_sigma)
        if np.median(turned) < _MAX_ROTATION_ERROR_PX * pixel:
            return False
        across = epipolar_distance(R, t, xy_a, xy_b)
        if not translation_is_told(turned, across, pixel):
            return False
        self.moving = True
        R_CW = np.stack([np.eye(3), R])
        centre = np.stack([np.zeros(3), -R.T @ t])
        rows = np.flatnonzero(good)
        view = np.repeat([0, 1], len(rows))
        xy = np.concatenate([xy_a[rows], xy_b[rows]])
        which = np.tile(np.arange(len(rows)), 2)
        given = R_CW[view], centre[view]
        places = triangulate(*given, xy, which, len(rows), pixel)
        angle = widest_angle(given[1], which, places)
        front = (places @ R_CW[1].T - R_CW[1] @ centre[1])[:, 2] > 0
        front &= places[:, 2] > 0
        least = _MIN_FIRST_PARALLAX_RAD
        count = (angle[front] > least).sum() if self.forwards else front.sum()
        if count < _MIN_FIRST_POINTS:
            return False
        if not self.forwards and np.median(angle[front]) < least:
            return False
        unit = float(np.median(places[front, 2]))
        ids = a.ids[i][rows]
        sure = front & (angle > _MIN_PARALLAX_RAD / 2)
        self.points = {int(n): x / unit for n, x in zip(ids[sure], places[sure])}
        return True

    def _locate(
        self,
        ids: Int[np.ndarray, " n"],
        xy: Float[np.ndarray, "n 2"],
        guess: Float[np.ndarray, "4 4"] | None,
    ) -> Float[np.ndarray, "4 4"] | None:
        known = np.array([i in self.points for i in ids.tolist()], bool)
        if known.sum() < MIN_INLIERS:
            return None
        points = np.array([self.points[i] for i in ids[known].tolist()])
        start = None if guess is None else (guess[:3, :3].T, guess[:3, 3])
        found = resect(points, xy[known], self.threshold, start)
        if found is None or found[2].sum() < max(
            MIN_INLIERS, _MIN_INLIER_SHARE * known.sum()
        ):
            return None
        for i in ids[known][~found[2]].tolist():
            # A point that moved, or was triangulated from a wrong match.
            self.points.pop(i, None)
        return _pose(found[0], found[1])

    def _remember(
        self,
        pose: Float[np.ndarray, "4 4"],
        ids: Int[np.ndarray, " n"],
        xy: Float[np.ndarray, "n 2"],
    ) -> None:
        """Adds a keyframe, and triangulates new points from it and earlier ones."""
        self.keyframes.append(Keyframe(pose, ids, xy))
        new = ids[[i not in self.points for i in ids.tolist()]]
        if not len(new):
            return
        views = [
            (k.T_WC, *(a[np.isin(k.ids, new)] for a in (k.ids, k.xy)))
            for k in self.keyframes
        ]
        number = np.concatenate([v[1] for v in views])
        seen = np.concatenate([v[2] for v in views])
        T_WC = np.concatenate([np.repeat(v[0][None], len(v[1]), 0) for v in views])
        track, row, count = np.unique(number, return_inverse=True, return_counts=True)
        R_CW, centre = np.swapaxes(T_WC[:, :3, :3], 1, 2), T_WC[:, :3, 3]
        scale = self.threshold / _MAX_ERROR_PX
        places = triangulate(R_CW, centre, seen, row, len(track), scale)
        p_C = np.einsum("mij,mj->mi", R_CW, places[row] - centre)
        front = p_C[:, 2] > 1e-6
        depth = np.where(front, p_C[:, 2], 1.0)
        away = np.linalg.norm(p_C[:, :2] / depth[:, None] - seen, axis=1)
        fits = front & (away < self.threshold)
        off = np.bincount(row, ~fits, len(track)) / count
        # Where the camera mostly turns, points of little parallax are better than none.
        share = (len(ids) - len(new)) / (_FULL_PARALLAX_SHARE * len(ids))
        angle = _MIN_PARALLAX_RAD * np.clip(share, _MIN_PARALLAX_FACTOR, 1.0)
        good = (count >= 2) & (off < _MAX_OUTLIER_SHARE)
        good &= widest_angle(centre, row, places) > angle
        for i, x in zip(track[good].tolist(), places[good]):
            self.points[i] = x


def _pose(
    R_CW: Float[np.ndarray, "3 3"], centre: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "4 4"]:
    T = np.eye(4)
    # Each guess is made of the last two poses: what rounding adds would be extrapolated
    # too, and grow.
    T[:3, :3], T[:3, 3] = so3.nearest(R_CW.T), centre
    return T
