"""A given camera path against point tracks: how well do the tracks fit it.

A point that stands still is seen along one ray per frame; under the right poses these
rays meet, whatever the unit of the path. The share of observations whose point
projects to them within a threshold is the path's *fit*. It is compared with what a
right path reaches given the noise of the tracks and of such paths.
"""

import copy
import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import binom

from bodyslam_jax.io.camera.calibration import as_opencv, rays
from bodyslam_jax.sfm.bundle import Views
from bodyslam_jax.sfm.camera_motion import choose_keyframes
from bodyslam_jax.sfm.multiview import relative_pose
from bodyslam_jax.types import Intrinsics, Tracks

MIN_TESTED = 200
"""Observations below which a path is not compared with the images."""
MIN_VIEWS = 3
"""Views of a point that test a path: with two, only one number of four is redundant."""
_PATH_NOISE = 1 / 640
"""Noise of the images of points under a right path, of the image's longer side: visual
SLAM weights its observations with 1 px at 640 to 752 px (ORB-SLAM, Mur-Artal et al.,
T-RO 2015), and reprojection errors of COLMAP's models are smaller."""
_TRACK_NOISE = 0.5
"""px; noise of tracks where no pair of frames tells it."""
_THRESHOLD = 2.0
"""Error of an observation that fits, in standard deviations: 86 % of a right path's
two-dimensional errors are smaller."""
_NOISIEST = 2.0
"""Noise of a path that is still accepted, in that of `_PATH_NOISE` and of the
tracks together."""
_MAX_TRACKS, _VIEWS_PER_TRACK = 400, 8
_BLOCK_FRAMES, _MAX_BLOCKS = 10, 20
"""Frames of a block of time, errors in which are correlated, at least; and most
blocks."""
_BEHIND = 10.0
"""Error, at depth 1, of a point that would lie behind the camera."""
_ITERATIONS = 6
"""Of Gauss--Newton for a point; two more change shares by less than 0.1 %."""
_SAME_COST = 0.02
"""Difference of the mean cost of a block's observations that tells nothing."""
_SIGNIFICANT, _UNLIKELY = 3.0, 0.01
"""Standard errors beyond which, and probability of chance below which, two offsets do
not fit equally well."""


@dataclasses.dataclass(frozen=True)
class Fit:
    """How well tracks fit a path."""

    share: float
    """Of the tested observations, those within `threshold` of where the path has
    them."""
    tested: int
    """Observations of points that are seen in three or more frames with a pose."""
    expected: float
    """`share` of a right path, given the noise of tracks and of such paths."""
    required: float
    """`share` of a path with `_NOISIEST` times that noise."""
    threshold: float
    """px"""

    @property
    def doubtful(self) -> float:
        """Share below which a right path would be surprising."""
        return (self.expected + self.required) / 2

    @property
    def convinces(self) -> bool:
        """Whether it fits well enough for a path whose offset was chosen to fit: that
        alone lets a third of the points fit a path that is none."""
        return not self.is_tested or self.share >= self.doubtful

    @property
    def is_tested(self) -> bool:
        return self.tested >= MIN_TESTED

    @property
    def fits(self) -> bool:
        return not self.is_tested or self.share >= self.required


