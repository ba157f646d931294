"""Tests how well point tracks fit a given camera path.

A static point is seen along one ray per frame; under the correct poses these rays
intersect, whatever the unit of the path. The share of observations to which their point
projects within a threshold is the path's *fit*. It is compared with that of a correct
path given the noise of the tracks and of such paths.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import binom

from bodyslam_jax.io.camera.calibration import as_opencv, rays
from bodyslam_jax.sfm.bundle import Views, rows_by
from bodyslam_jax.sfm.camera_motion import KEYFRAME_MOTION_SHARE, choose_keyframes
from bodyslam_jax.sfm.multiview import epipolar_distance, relative_pose
from bodyslam_jax.types import Intrinsics, Tracks

MIN_TESTED_OBSERVATIONS = 200
"""Least number of observations with which a path is compared."""
MIN_VIEWS = 3
"""Least number of views of a point that tests a path: with two, only one coordinate of
four is redundant."""
_PATH_NOISE = 1 / 640
"""Noise of projections under a correct path, as a share of the image's longer side:
visual SLAM weights its observations with 1 px at 640 to 752 px (ORB-SLAM, Mur-Artal et
al., T-RO 2015), and reprojection errors of COLMAP's models are smaller."""
_TRACK_NOISE_PX = 0.5
"""Noise of tracks, px, where no pair of frames determines it."""
_THRESHOLD_SIGMAS = 2.0
"""Largest error of an observation that fits, in standard deviations: 86 % of the
two-dimensional errors of a correct path are smaller."""
_MAX_NOISE_RATIO = 2.0
"""Largest noise of an accepted path, as a multiple of that of a correct path and of the
tracks together."""
MIN_EXPECTED_SHARE = 0.95
"""Least share of the expected fit at which a reading of poses or times is right, and
no other is tried."""
_MIN_SHARED_POINTS = 12
"""Least number of points that two keyframes share."""
_MAX_TRACKS, _VIEWS_PER_TRACK = 400, 8
_MIN_BLOCK_FRAMES, _MAX_BLOCKS = 10, 20
"""Least length of a block of time, within which errors are correlated, and
largest number of blocks."""
_MIN_DEPTH = 0.05
"""Depth, relative to that in the middle view, below which a point is behind."""
_ERROR_BEHIND_CAMERA = 10.0
"""Error, at depth 1, that counts for a point behind the camera."""
_NUM_ITERATIONS = 6
"""Number of Gauss--Newton iterations for a point; two more change shares by less than
0.1 %."""
_MAX_EQUAL_COST_DIFFERENCE = 0.02
"""Difference of a block's mean cost up to which two offsets fit it equally well."""
_SIGNIFICANCE_SIGMAS, _MAX_CHANCE = 3.0, 0.01
"""Number of standard errors beyond which, or probability of the signs by chance below
which, two offsets do not fit equally well."""


@dataclasses.dataclass(frozen=True)
class Fit:
    """How well tracks fit a path."""

    share: float
    """Share of the tested observations within `threshold` of the projection of their
    point."""
    tested: int
    """Number of observations of points seen in three or more frames with a pose."""
    expected: float
    """`share` of a correct path, given the noise of tracks and of such paths."""
    required: float
    """`share` of a path with `_MAX_NOISE_RATIO` times that noise."""
    threshold: float
    """Largest error of an observation that fits, px."""

    @property
    def doubtful(self) -> float:
        """Returns the share below which a correct path is improbable."""
        return (self.expected + self.required) / 2

    @property
    def convinces(self) -> bool:
        """Returns True if the fit suffices for a path whose offset was chosen to fit:
        that choice alone lets a third of the points fit a wrong path."""
        return not self.is_tested or self.share >= self.doubtful

    @property
    def is_tested(self) -> bool:
        return self.tested >= MIN_TESTED_OBSERVATIONS

    @property
    def fits(self) -> bool:
        return not self.is_tested or self.share >= self.required


