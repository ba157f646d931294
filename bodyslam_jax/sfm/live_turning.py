"""Locates the camera of a running video that stands still or only turns.

Such a camera has no parallax, so that points are directions. Each direction is the mean
of its first rays, and each rotation a robust fit to the directions that are seen
(`multiview.fit_rotation`). The camera stands still, with the same pose in every frame,
until points have moved by more than the noise of their tracks.
"""

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.geometry.triangulation import unit_rays
from bodyslam_jax.io.camera.calibration import as_opencv, rays
from bodyslam_jax.sfm.live_map import MIN_INLIERS
from bodyslam_jax.sfm.multiview import fit_rotation
from bodyslam_jax.sfm.sfm import MAX_STATIC_MOTION_PX
from bodyslam_jax.types import Intrinsics

_MIN_INLIER_SHARE = 0.5
"""Least share of inliers among the known points."""
_MAX_ERROR_RAD = np.radians(1.5)
"""Angular error of an inlier, rad: the parallax from which two views begin a map, so
that a camera that begins to move is located until then, and no further."""
_NUM_AVERAGED_RAYS = 10
"""Number of rays, the first ones, whose mean is a direction: parallax would move it.
"""


class TurningCamera:
    """The directions of points by the number of their track, and the last rotation."""

    def __init__(self, intrinsics: Intrinsics, *, still: bool = False) -> None:
        """**Arguments:** `still`: whether the camera is known to stand still; it is
        then located without points."""
        self.K, self.distortion = as_opencv(intrinsics.params)
        self.pixel = 1 / float(np.sqrt(self.K[0, 0] * self.K[1, 1]))
        self.still = still
        self.turns = False
        """True once the camera has turned."""
        self.points: dict[int, Float[np.ndarray, " 3"]] = {}
        """Unit vectors in the frame of the first camera."""
        self.seen: dict[int, int] = {}
        """Number of rays in the mean of each, up to `_NUM_AVERAGED_RAYS`."""
        self.T_WC = np.eye(4)

    @property
    def kind(self) -> str:
        """Returns the kind of camera motion as in `SfmResult`."""
        return "rotation" if self.turns else "static"

    def locate(
        self, ids: Int[np.ndarray, " n"], uv: Float[np.ndarray, "n 2"]
    ) -> Float[np.ndarray, "4 4"] | None:
        """Returns the pose of the next frame; `None` if its points do not fit a
        rotation. That of the first frame with enough points is the identity."""
        if self.still:
            return self.T_WC
        ray = self._rays(uv)
        if self.points or len(ids) < MIN_INLIERS:
            known = np.array([i in self.points for i in ids.tolist()], bool)
            points = [self.points[i] for i in ids[known].tolist()]
            if not self._take(np.array(points).reshape(-1, 3), ray[known]):
                return None
        self._learn(ids, ray)
        return self.T_WC

    def relocated(
        self, points: Float[np.ndarray, "n 3"], uv: Float[np.ndarray, "n 2"]
    ) -> Float[np.ndarray, "4 4"] | None:
        """Returns the pose of a frame that shows known directions, without a guess;
        `None` if too few fit."""
        return self.T_WC if self._take(points, self._rays(uv)) else None

    def _rays(self, uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        uv = np.asarray(uv, float).reshape(-1, 2)
        return unit_rays(rays(uv, self.K, self.distortion))

    def _take(
        self, points: Float[np.ndarray, "n 3"], ray: Float[np.ndarray, "n 3"]
    ) -> bool:
        """Fits the camera's rotation to directions and their rays, and returns false if
        too few fit. Rotations within the noise of tracks are not applied."""
        if len(points) < MIN_INLIERS:
            return False
        R_CW, away = fit_rotation(points, ray, self.pixel)
        if (away < _MAX_ERROR_RAD).sum() < max(
            MIN_INLIERS, _MIN_INLIER_SHARE * len(points)
        ):
            return False
        moved = np.linalg.norm(points @ (R_CW.T - self.T_WC[:3, :3]), axis=1)
        self.turns |= bool(np.median(moved) > MAX_STATIC_MOTION_PX * self.pixel)
        if self.turns:
            self.T_WC = np.eye(4)
            self.T_WC[:3, :3] = R_CW.T
        return True

    def _learn(self, ids: Int[np.ndarray, " n"], ray: Float[np.ndarray, "n 3"]) -> None:
        """Adds the frame's rays to the means, and removes tracks that have ended."""
        towards = ray @ self.T_WC[:3, :3].T
        points, seen = {}, {}
        for i, one in zip(ids.tolist(), towards, strict=True):
            count = self.seen.get(i, 0)
            mean = self.points[i] if count else one
            if count < _NUM_AVERAGED_RAYS:
                total = count * mean + one
                mean = total / np.linalg.norm(total)
            points[i], seen[i] = mean, min(count + 1, _NUM_AVERAGED_RAYS)
        self.points, self.seen = points, seen
