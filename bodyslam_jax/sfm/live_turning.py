"""Frame after frame: the rotation of a camera that stands still or only turns.

Such a camera has no parallax, so that points are directions. Each direction is the mean
of the first rays that showed it, and each rotation the robust best for the directions
that are seen (`multiview.fit_rotation`). Until points have moved by more than the noise
of their tracks the camera stands still: its pose is then the same in every frame.
"""

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.geometry.triangulation import unit_rays
from bodyslam_jax.io.camera.calibration import as_opencv, rays
from bodyslam_jax.sfm.multiview import fit_rotation
from bodyslam_jax.sfm.sfm import MAX_STATIC_MOTION_PX
from bodyslam_jax.types import Intrinsics

_LEAST = 12
"""Points by which the camera is located, as on a map (`live_map`)."""
_SHARE = 0.5
"""Share of the known points that must agree."""
_AWAY = np.radians(1.5)
"""Angle up to which points agree: the parallax from which two views begin a map, so
that a camera that begins to move is followed until then, and no further."""
_SEEN = 10
"""Views whose mean a direction is, the first ones: parallax would move it."""


class TurningCamera:
    """Directions to points by the number of their track, and the last rotation."""

    def __init__(self, intrinsics: Intrinsics, *, still: bool = False) -> None:
        """**Arguments:** `still`: whether the camera is known to stand still, so that
        it needs no points."""
        self.K, self.distortion = as_opencv(intrinsics.params)
        self.pixel = 1 / float(np.sqrt(self.K[0, 0] * self.K[1, 1]))
        self.still = still
        self.turns = False
        """Whether it was seen to turn."""
        self.points: dict[int, Float[np.ndarray, " 3"]] = {}
        """Unit vectors in the world of the first camera."""
        self.seen: dict[int, int] = {}
        """Number of views in each, up to `_SEEN`."""
        self.T_WC = np.eye(4)

    @property
    def kind(self) -> str:
        """As of `SfmResult`."""
        return "rotation" if self.turns else "static"

    def locate(
        self, ids: Int[np.ndarray, " n"], uv: Float[np.ndarray, "n 2"]
    ) -> Float[np.ndarray, "4 4"] | None:
        """The pose of the next frame, `None` if its points show something else. The
        first frame with enough points has the identity."""
        if self.still:
            return self.T_WC
        ray = self._rays(uv)
        if self.points or len(ids) < _LEAST:
            known = np.array([i in self.points for i in ids.tolist()], bool)
            points = [self.points[i] for i in ids[known].tolist()]
            if not self._take(np.array(points).reshape(-1, 3), ray[known]):
                return None
        self._learn(ids, ray)
        return self.T_WC

    def relocated(
        self, points: Float[np.ndarray, "n 3"], uv: Float[np.ndarray, "n 2"]
    ) -> Float[np.ndarray, "4 4"] | None:
        """The pose of a frame that shows known directions, wherever it looks."""
        return self.T_WC if self._take(points, self._rays(uv)) else None

    def _rays(self, uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        uv = np.asarray(uv, float).reshape(-1, 2)
        return unit_rays(rays(uv, self.K, self.distortion))

    def _take(
        self, points: Float[np.ndarray, "n 3"], ray: Float[np.ndarray, "n 3"]
    ) -> bool:
        """Turns the camera to where directions are seen, once that moves them by more
        than points seem to wander; false if too few agree."""
        if len(points) < _LEAST:
            return False
        R_CW, away = fit_rotation(points, ray, self.pixel)
        if (away < _AWAY).sum() < max(_LEAST, _SHARE * len(points)):
            return False
        moved = np.linalg.norm(points @ (R_CW.T - self.T_WC[:3, :3]), axis=1)
        self.turns |= bool(np.median(moved) > MAX_STATIC_MOTION_PX * self.pixel)
        if self.turns:
            self.T_WC = np.eye(4)
            self.T_WC[:3, :3] = R_CW.T
        return True

    def _learn(self, ids: Int[np.ndarray, " n"], ray: Float[np.ndarray, "n 3"]) -> None:
        """Adds the frame's rays to the means, and drops tracks that have ended."""
        towards = ray @ self.T_WC[:3, :3].T
        points, seen = {}, {}
        for i, one in zip(ids.tolist(), towards, strict=True):
            count = self.seen.get(i, 0)
            mean = self.points[i] if count else one
            if count < _SEEN:
                total = count * mean + one
                mean = total / np.linalg.norm(total)
            points[i], seen[i] = mean, min(count + 1, _SEEN)
        self.points, self.seen = points, seen