class PathTest:
    """Tests paths and offsets against a sample of tracks."""

    def __init__(self, tracks: Tracks, intrinsics: Intrinsics, num_frames: int):
        K, distortion = as_opencv(intrinsics.params)
        self.focal = float(np.sqrt(K[0, 0] * K[1, 1]))
        views = Views(tracks.frame, tracks.landmark, rays(tracks.uv, K, distortion))
        longer = max(intrinsics.width, intrinsics.height)
        path_noise = _PATH_NOISE * longer
        share, track_noise = _static_share(
            views, self.focal, 2 * _THRESHOLD_SIGMAS * path_noise, longer
        )
        self.noise = float(np.hypot(track_noise, path_noise))
        self.threshold = _THRESHOLD_SIGMAS * self.noise
        self.expected = share * _within(_THRESHOLD_SIGMAS)
        self.required = share * _within(_THRESHOLD_SIGMAS / _MAX_NOISE_RATIO)
        self.frame, self.xy, self.used = _sample(views, num_frames)
        count = np.maximum(self.used.sum(1), 1)
        middle = np.where(self.used, self.frame, 0).sum(1) / count
        block_frames = max(num_frames / _MAX_BLOCKS, float(_MIN_BLOCK_FRAMES))
        self.block = (middle / block_frames).astype(int)

    def errors(
        self, T_WC: Float[np.ndarray, "t 4 4"], known: Bool[np.ndarray, " t"]
    ) -> Float[np.ndarray, "k v"]:
        """Returns the reprojection errors, px, of the sample's points, each at its best
        position; NaN where the path does not test them."""
        use = self.used & known[self.frame]
        use &= (use.sum(1) >= MIN_VIEWS)[:, None]
        found = np.full(use.shape, np.nan)
        (rows,) = np.nonzero(use.any(1))
        if not len(rows):
            return found
        use, frame, xy = use[rows], self.frame[rows], self.xy[rows]
        R_CW = np.swapaxes(T_WC[:, :3, :3], 1, 2)[frame]
        centre = T_WC[:, :3, 3][frame]
        error = _errors_of_best_points(R_CW, centre, xy, use, self.noise / self.focal)
        found[rows] = np.where(use, error * self.focal, np.nan)
        return found

    def fit(
        self, T_WC: Float[np.ndarray, "t 4 4"], known: Bool[np.ndarray, " t"]
    ) -> Fit:
        """Returns the fit of a path with a pose for each frame in `known`."""
        error = self.errors(T_WC, known)
        tested = ~np.isnan(error)
        share = float((error[tested] < self.threshold).mean()) if tested.any() else 0.0
        return Fit(
            share, int(tested.sum()), self.expected, self.required, self.threshold
        )

    def cost(self, error: Float[np.ndarray, "k v"]) -> Float[np.ndarray, "b 2"]:
        """Returns the robust cost (Cauchy) and number of observations by block."""
        tested = ~np.isnan(error)
        cost = np.where(tested, np.log1p((error / self.noise) ** 2), 0.0)
        num = int(self.block.max()) + 1 if len(self.block) else 1
        sums = [np.bincount(self.block, a.sum(1), num) for a in (cost, tested)]
        return np.stack(sums, axis=1)


def mean_cost(cost: Float[np.ndarray, "b 2"]) -> float:
    """Returns the mean cost of tested observations; infinite if there are too few."""
    count = cost[:, 1].sum()
    return (
        float(cost[:, 0].sum() / count)
        if count >= MIN_TESTED_OBSERVATIONS
        else float("inf")
    )


def is_worse(one: Float[np.ndarray, "b 2"], other: Float[np.ndarray, "b 2"]) -> bool:
    """Returns True if the first of two costs is significantly larger, by its standard
    error or a sign test over the blocks of time that both test."""
    both = (one[:, 1] > 0) & (other[:, 1] > 0)
    if both.sum() < 2:
        return mean_cost(one) > mean_cost(other)
    a, b = one[both], other[both]
    difference = a[:, 0] / a[:, 1] - b[:, 0] / b[:, 1]
    # Blocks that both explain equally well are not informative.
    telling = np.abs(difference) > _MAX_EQUAL_COST_DIFFERENCE
    weight, difference = np.minimum(a[:, 1], b[:, 1])[telling], difference[telling]
    num = len(difference)
    if num < 2:
        return False
    mean = (weight @ difference) / weight.sum()
    scatter = weight @ (difference - mean) ** 2 / weight.sum()
    error = np.sqrt(scatter / (num - 1)) + 1e-6
    chance = float(binom.sf((difference > 0).sum() - 1, num, 0.5))
    return bool(
        mean > 0 and (mean > _SIGNIFICANCE_SIGMAS * error or chance < _MAX_CHANCE)
    )


