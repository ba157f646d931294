"""Incremental structure from motion: cameras and map, up to scale, from tracks.

The first pair is that whose map grows best; every other camera is located by 3D-2D
RANSAC; points are triangulated again as views arrive; a small bundle adjustment runs in
between. Keyframes are located first, then the frames between them.
"""

import logging
from collections.abc import Iterator

import numpy as np

from bodyslam_jax.sfm.bundle import Scene, errors
from bodyslam_jax.sfm.multiview import planar_poses, relative_pose, resect
from bodyslam_jax.sfm.partial_map import Mapper, PartialMap
from bodyslam_jax.types import CameraPath

_log = logging.getLogger(__name__)

_NUM_FIRST_PAIRS = 4
"""Number of pairs of keyframes that are tried as the start of the map. It assumes no
noise level, as the best is chosen by its share of inliers."""
MIN_SHARED_POINTS = 12
"""Least number of points that two related frames share."""
_MIN_EXPLAINED_SHARE = 0.75
"""Share of observations that a start explains below which twice the tolerance is
tried."""
_MIN_TOLERANCE_GAIN = 0.1
"""Least share of observations that twice the tolerance explains in addition, and of
inliers beyond the tolerance, for which it is kept: of normally distributed noise 0.14
are beyond if its standard deviation is half of the tolerance, 0.01 if it is a third."""
_NUM_RELAXED_ROUNDS = 3
"""Number of rounds with a smaller parallax threshold where
cameras cannot be located."""
_MIN_PLANAR_SHARE = 0.9
"""Least share of a pair's inliers that a plane explains, for its two poses to be tried:
a plane with the outliers that tracks have."""


def first_pairs(pairs: np.ndarray) -> np.ndarray:
    """Returns pairs of keyframes to start from: much parallax, many points, spread in
    time.

    The score saturates at a parallax of 5 degrees and 100 points, far above the effect
    of tracking noise of about 0.5 px (0.06 degrees at 640x480).
    """
    if not len(pairs):
        return np.zeros((0, 2), dtype=np.int64)
    # Far above the noise of tracking, so that more of either says no more.
    enough = np.minimum(pairs[:, 2], np.radians(5.0))
    score = enough * np.minimum(pairs[:, 3], 100) ** 1.5
    chosen: list[np.ndarray] = []
    for i in np.argsort(-score):
        apart = [np.abs(pairs[i, :2] - c).max() for c in chosen]
        span = pairs[i, 1] - pairs[i, 0]
        if not apart or min(apart) > 0.3 * span:
            chosen.append(pairs[i, :2])
        if len(chosen) == _NUM_FIRST_PAIRS:
            break
    return np.asarray(chosen).astype(np.int64)


