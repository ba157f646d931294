"""A growing map: triangulation, inliers, bundle adjustment, joined tracks."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Int

from bodyslam_jax.config import Structure
from bodyslam_jax.geometry.triangulation import triangulate, widest_angle
from bodyslam_jax.sfm.bundle import Scene, Views, adjust, errors, rows_by
from bodyslam_jax.sfm.loop_closure import Revisits

_OUTLIER_ERROR_PX = 2.0
"""Reprojection error beyond which an observation is an outlier, px: 4 σ of an assumed
tracking noise of 0.5 px at 640x480; not scaled with the image, but `Builder.build`
doubles it up to twice where that gives more inliers."""
_MIN_ANGLE_DEG = 0.5
"""Smallest angle between the rays of a point, degrees; smaller ones are tried where
cameras cannot be located otherwise."""
_MIN_DISTANCE_OBSERVATIONS = 20
"""Least number of observations of triangulated points by which their median distance is
estimated."""
_MIN_OWN_ANGLE_SHARE = 0.5
"""Least angle of a point at its triangulated position, as a share of the smallest
angle."""
_MIN_DRIFT = 1.0
"""Least drift at revisited points, in thresholds, for which the loop is closed at
once."""
_CLOSING_LOSSES_PX = (8.0, 3.0)
"""Scales of the loss in successive adjustments, px: wide at first, so that the joined
tracks are not rejected as outliers."""
_MAX_ROUNDS, _MAX_SETTLED_SHARE = 6, 0.01
"""Largest number of rounds of joining and separating tracks, and the share of
observations that change their landmark below which the rounds end."""

_TOLERANCE = 1e-3
"""Relative decrease of the cost that ends an adjustment while the map grows."""


@dataclasses.dataclass
class PartialMap:
    """An incomplete reconstruction."""

    scene: Scene
    registered: Bool[np.ndarray, " t"]
    has_point: Bool[np.ndarray, " l"]
    inlier: Bool[np.ndarray, " m"]
    """Observations that fit, of those in registered frames."""
    shown: Int[np.ndarray, " l"]
    """The landmark that each track observes: its own, unless tracks were joined."""
    origin: int
    """Frame that the map grew from: its camera fixes the world frame."""


class Mapper:
    """Triangulation and adjustment over the frames of one shot."""

    def __init__(
        self,
        views: Views,
        num_frames: int,
        num_landmarks: int,
        focal: float,
        config: Structure,
    ):
        self.views = Views(views.frame, views.landmark.copy(), views.xy)
        self.config = config
        self.revisits = Revisits(self.views, num_landmarks)
        self.joining = False
        self.num_frames, self.num_landmarks = num_frames, num_landmarks
        self.pixel: float = 1 / focal
        self.threshold: float = _OUTLIER_ERROR_PX / focal
        self.min_angle = np.radians(_MIN_ANGLE_DEG)
        self.of_frame = rows_by(views.frame, num_frames)

    def _join(self, grown: PartialMap, k: int) -> None:
        """Joins points of frame `k` with points of the map that they revisit."""
        if not self.joining:
            return
        observed = self.views.landmark[self.of_frame[k]]
        pairs, away = self.revisits.find(
            grown.scene, k, observed, grown.has_point, grown.registered, self.threshold
        )
        for one, other in pairs:
            rows = self.revisits.join(one, other)
            grown.has_point[one] = False
            grown.inlier[rows] = grown.registered[self.views.frame[rows]]
        if pairs and away > _MIN_DRIFT * self.threshold:
            self._close(grown)

    def _settle(self, grown: PartialMap, frames: np.ndarray) -> None:
        """Joins and separates tracks until few observations change: false joins become
        apparent once the map is less distorted."""
        for turn in range(_MAX_ROUNDS):
            if not self.revisits.members:
                return
            before = self.views.landmark.copy()
            self._close(grown)
            # A track is seen from several keyframes: every other one suffices.
            for k in frames[turn % 2 :: 2]:
                self._join(grown, int(k))
            self._refine(grown, self._free(grown))
            self.make_points(grown, self._views_of(grown))
            if np.mean(self.views.landmark != before) < _MAX_SETTLED_SHARE:
                return

    def _close(self, grown: PartialMap) -> None:
        """Distributes the drift over the loop by bundle adjustment."""
        use = np.flatnonzero(grown.inlier & grown.registered[self.views.frame])
        for loss in _CLOSING_LOSSES_PX:
            adjust(
                grown.scene,
                self.views[use],
                self._free(grown),
                loss=loss * self.pixel,
                tolerance=_TOLERANCE,
            )
        self._mark(grown)

    def _views_of(self, grown: PartialMap) -> np.ndarray:
        return np.flatnonzero(grown.registered[self.views.frame])

    def _views_seen_in(self, grown: PartialMap, k: int) -> np.ndarray:
        """Returns all observations of points of frame `k` that have no position."""
        wanted = np.zeros(self.num_landmarks, dtype=bool)
        wanted[self.views.landmark[self.of_frame[k]]] = True
        wanted &= ~grown.has_point
        use = wanted[self.views.landmark] & grown.registered[self.views.frame]
        return np.flatnonzero(use)

    def make_points(self, grown: PartialMap, use: np.ndarray) -> None:
        """Triangulates landmarks without a point from the observations `use`, where
        they agree and have enough parallax."""
        use = use[~grown.has_point[self.views.landmark[use]]]
        if not len(use):
            return
        views = self.views[use]
        points = triangulate(
            grown.scene.R_CW[views.frame],
            grown.scene.centre[views.frame],
            views.xy,
            views.landmark,
            self.num_landmarks,
            self.pixel,
        )
        trial = Scene(grown.scene.R_CW, grown.scene.centre, points)
        good = errors(trial, views) < self.threshold
        count = np.bincount(views.landmark, minlength=self.num_landmarks)
        fits = np.bincount(views.landmark[good], minlength=self.num_landmarks)
        if not good.any():
            return
        observed = views[np.flatnonzero(good)]
        angle = widest_angle(trial.centre[observed.frame], observed.landmark, points)
        new = (
            (fits >= 2)
            & (fits >= 0.6 * count)
            & (angle > _MIN_OWN_ANGLE_SHARE * self.min_angle)
        )
        new &= self._parallax(trial, observed, grown) > self.min_angle
        grown.scene.points[new] = points[new]
        grown.has_point |= new
        kept = new[views.landmark]
        grown.inlier[use[kept]] = good[kept]

    def _parallax(self, trial: Scene, views: Views, grown: PartialMap) -> np.ndarray:
        """Returns the parallax (rad) of each landmark at the median distance of the
        points that the same cameras observe.

        The parallax at the triangulated point itself would select points that are too
        near because of noise: the map would shrink as it grows.
        """
        near = np.isin(np.arange(self.num_frames), views.frame)
        at = grown.has_point[self.views.landmark] & near[self.views.frame]
        if np.count_nonzero(at) < _MIN_DISTANCE_OBSERVATIONS:
            return widest_angle(trial.centre[views.frame], views.landmark, trial.points)
        triangulated = self.views[np.flatnonzero(at)]
        centres = grown.scene.centre[triangulated.frame]
        offset = grown.scene.points[triangulated.landmark] - centres
        usual = np.median(np.linalg.norm(offset, axis=-1))
        centre = np.zeros_like(trial.points)
        centre[views.landmark] = trial.centre[views.frame]
        ray = trial.points - centre
        distance = np.linalg.norm(ray, axis=-1, keepdims=True)
        shifted = centre + usual * ray / np.maximum(distance, 1e-12)
        return widest_angle(trial.centre[views.frame], views.landmark, shifted)

    def _mark(self, grown: PartialMap) -> None:
        """Sorts observations into inliers and outliers, and drops poor points."""
        use = self._views_of(grown)
        use = use[grown.has_point[self.views.landmark[use]]]
        error = errors(grown.scene, self.views[use]) / self.threshold
        good = error < 1
        grown.inlier[:] = False
        grown.inlier[use] = good
        of_all = np.full(len(self.views.frame), np.nan)
        of_all[use] = error
        if self.revisits.part(of_all):
            # Separated tracks have no point yet.
            still = grown.has_point[self.views.landmark[use]]
            grown.inlier[use[~still]] = False
            use, good = use[still], good[still]
        views = self.views[use]
        count = np.bincount(views.landmark, minlength=self.num_landmarks)
        fits = np.bincount(views.landmark[good], minlength=self.num_landmarks)
        fitting = views[np.flatnonzero(good)]
        angle = widest_angle(
            grown.scene.centre[fitting.frame], fitting.landmark, grown.scene.points
        )
        bad = (
            (fits < 2)
            | (fits < 0.5 * count)
            | (angle < _MIN_OWN_ANGLE_SHARE * self.min_angle)
        )
        grown.has_point &= ~bad
        grown.inlier &= grown.has_point[self.views.landmark]

    def _free(self, grown: PartialMap) -> np.ndarray:
        """Returns all registered cameras but the one that fixes the world frame.

        That must not be the newest one, whose pose is the least certain: others would
        bend to it, and the scale of a map that grows towards earlier frames would drift
        by several per cent a frame.
        """
        free = grown.registered.copy()
        free[grown.origin] = False
        return free

    def _nearest(self, grown: PartialMap, k: int, count: int) -> np.ndarray:
        located = np.flatnonzero(grown.registered)
        near = located[np.argsort(np.abs(located - k), kind="stable")][:count]
        return np.isin(np.arange(self.num_frames), near) & self._free(grown)

    def _refine(self, grown: PartialMap, free: np.ndarray) -> None:
        use = np.flatnonzero(grown.inlier & grown.registered[self.views.frame])
        if not free.all():
            # Points that no free camera sees are left out, to save time.
            touched = np.zeros(self.num_landmarks, dtype=bool)
            touched[self.views.landmark[use[free[self.views.frame[use]]]]] = True
            use = use[touched[self.views.landmark[use]]]
        if len(use):
            views = self.views[use]
            adjust(grown.scene, views, free, loss=self.pixel, tolerance=_TOLERANCE)
        self._mark(grown)