def what_would_fit(
    test: PathTest, T_WC: Float[np.ndarray, "t 4 4"], known: Bool[np.ndarray, " t"]
) -> str | None:
    """Returns the convention under which poses fit, if they do not fit as given; `None`
    if no known one does."""
    opengl = T_WC.copy()
    opengl[:, :3, :3] *= np.array([1.0, -1.0, -1.0])
    inverse = np.linalg.inv(T_WC)
    inverse_opengl = np.linalg.inv(T_WC)
    inverse_opengl[:, :3, :3] *= np.array([1.0, -1.0, -1.0])
    readings = {
        "as poses from world to camera": inverse,
        "with OpenGL's axes (y up, z back)": opengl,
        "as poses from world to camera with OpenGL's axes": inverse_opengl,
    }
    for name, poses in readings.items():
        fit = test.fit(poses, known)
        if fit.is_tested and fit.share >= MIN_EXPECTED_SHARE * fit.expected:
            return f"{100 * fit.share:.0f} % fit it {name}"
    return None


def _within(sigmas: float) -> float:
    """Returns the probability of a two-dimensional normal error below `sigmas`."""
    return float(1 - np.exp(-(sigmas**2) / 2))


def _static_share(
    views: Views, focal: float, threshold: float, longer: int
) -> tuple[float, float]:
    """Estimates the share of observations that fit the best relative pose of two
    frames, and the noise of tracks (px), from pairs of frames between which points
    move.

    Args:
        threshold: px.
        longer: the image's longer side, px.
    """
    if not len(views.frame):
        return 1.0, _TRACK_NOISE_PX
    first, last = int(views.frame.min()), int(views.frame.max())
    keyframes = choose_keyframes(
        views, first, last, KEYFRAME_MOTION_SHARE * longer / focal, _MIN_SHARED_POINTS
    )
    of_frame = rows_by(views.frame, last + 1)
    pairs = list(zip(keyframes[:-1], keyframes[1:], strict=True))
    chosen = np.unique(np.linspace(0, len(pairs) - 1, 12).astype(int)) if pairs else []
    shares, noises = [], []
    for i in chosen:
        one, other = of_frame[pairs[i][0]], of_frame[pairs[i][1]]
        _, a, b = np.intersect1d(
            views.landmark[one], views.landmark[other], return_indices=True
        )
        if len(a) < 20:
            continue
        xy = views.xy[one[a]], views.xy[other[b]]
        pose = relative_pose(*xy, 1 / focal)
        if pose is None:
            continue
        away = epipolar_distance(pose[0], pose[1], *xy) * focal
        good = away < threshold
        shares.append(good.mean())
        # 0.6745 is the median absolute value of a standard normal error.
        noises.append(np.median(away[good]) / 0.6745 if good.any() else _TRACK_NOISE_PX)
    if not shares:
        return 1.0, _TRACK_NOISE_PX
    return float(np.median(shares)), float(np.median(noises))