class Builder(Mapper):
    """Grows a reconstruction over the keyframes of one shot."""

    def begin(self, path: CameraPath) -> PartialMap:
        """Returns the map triangulated from cameras of known poses, which are held."""
        R_WC, centre = path.T_WC[:, :3, :3], path.T_WC[:, :3, 3]
        scene = Scene(
            np.swapaxes(R_WC, 1, 2).copy(),
            centre.copy(),
            np.zeros((self.num_landmarks, 3)),
        )
        grown = PartialMap(
            scene,
            path.known.copy(),
            np.zeros(self.num_landmarks, dtype=bool),
            np.zeros(len(self.views.frame), dtype=bool),
            np.arange(self.num_landmarks),
            origin=int(np.argmax(path.known)),
        )
        self.make_points(grown, self._views_of(grown))
        self._mark(grown)
        return grown

    def build(self, keyframes: np.ndarray, pairs: np.ndarray) -> PartialMap | None:
        """Returns the best of the maps that grow over `keyframes`, the cameras of one
        shot, from some of `pairs`; `None` if no pair starts a map.

        Args:
            pairs: frames, error of a turning camera and common points of each pair of
                keyframes, as from `rotation_error`.

        Where even the best explains few observations, the noise of the tracks may be
        larger than assumed, or parallax may be short. Twice the tolerance is tried, and
        kept if many inliers need it: a map with a needless tolerance joins few of the
        tracks that it could, and wrong ones, and its scale drifts.
        """
        starts = first_pairs(pairs)
        best, score = self._best_start(keyframes, starts)
        for _ in range(2):
            if score > _MIN_EXPLAINED_SHARE:
                break
            self.threshold *= 2
            self.pixel *= 2
            wider, wider_score = self._best_start(keyframes, starts[:2])
            if wider is None or wider_score < score + _MIN_TOLERANCE_GAIN:
                self.threshold /= 2
                self.pixel /= 2
                break
            best, score = wider, wider_score
            if self._share_beyond(wider) < _MIN_TOLERANCE_GAIN:
                # It is a better start, but not by its tolerance.
                self.threshold /= 2
                self.pixel /= 2
                self._mark(best)
                break
        if best is None:
            return None
        self.joining = self.config.join_tracks
        self._grow(best, keyframes)
        for _ in range(_NUM_RELAXED_ROUNDS):
            if best.registered[keyframes].all():
                break
            # New points have little parallax where the camera mostly rotated.
            self.min_angle *= 0.6
            self.make_points(best, self._views_of(best))
            self._grow(best, keyframes)
        self._finish(best, keyframes)
        return best

    def _finish(self, grown: PartialMap, keyframes: np.ndarray) -> None:
        """Re-examines all joins and outliers with all keyframes in the map."""
        self._settle(grown, keyframes[grown.registered[keyframes]])
        for _ in range(3):  # outliers sorted anew in between
            self._refine(grown, self._free(grown))
            self.make_points(grown, self._views_of(grown))

    def _best_start(
        self, keyframes: np.ndarray, pairs: np.ndarray
    ) -> tuple[PartialMap | None, float]:
        best, scores = None, [-1.0]
        for a, b in pairs:
            # A few more cameras tell correct from wrong starts.
            near = keyframes[np.argsort(np.abs(keyframes - (a + b) / 2))][:8]
            score = -1.0
            for started in self._starts(int(a), int(b)):
                self._grow(started, near)
                own = self.score(started, near)
                _log.debug("start from frames %d and %d: %.2f", a, b, own)
                if own > max(score, *scores):
                    best = started
                score = max(score, own)
                if score > 0.9:
                    break
            if score < 0:
                continue
            # Where two starts agree no better one is expected.
            agrees = score > 0.5 and abs(score - max(scores)) < 0.03
            scores.append(score)
            if score > 0.9 or agrees:
                break
        return best, max(scores)

    def complete(self, grown: PartialMap, frames: np.ndarray) -> None:
        """Adds the frames between keyframes, then re-evaluates points and inliers."""
        for k in frames:
            if not grown.registered[k]:
                self._register(grown, int(k))
        self.make_points(grown, self._views_of(grown))
        self._mark(grown)
        grown.shown[self.revisits.track] = self.views.landmark

    def _starts(self, a: int, b: int) -> Iterator[PartialMap]:
        """Yields maps of two frames: one for each pose that explains their points."""
        _, i, j = np.intersect1d(
            self.views.landmark[self.of_frame[a]],
            self.views.landmark[self.of_frame[b]],
            return_indices=True,
        )
        if len(i) < MIN_SHARED_POINTS:
            return
        at_a, at_b = self.of_frame[a][i], self.of_frame[b][j]
        xy_a, xy_b = self.views.xy[at_a], self.views.xy[at_b]
        pose = relative_pose(xy_a, xy_b, self.pixel)
        if pose is None or pose[2].sum() < MIN_SHARED_POINTS:
            return
        started = self._started(a, b, pose, at_a, at_b)
        if started is not None:
            yield started
        share = _MIN_PLANAR_SHARE * float(pose[2].mean())
        for other in planar_poses(xy_a, xy_b, self.pixel, share):
            started = self._started(a, b, other, at_a, at_b)
            if started is not None:
                yield started

    def _started(
        self,
        a: int,
        b: int,
        pose: tuple[np.ndarray, np.ndarray, np.ndarray],
        at_a: np.ndarray,
        at_b: np.ndarray,
    ) -> PartialMap | None:
        """Returns the refined map of two frames with a relative pose; `None` if it has
        too few points."""
        R, t, good = pose
        scene = Scene(
            np.tile(np.eye(3), (self.num_frames, 1, 1)),
            np.zeros((self.num_frames, 3)),
            np.zeros((self.num_landmarks, 3)),
        )
        scene.R_CW[b], scene.centre[b] = R, -R.T @ t
        grown = PartialMap(
            scene,
            np.isin(np.arange(self.num_frames), [a, b]),
            np.zeros(self.num_landmarks, dtype=bool),
            np.zeros(len(self.views.frame), dtype=bool),
            np.arange(self.num_landmarks),
            origin=a,
        )
        self.make_points(grown, np.concatenate([at_a[good], at_b[good]]))
        if grown.has_point.sum() < MIN_SHARED_POINTS:
            return None
        self._refine(grown, self._free(grown))
        return grown

    def _grow(self, grown: PartialMap, frames: np.ndarray) -> None:
        """Registers `frames`, always the one with most triangulated points next."""
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
            self.make_points(grown, self._views_seen_in(grown, k))
            self._join(grown, k)
            count = int(grown.registered.sum())
            if count < 8 or count >= 1.25 * at_last:
                self._refine(grown, self._free(grown))
                self.make_points(grown, self._views_of(grown))
                since, at_last, failed = 0, count, set()
            elif since >= 2:
                self._refine(grown, self._nearest(grown, k, 8))
                since = 0
        self._refine(grown, self._free(grown))
        self.make_points(grown, self._views_of(grown))
        self._refine(grown, self._free(grown))

    def _register(self, grown: PartialMap, k: int) -> bool:
        at = self.of_frame[k]
        at = at[grown.has_point[self.views.landmark[at]]]
        located_frames = np.flatnonzero(grown.registered)
        nearest = located_frames[np.argmin(np.abs(located_frames - k))]
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

    def score(self, grown: PartialMap, frames: np.ndarray) -> float:
        """Returns the share of inliers among the observations in `frames`."""
        return self.share_explained(grown, frames)[0]

    def _share_beyond(self, grown: PartialMap) -> float:
        """Returns the share of the inliers whose error is beyond half of the
        threshold."""
        inliers = self.views[np.flatnonzero(grown.inlier)]
        beyond = errors(grown.scene, inliers) > self.threshold / 2
        return float(beyond.mean()) if len(beyond) else 0.0

    def share_explained(
        self, grown: PartialMap, frames: np.ndarray
    ) -> tuple[float, int]:
        """Returns the share of inliers, and the number of tested observations."""
        at = np.concatenate([self.of_frame[int(k)] for k in frames])
        # Only landmarks seen twice can be explained at all.
        observations = np.bincount(
            self.views.landmark[at], minlength=self.num_landmarks
        )
        at = at[observations[self.views.landmark[at]] >= 2]
        return (float(grown.inlier[at].mean()) if len(at) else 0.0), len(at)
