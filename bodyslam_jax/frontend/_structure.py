"""Tracks -> cameras and map, up to scale: incremental structure from motion.

The first pair is chosen by what grows from it; every other camera comes from 3D-2D
RANSAC; points are triangulated again and again as views arrive; a small bundle
adjustment runs in between. Keyframes first, then the frames between them.
"""

import dataclasses
import logging
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Int

from bodyslam_jax.config import Structure
from bodyslam_jax.frontend._bundle import Scene, Views, adjust, errors
from bodyslam_jax.frontend._geometry import (
    relative_pose,
    resect,
    triangulate,
    widest_angle,
)
from bodyslam_jax.frontend._revisits import Revisits

_log = logging.getLogger(__name__)

_ENOUGH = 20
"""Views of known points that tell how far points usually are."""
_FLAT = 0.5
"""Share of the smallest angle that a point may itself have."""
_DRIFTED = 1.0
"""Error of a place seen again, in thresholds, from which the loop is closed at once."""
_CLOSING = (8.0, 3.0)
"""Scales of the loss with which it is, in pixels: what joins must not seem outliers."""
_ROUNDS, _SETTLED = 6, 0.01
"""Times that joins are looked at again, and the share of observations of which another
landmark is then thought that ends it."""
_RELAXED = 3
"""Times that a smaller angle is tried where cameras cannot be located."""

Refine = Callable[[Scene, Views, Bool[np.ndarray, " t"]], None]
"""Adjusts the free cameras and all points of `views` in place, as `_bundle.adjust`."""


@dataclasses.dataclass
class Growing:
    """A reconstruction on its way."""

    scene: Scene
    registered: Bool[np.ndarray, " t"]
    has_point: Bool[np.ndarray, " l"]
    inlier: Bool[np.ndarray, " m"]
    """Observations that fit, of those in registered frames."""
    shown: Int[np.ndarray, " l"]
    """The landmark that each track shows: its own, unless tracks were joined."""