class PathTest:
    """A sample of tracks, against which paths and offsets are tested."""

    def __init__(self, tracks: Tracks, intrinsics: Intrinsics, num_frames: int):
        K, distortion = as_opencv(intrinsics.params)
        self.focal = float(np.sqrt(K[0, 0] * K[1, 1]))
        self.num_frames = num_frames
        views = Views(tracks.frame, tracks.landmark, rays(tracks.uv, K, distortion))
        longer = max(intrinsics.width, intrinsics.height)
        path_noise = _PATH_NOISE * longer
        share, track_noise = _static_share(
            views, self.focal, 2 * _THRESHOLD * path_noise, longer
        )
        self.noise = float(np.hypot(track_noise, path_noise))
        self.threshold = _THRESHOLD * self.noise
        self.expected = share * _within(_THRESHOLD)
        self.required = share * _within(_THRESHOLD / _NOISIEST)
        self.views = views
        self._take(views, max(num_frames / _MAX_BLOCKS, float(_BLOCK_FRAMES)))

    def _take(self, views: Views, block_frames: float) -> None:
        """Takes a new sample of tracks from these views."""
        self.frame, self.xy, self.used = _sample(views, self.num_frames)
        count = np.maximum(self.used.sum(1), 1)
        middle = np.where(self.used, self.frame, 0).sum(1) / count
        self.block_frames = block_frames
        self.block = (middle / block_frames).astype(int)

    def in_pieces(self, span: int) -> "PathTest":
        """The test with tracks cut into pieces within intervals of `span` frames, each
        of which is a block."""
        views, cut = self.views, copy.copy(self)
        piece = views.landmark * (self.num_frames // span + 1) + views.frame // span
        cut._take(Views(views.frame, piece, views.xy), float(span))
        return cut

    def around(self, first: float, last: float) -> "PathTest":
        """The test with a sample of tracks within some frames only, which is denser."""
        within = (self.views.frame >= first) & (self.views.frame <= last)
        part = copy.copy(self)
        part._take(self.views[np.flatnonzero(within)], self.block_frames)
        return part

    def errors(
        self, T_WC: Float[np.ndarray, "t 4 4"], known: Bool[np.ndarray, " t"]
    ) -> Float[np.ndarray, "k v"]:
        """Reprojection errors, px, of the sample's points, each at the place where it
        fits best; NaN where the path does not test them."""
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
        """How well a pose for each frame, or for those in `known`, fits."""
        error = self.errors(T_WC, known)
        tested = ~np.isnan(error)
        share = float((error[tested] < self.threshold).mean()) if tested.any() else 0.0
        return Fit(
            share, int(tested.sum()), self.expected, self.required, self.threshold
        )

    def cost(self, error: Float[np.ndarray, "k v"]) -> Float[np.ndarray, "b 2"]:
        """Robust cost (Cauchy) and number of the tested observations of each block."""
        tested = ~np.isnan(error)
        cost = np.where(tested, np.log1p((error / self.noise) ** 2), 0.0)
        num = int(self.block.max()) + 1 if len(self.block) else 1
        sums = [np.bincount(self.block, a.sum(1), num) for a in (cost, tested)]
        return np.stack(sums, axis=1)


def mean_cost(cost: Float[np.ndarray, "b 2"]) -> float:
    """Mean cost of the tested observations; infinite if there are too few."""
    count = cost[:, 1].sum()
    return float(cost[:, 0].sum() / count) if count >= MIN_TESTED else float("inf")


def is_worse(one: Float[np.ndarray, "b 2"], other: Float[np.ndarray, "b 2"]) -> bool:
    """Whether the first of two costs is significantly larger: by the scatter of the
    difference between blocks of time that both test, or by its sign in them."""
    both = (one[:, 1] > 0) & (other[:, 1] > 0)
    if both.sum() < 2:
        return mean_cost(one) > mean_cost(other)
    a, b = one[both], other[both]
    difference = a[:, 0] / a[:, 1] - b[:, 0] / b[:, 1]
    # Blocks that both explain alike tell nothing.
    telling = np.abs(difference) > _SAME_COST
    weight, difference = np.minimum(a[:, 1], b[:, 1])[telling], difference[telling]
    num = len(difference)
    if num < 2:
        return False
    mean = (weight @ difference) / weight.sum()
    scatter = weight @ (difference - mean) ** 2 / weight.sum()
    error = np.sqrt(scatter / (num - 1)) + 1e-6
    chance = float(binom.sf((difference > 0).sum() - 1, num, 0.5))
    return bool(mean > 0 and (mean > _SIGNIFICANT * error or chance < _UNLIKELY))


def what_would_fit(
    test: PathTest, T_WC: Float[np.ndarray, "t 4 4"], known: Bool[np.ndarray, " t"]
) -> str | None:
    """How poses that do not fit are to be read so that they do; `None` if no way is
    known."""
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
        if fit.is_tested and fit.share >= 0.95 * fit.expected:
            return f"{100 * fit.share:.0f} % fit it {name}"
    return None


def _within(sigmas: float) -> float:
    """Probability that a two-dimensional normal error is shorter than `sigmas`."""
    return float(1 - np.exp(-(sigmas**2) / 2))


def _static_share(
    views: Views, focal: float, threshold: float, longer: int
) -> tuple[float, float]:
    """Share of observations that fit the best relative pose of two frames, and the
    noise of tracks (px), by pairs of frames between which points move.

    Args:
        threshold: px.
        longer: the image's longer side, px.
    """
    if not len(views.frame):
        return 1.0, _TRACK_NOISE
    first, last = int(views.frame.min()), int(views.frame.max())
    keyframes = choose_keyframes(views, first, last, 0.03 * longer / focal, 12)
    order = np.argsort(views.frame, kind="stable")
    frame = views.frame[order]
    of = lambda k: order[slice(*np.searchsorted(frame, [k, k + 1]))]
    pairs = list(zip(keyframes[:-1], keyframes[1:], strict=True))
    chosen = np.unique(np.linspace(0, len(pairs) - 1, 12).astype(int)) if pairs else []
    shares, noises = [], []
    for i in chosen:
        one, other = of(pairs[i][0]), of(pairs[i][1])
        _, a, b = np.intersect1d(
            views.landmark[one], views.landmark[other], return_indices=True
        )
        if len(a) < 20:
            continue
        xy = views.xy[one[a]], views.xy[other[b]]
        pose = relative_pose(*xy, 1 / focal)
        if pose is None:
            continue
        away = _sampson(*xy, pose[0], pose[1]) * focal
        good = away < threshold
        shares.append(good.mean())
        # 0.6745: the median of a normal error's size.
        noises.append(np.median(away[good]) / 0.6745 if good.any() else _TRACK_NOISE)
    if not shares:
        return 1.0, _TRACK_NOISE
    return float(np.median(shares)), float(np.median(noises))


def _sampson(xy_a, xy_b, R: np.ndarray, t: np.ndarray) -> Float[np.ndarray, " n"]:
    """Distance of pairs of points from the epipolar geometry of R_BA and t, at depth
    1, as an error of each of the two points."""
    cross = np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])
    E = cross @ R
    one = np.ones((len(xy_a), 1))
    a, b = np.hstack([xy_a, one]), np.hstack([xy_b, one])
    Ea, Etb = a @ E.T, b @ E
    size = np.sqrt((Ea[:, :2] ** 2).sum(1) + (Etb[:, :2] ** 2).sum(1))
    return np.abs((b * Ea).sum(1)) / np.maximum(size, 1e-12)