def _sample(
    views: Views, num_frames: int
) -> tuple[Int[np.ndarray, "k v"], Float[np.ndarray, "k v 2"], Bool[np.ndarray, "k v"]]:
    """Draws up to `_MAX_TRACKS` of the longest tracks, spread over the video, with up
    to `_VIEWS_PER_TRACK` evenly spaced views each."""
    order = np.lexsort((views.frame, views.landmark))
    landmark = views.landmark[order]
    start = np.flatnonzero(np.diff(landmark, prepend=-1))
    length = np.diff(np.append(start, len(landmark)))
    long = length >= MIN_VIEWS
    start, length = start[long], length[long]
    middle = views.frame[order[start + length // 2]] if len(start) else start
    parts = max(1, min(num_frames // 10, 40))
    part = middle * parts // max(num_frames, 1)
    kept: list[np.ndarray] = []
    for k in range(parts):
        (inside,) = np.nonzero(part == k)
        longest = inside[np.argsort(-length[inside], kind="stable")]
        kept.append(longest[: _MAX_TRACKS // parts])
    chosen = np.concatenate(kept)
    frame = np.zeros((len(chosen), _VIEWS_PER_TRACK), np.int64)
    xy = np.zeros((len(chosen), _VIEWS_PER_TRACK, 2))
    used = np.zeros(frame.shape, bool)
    for row, i in enumerate(chosen):
        count = min(int(length[i]), _VIEWS_PER_TRACK)
        at = np.linspace(0, length[i] - 1, count).round().astype(int)
        rows = order[start[i] + at]
        frame[row, :count], xy[row, :count] = views.frame[rows], views.xy[rows]
        used[row, :count] = True
    return frame, xy, used


def _errors_of_best_points(
    R_CW: Float[np.ndarray, "k v 3 3"],
    centre: Float[np.ndarray, "k v 3"],
    xy: Float[np.ndarray, "k v 2"],
    use: Bool[np.ndarray, "k v"],
    scale: float,
) -> Float[np.ndarray, "k v"]:
    """Returns the reprojection errors at depth 1 of the best points in front of the
    cameras.

    A point has x, y at depth 1 and the inverse depth in its middle view, so that one
    without parallax is at infinity. It is found by robust Gauss--Newton (Cauchy,
    `scale`).
    """
    num, most = use.shape
    # The anchor is the middle one of the used views.
    rank = np.cumsum(use, axis=1) * use
    anchor = np.argmin(np.abs(rank - (use.sum(1)[:, None] + 1) // 2), axis=1)
    row = np.arange(num)
    R = R_CW @ np.swapaxes(R_CW[row, anchor], 1, 2)[:, None]
    t = (R_CW @ (centre[row, anchor][:, None] - centre)[..., None])[..., 0]
    unit = np.sqrt((np.where(use[..., None], t, 0) ** 2).sum(-1).max(1))
    t = t / np.maximum(unit, 1e-12)[:, None, None]
    point = np.concatenate([xy[row, anchor], np.zeros((num, 1))], axis=1)
    weight = use.astype(float)
    error = np.zeros((num, most))
    for turn in range(_NUM_ITERATIONS):
        if turn >= _NUM_ITERATIONS // 2:  # a negative inverse depth is not visible
            point[:, 2] = np.maximum(point[:, 2], 0.0)
        ray = np.concatenate([point[:, :2], np.ones((num, 1))], axis=1)
        p = (R @ ray[:, None, :, None])[..., 0] + point[:, None, 2:] * t
        front = p[..., 2] > _MIN_DEPTH
        z = np.where(front, p[..., 2], _MIN_DEPTH)[..., None]
        predicted = p[..., :2] / z
        away = xy - predicted
        error = np.where(front, np.linalg.norm(away, axis=-1), _ERROR_BEHIND_CAMERA)
        if turn == _NUM_ITERATIONS - 1:
            break
        if turn:
            weight = use * front / (1 + (error / scale) ** 2)
        by = np.concatenate([R[..., :2], t[..., None]], axis=-1)
        J = (by[:, :, :2] - predicted[..., None] * by[:, :, 2:]) / z[..., None]
        weighted = (weight[..., None, None] * J).reshape(num, -1, 3).swapaxes(1, 2)
        A = weighted @ J.reshape(num, -1, 3)
        b = (weighted @ away.reshape(num, -1, 1))[..., 0]
        size = np.trace(A, axis1=1, axis2=2)
        A += (1e-9 * size + 1e-30)[:, None, None] * np.eye(3)
        if turn >= _NUM_ITERATIONS // 2:
            A[:, 2, 2] += np.where(point[:, 2] <= 0, 1e12, 0.0)
        step = np.linalg.solve(A, b[..., None])[..., 0]
        # A step of the inverse depth to behind a camera could not be reverted.
        point = point + np.clip(step, -2.0, 2.0)
    return error