class Builder:
    """Grows a reconstruction over the keyframes of one shot."""

    def __init__(
        self,
        views: Views,
        num_frames: int,
        num_landmarks: int,
        focal: float,
        config: Structure,
        refine: Refine | None = None,
    ):
        self.views = Views(views.frame, views.landmark.copy(), views.xy)
        self.config = config
        self.revisits = Revisits(self.views, num_landmarks)
        self.joining = False
        self.num_frames, self.num_landmarks = num_frames, num_landmarks
        self.pixel = 1 / focal
        self.threshold = config.max_error / focal
        self.min_angle = np.radians(config.min_angle)
        self.refine = refine or self._adjust
        order = np.argsort(views.frame, kind="stable")
        bounds = np.searchsorted(views.frame[order], np.arange(num_frames + 1))
        self.of_frame = [
            order[a:b] for a, b in zip(bounds[:-1], bounds[1:], strict=True)
        ]

    def _adjust(self, scene: Scene, views: Views, free: np.ndarray) -> None:
        adjust(scene, views, free, loss=self.pixel, iterations=10, tolerance=1e-3)

    def build(self, keyframes: np.ndarray, pairs: np.ndarray) -> Growing | None:
        """The best of the reconstructions that grow from `pairs` of keyframes.

        Where even the best leaves much unexplained, the points are noisier than
        thought: it is tried again with twice the tolerance.
        """
        best, score = self._best_start(keyframes, pairs)
        for _ in range(2):
            if score > 0.75:
                break
            self.threshold *= 2
            self.pixel *= 2
            wider, wider_score = self._best_start(keyframes, pairs[:2])
            if wider_score < score + 0.1:
                self.threshold /= 2
                self.pixel /= 2
                break
            best, score = wider, wider_score
        if best is None:
            return None
        self.joining = self.config.join_tracks
        self._grow(best, keyframes)
        for _ in range(_RELAXED):
            if best.registered[keyframes].all():
                break
            # The camera turned on while it hardly moved: what it came to see has but
            # little parallax.
            self.min_angle *= 0.6
            self._triangulate(best, self._views_of(best))
            self._grow(best, keyframes)
        self._settle(best, keyframes[best.registered[keyframes]])
        for _ in range(3):  # outliers sorted anew in between
            self._refine(best, self._free(best))
            self._triangulate(best, self._views_of(best))
        return best

    def _best_start(
        self, keyframes: np.ndarray, pairs: np.ndarray
    ) -> tuple[Growing | None, float]:
        best, scores = None, [-1.0]
        for a, b in pairs:
            started = self._start(int(a), int(b))
            if started is None:
                continue
            # A few more cameras tell a right start from a wrong one.
            near = keyframes[np.argsort(np.abs(keyframes - (a + b) / 2))][:8]
            self._grow(started, near)
            score = self._score(started, near)
            _log.debug("start from frames %d and %d: %.2f", a, b, score)
            if score > max(scores):
                best = started
            # Two that agree are as good as it gets with these points.
            agrees = score > 0.5 and abs(score - max(scores)) < 0.03
            scores.append(score)
            if score > 0.9 or agrees:
                break
        return best, max(scores)

    def complete(self, grown: Growing, frames: np.ndarray) -> None:
        """Adds the frames between keyframes, then looks at everything once more."""
        for k in frames:
            if not grown.registered[k]:
                self._register(grown, int(k))
        self._triangulate(grown, self._views_of(grown))
        self._mark(grown)
        grown.shown[self.revisits.track] = self.views.landmark

    def _start(self, a: int, b: int) -> Growing | None:
        _, i, j = np.intersect1d(
            self.views.landmark[self.of_frame[a]],
            self.views.landmark[self.of_frame[b]],
            return_indices=True,
        )
        if len(i) < self.config.min_shared:
            return None
        at_a, at_b = self.of_frame[a][i], self.of_frame[b][j]
        pose = relative_pose(self.views.xy[at_a], self.views.xy[at_b], self.pixel)
        if pose is None or pose[2].sum() < self.config.min_shared:
            return None
        R, t, good = pose
        scene = Scene(
            np.tile(np.eye(3), (self.num_frames, 1, 1)),
            np.zeros((self.num_frames, 3)),
            np.zeros((self.num_landmarks, 3)),
        )
        scene.R_CW[b], scene.centre[b] = R, -R.T @ t
        grown = Growing(
            scene,
            np.isin(np.arange(self.num_frames), [a, b]),
            np.zeros(self.num_landmarks, dtype=bool),
            np.zeros(len(self.views.frame), dtype=bool),
            np.arange(self.num_landmarks),
        )
        self._triangulate(grown, np.concatenate([at_a[good], at_b[good]]))
        if grown.has_point.sum() < self.config.min_shared:
            return None
        self._refine(grown, grown.registered & (np.arange(self.num_frames) != a))
        return grown

    def _grow(self, grown: Growing, frames: np.ndarray) -> None:
        """Registers `frames`, the one that sees most points first."""
        waiting = {int(k) for k in frames if not grown.registered[k]}
        failed: set[int] = set()
        since, at_last = 0, int(grown.registered.sum())
        while waiting - failed:
            visible = {
                k: int(grown.has_point[self.views.landmark[self.of_frame[k]]].sum())
                for k in waiting - failed
            }
            k = max(visible, key=lambda k: (visible[k], -k))
            if visible[k] < 6 or not self._register(grown, k):
                failed.add(k)
                continue
            waiting.discard(k)
            since += 1
            self._triangulate(grown, self._views_seen_in(grown, k))
            self._join(grown, k)
            count = int(grown.registered.sum())
            if count < 8 or count >= 1.25 * at_last:
                self._refine(grown, self._free(grown))
                self._triangulate(grown, self._views_of(grown))
                since, at_last, failed = 0, count, set()
            elif since >= 2:
                self._refine(grown, self._nearest(grown, k, 8))
                since = 0
        self._refine(grown, self._free(grown))
        self._triangulate(grown, self._views_of(grown))
        self._refine(grown, self._free(grown))

    def _register(self, grown: Growing, k: int) -> bool:
        at = self.of_frame[k]
        at = at[grown.has_point[self.views.landmark[at]]]
        known = np.flatnonzero(grown.registered)
        nearest = known[np.argmin(np.abs(known - k))]
        guess = (grown.scene.R_CW[nearest], grown.scene.centre[nearest])
        found = resect(
            grown.scene.points[self.views.landmark[at]],
            self.views.xy[at],
            self.threshold,
            guess,
        )
        if found is None or found[2].sum() < max(8, 0.3 * len(at)):
            return False
        grown.scene.R_CW[k], grown.scene.centre[k] = found[:2]
        grown.registered[k] = True
        grown.inlier[at] = found[2]
        return True

    def _join(self, grown: Growing, k: int) -> None:
        """Finds points of the map again among those that frame `k` sees."""
        if not self.joining:
            return
        seen = self.views.landmark[self.of_frame[k]]
        pairs, away = self.revisits.find(
            grown.scene, k, seen, grown.has_point, grown.registered, self.threshold
        )
        for one, other in pairs:
            rows = self.revisits.join(one, other)
            grown.has_point[one] = False
            grown.inlier[rows] = grown.registered[self.views.frame[rows]]
        if pairs and away > _DRIFTED * self.threshold:
            self._close(grown)

    def _settle(self, grown: Growing, frames: np.ndarray) -> None:
        """Joins and parts tracks until that changes little: what was joined wrongly
        while the map was bent is seen to be once it is less so."""
        for _ in range(_ROUNDS):
            if not self.revisits.members:
                return
            before = self.views.landmark.copy()
            self._close(grown)
            for k in frames:
                self._join(grown, int(k))
            self._refine(grown, self._free(grown))
            self._triangulate(grown, self._views_of(grown))
            if np.mean(self.views.landmark != before) < _SETTLED:
                return

    def _close(self, grown: Growing) -> None:
        """Spreads what the map has drifted over all that was seen since."""
        use = np.flatnonzero(grown.inlier & grown.registered[self.views.frame])
        for loss in _CLOSING:
            adjust(
                grown.scene,
                self.views[use],
                self._free(grown),
                loss=loss * self.pixel,
                tolerance=1e-3,
            )
        self._mark(grown)

    def _views_of(self, grown: Growing) -> np.ndarray:
        return np.flatnonzero(grown.registered[self.views.frame])

    def _views_seen_in(self, grown: Growing, k: int) -> np.ndarray:
        """All views of the points that frame `k` sees and that are not known yet."""
        wanted = np.zeros(self.num_landmarks, dtype=bool)
        wanted[self.views.landmark[self.of_frame[k]]] = True
        wanted &= ~grown.has_point
        use = wanted[self.views.landmark] & grown.registered[self.views.frame]
        return np.flatnonzero(use)

    def _triangulate(self, grown: Growing, use: np.ndarray) -> None:
        """Makes points of landmarks that have none, where the views `use` allow it."""
        use = use[~grown.has_point[self.views.landmark[use]]]
        if not len(use):
            return
        views = self.views[use]
        points, _, _ = triangulate(grown.scene, views, self.num_landmarks, self.pixel)
        trial = Scene(grown.scene.R_CW, grown.scene.centre, points)
        good = errors(trial, views) < self.threshold
        count = np.bincount(views.landmark, minlength=self.num_landmarks)
        fits = np.bincount(views.landmark[good], minlength=self.num_landmarks)
        if not good.any():
            return
        seen = views[np.flatnonzero(good)]
        angle = widest_angle(trial, seen, points, self.num_landmarks)
        new = (fits >= 2) & (fits >= 0.6 * count) & (angle > _FLAT * self.min_angle)
        new &= self._parallax(trial, seen, grown) > self.min_angle
        grown.scene.points[new] = points[new]
        grown.has_point |= new
        kept = new[views.landmark]
        grown.inlier[use[kept]] = good[kept]

    def _parallax(self, trial: Scene, views: Views, grown: Growing) -> np.ndarray:
        """Largest angle (rad) between the rays to each landmark, were it as far away as
        points usually are that the same cameras see.

        The angle at the point itself would choose points that noise has drawn nearer:
        the map would shrink, the more so the further it grows.
        """
        near = np.isin(np.arange(self.num_frames), views.frame)
        at = grown.has_point[self.views.landmark] & near[self.views.frame]
        if np.count_nonzero(at) < _ENOUGH:
            return widest_angle(trial, views, trial.points, self.num_landmarks)
        known = self.views[np.flatnonzero(at)]
        away = grown.scene.points[known.landmark] - grown.scene.centre[known.frame]
        usual = np.median(np.linalg.norm(away, axis=-1))
        centre = np.zeros_like(trial.points)
        centre[views.landmark] = trial.centre[views.frame]
        ray = trial.points - centre
        distance = np.linalg.norm(ray, axis=-1, keepdims=True)
        there = centre + usual * ray / np.maximum(distance, 1e-12)
        return widest_angle(trial, views, there, self.num_landmarks)

    def _mark(self, grown: Growing) -> None:
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
            # Tracks that are their own again have no point yet.
            still = grown.has_point[self.views.landmark[use]]
            grown.inlier[use[~still]] = False
            use, good = use[still], good[still]
        views = self.views[use]
        count = np.bincount(views.landmark, minlength=self.num_landmarks)
        fits = np.bincount(views.landmark[good], minlength=self.num_landmarks)
        angle = widest_angle(
            grown.scene,
            views[np.flatnonzero(good)],
            grown.scene.points,
            self.num_landmarks,
        )
        bad = (fits < 2) | (fits < 0.5 * count) | (angle < _FLAT * self.min_angle)
        grown.has_point &= ~bad
        grown.inlier &= grown.has_point[self.views.landmark]

    def _free(self, grown: Growing) -> np.ndarray:
        """All registered cameras but the first, which holds the frame in place."""
        free = grown.registered.copy()
        free[np.argmax(free)] = False
        return free

    def _nearest(self, grown: Growing, k: int, count: int) -> np.ndarray:
        known = np.flatnonzero(grown.registered)
        near = known[np.argsort(np.abs(known - k), kind="stable")][:count]
        return np.isin(np.arange(self.num_frames), near) & self._free(grown)

    def _refine(self, grown: Growing, free: np.ndarray) -> None:
        use = np.flatnonzero(grown.inlier & grown.registered[self.views.frame])
        if not free.all():
            # Points that no free camera sees would only cost time.
            touched = np.zeros(self.num_landmarks, dtype=bool)
            touched[self.views.landmark[use[free[self.views.frame[use]]]]] = True
            use = use[touched[self.views.landmark[use]]]
        if len(use):
            self.refine(grown.scene, self.views[use], free)
        self._mark(grown)

    def _score(self, grown: Growing, frames: np.ndarray) -> float:
        """Part of the observations in `frames` that the reconstruction explains."""
        at = np.concatenate([self.of_frame[int(k)] for k in frames])
        # Only landmarks seen twice can be explained at all.
        seen = np.bincount(self.views.landmark[at], minlength=self.num_landmarks)
        at = at[seen[self.views.landmark[at]] >= 2]
        return float(grown.inlier[at].mean()) if len(at) else 0.0