def _sample(
    views: Views, num_frames: int
) -> tuple[Int[np.ndarray, "k v"], Float[np.ndarray, "k v 2"], Bool[np.ndarray, "k v"]]:
    """Up to `_MAX_TRACKS` of the longest tracks, spread over the video, in up to
    `_VIEWS_PER_TRACK` views each, which lie apart evenly."""
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
    """Reprojection errors at depth 1 of points in front of the cameras that fit best.

    A point is x, y at depth 1 and the inverse depth in its middle view, so that one
    without parallax is at infinity; robust Gauss--Newton (Cauchy, `scale`).
    """
    num, most = use.shape
    # The view nearest to the middle of those that are used.
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
    for turn in range(_ITERATIONS):
        if turn >= _ITERATIONS // 2:  # behind infinity no point is seen
            point[:, 2] = np.maximum(point[:, 2], 0.0)
        ray = np.concatenate([point[:, :2], np.ones((num, 1))], axis=1)
        p = (R @ ray[:, None, :, None])[..., 0] + point[:, None, 2:] * t
        front = p[..., 2] > 0.05
        z = np.where(front, p[..., 2], 0.05)[..., None]
        predicted = p[..., :2] / z
        away = xy - predicted
        error = np.where(front, np.linalg.norm(away, axis=-1), _BEHIND)
        if turn == _ITERATIONS - 1:
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
        if turn >= _ITERATIONS // 2:
            A[:, 2, 2] += np.where(point[:, 2] <= 0, 1e12, 0.0)
        step = np.linalg.solve(A, b[..., None])[..., 0]
        # A step of the inverse depth to behind a camera would not come back.
        point = point + np.clip(step, -2.0, 2.0)
    return error
