"""Converts a given camera path to the clock of the video, by tracks.

Where the times of a path are not those of the video, each reading of them (`PathClock`)
is tried with its best offset, and the reading that fits best is taken; one that fits no
better than another is rejected. A guessed focal length is corrected with the clock.

The offset is the one at which the tracks fit the path best (`given_path.PathTest`). Its
standard deviation is that of the jackknife over blocks of time, because errors of
neighbouring frames are correlated.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.io.camera.path import at_times, usual_step
from bodyslam_jax.sfm.given_path import (
    MIN_EXPECTED_SHARE,
    MIN_TESTED_OBSERVATIONS,
    MIN_VIEWS,
    PathTest,
    is_worse,
    mean_cost,
)
from bodyslam_jax.types import CameraPath, Intrinsics, PathClock, Tracks

_LOCAL_FRAMES = 15
"""Number of frames before and after the given time within which other offsets of a path
on the video's own clock are tried."""
_MAX_ASSUMED_RATE_ERROR = 0.05
"""Largest relative difference of rates at which a tracker may have assumed another
frame rate than the video's without any part of the path showing it."""
_FOCAL_FACTORS = (0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.35, 1.5)
"""Factors on a guessed focal length with which a path is tried: fields of view from 31
to 70 degrees around the guess of 45 degrees."""
MAX_OFFSETS = 1500
"""Largest number of offsets of the coarse search, in steps of a frame, or of several in
long videos."""
_MIN_OVERLAP = 0.5
"""Least share of the shorter of path and video that lies within the other."""
SIGNIFICANCE_SIGMAS = 3.0
"""Number of standard errors beyond which two offsets differ."""
MAX_WHOLE_RATE_ERROR = 0.005
"""Largest relative difference of a path's step from a whole number of frames, for a
path that was made from the frames of this video."""
_NUM_PHASES = 4
"""Number of offsets per frame in the refinement."""
_NOISE_EFFECT = 0.02
"""Least decrease of the cost by smoother poses, as a share of its rise over a frame, at
which the noise of the path makes the cost depend on the phase of poses and frames."""
_SAME_PATH_TOLERANCES = 0.05, 0.02
"""Largest RMS difference of positions, relative to the path's extent, and of rotations
(rad), at which offsets that fit equally well give the same path."""


@dataclasses.dataclass(frozen=True)
class ClockOffset:
    """A clock with its offset."""

    clock: PathClock
    times: Float[np.ndarray, " n"]
    """Times of the poses on the video's clock, s."""
    sigma: float
    """Standard deviation of the offset, s."""
    is_given: bool = False
    """True if the times are those in the file."""


class OffsetSearch:
    """Tests offsets of one path against one sample of tracks."""

    def __init__(
        self,
        test: PathTest,
        poses: Float[np.ndarray, "n 4 4"],
        timestamps: Float[np.ndarray, " t"],
    ):
        self.test, self.poses, self.timestamps = test, poses, timestamps
        self.period = usual_step(timestamps)

    def path(self, times: Float[np.ndarray, " n"], path: CameraPath) -> CameraPath:
        """Returns the path with its poses at `times` of the video's clock."""
        T_WC, known = at_times(times, self.poses, self.timestamps)
        return dataclasses.replace(path, T_WC=T_WC, known=known, poses=None, clocks=())

    def costs(self, times: Float[np.ndarray, " n"]) -> Float[np.ndarray, "b 2"]:
        """Returns `PathTest.cost` with the poses at `times`."""
        T_WC, known = at_times(times, self.poses, self.timestamps)
        return self.test.cost(self.test.errors(T_WC, known))

    def offsets(self, times: Float[np.ndarray, " n"]) -> Float[np.ndarray, " d"]:
        """Returns offsets, s, by whole frames, with enough
        overlap of path and video."""
        start, end = self.timestamps[0], self.timestamps[-1]
        length = min(times[-1] - times[0], end - start)
        shortest = max(_MIN_OVERLAP * length, MIN_VIEWS * self.period)
        low = start + shortest - times[-1]
        high = end - shortest - times[0]
        step = max(1, int((high - low) / self.period / MAX_OFFSETS) + 1) * self.period
        # The grid contains the offset at which the first frame and pose coincide.
        first = np.ceil((low - (start - times[0])) / step)
        last = np.floor((high - (start - times[0])) / step)
        return start - times[0] + step * np.arange(first, last + 1)

    def profile(
        self, times: Float[np.ndarray, " n"], offsets: Float[np.ndarray, " d"]
    ) -> Float[np.ndarray, "d b 2"]:
        return np.stack([self.costs(times + offset) for offset in offsets])

    def refined(
        self, times: Float[np.ndarray, " n"], offset: float
    ) -> tuple[float, float]:
        """Returns the offset of least cost near `offset`, and its sigma, both in s.

        Interpolation between poses averages their noise, most in the middle between
        two, so that the cost of a noisy path also depends on the phase of frames and
        poses: then a parabola plus a constant for each phase is fitted, else a narrow
        parabola.
        """
        phases = np.arange(-2 * _NUM_PHASES, 2 * _NUM_PHASES + 1)
        one = np.zeros(len(phases), int)
        at = offset + phases * self.period / _NUM_PHASES
        profile = self.profile(times, at)
        if self._is_noisy(times + _minimum(at, profile, one)[0]):
            offset, sigma = _minimum(at, profile, phases % _NUM_PHASES)
        else:
            offset, sigma = _minimum(at, profile, one)
            for step in (0.25, 0.1):
                at = offset + step * self.period * np.arange(-4, 5)
                offset, sigma = _minimum(at, self.profile(times, at), one[:9])
        # Exposure and readout limit the accuracy to a hundredth of a frame.
        return offset, max(sigma, 0.01 * self.period)

    def _is_noisy(self, times: Float[np.ndarray, " n"]) -> bool:
        """Returns True if averaging each pose with its neighbours lowers the cost, by
        more than a small share of its rise over an offset of one frame."""
        T_WC = self.poses.copy()
        T_WC[1:-1] = (self.poses[:-2] + 2 * self.poses[1:-1] + self.poses[2:]) / 4
        U, _, Vt = np.linalg.svd(T_WC[:, :3, :3])
        T_WC[:, :3, :3] = U @ Vt
        smooth = OffsetSearch(self.test, T_WC, self.timestamps)
        here = mean_cost(self.costs(times))
        rise = mean_cost(self.costs(times + self.period)) - here
        return here - mean_cost(smooth.costs(times)) > _NOISE_EFFECT * max(rise, 0.0)

    def equally_good(
        self, found: ClockOffset
    ) -> tuple[ClockOffset, tuple[float, float] | None, bool]:
        """Looks for other offsets that fit as well as the one found.

        Returns the one of them with poses for most points, the range of the times (s)
        of the first pose (`None` if the offset is unique), and whether they all give
        the same path.
        """
        times = found.times
        offsets = self.offsets(times)
        offsets = offsets[np.abs(offsets) > max(3 * found.sigma, 1.5 * self.period)]
        here = self.costs(times)
        costs = {0.0: here} | {float(d): self.costs(times + d) for d in offsets}
        alike = [d for d in costs if d == 0.0 or not is_worse(costs[d], here)]
        if len(alike) == 1:
            return found, None, True
        best = max(alike, key=lambda d: (costs[d][:, 1].sum(), d == 0.0))
        range_ = times[0] + min(alike), times[0] + max(alike)
        same = [self._same(times + best, times + d) for d in alike if d != best]
        moved = dataclasses.replace(found, times=times + best)
        return moved, range_, all(one is not False for one in same) and any(same)

    def _same(self, one: np.ndarray, other: np.ndarray) -> bool | None:
        """Returns whether poses at two series of times give one path, up to a rigid
        motion; `None` if they have too few frames in common."""
        a, known_a = at_times(one, self.poses, self.timestamps)
        b, known_b = at_times(other, self.poses, self.timestamps)
        both = known_a & known_b
        if both.sum() < MIN_VIEWS:
            return None
        a, b = a[both], b[both]
        U, _, Vt = np.linalg.svd(
            np.einsum("tij,tkj->ik", a[:, :3, :3], b[:, :3, :3]), full_matrices=False
        )
        R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
        turned = so3.log(np.swapaxes(a[:, :3, :3], 1, 2) @ R @ b[:, :3, :3])
        centres = a[:, :3, 3] - a[:, :3, 3].mean(0)
        away = centres - (b[:, :3, 3] - b[:, :3, 3].mean(0)) @ R.T
        rms = lambda v: float(np.sqrt((v**2).sum(-1).mean()))
        extent = max(rms(centres), 1e-12)
        return (
            rms(away) < _SAME_PATH_TOLERANCES[0] * extent
            and rms(turned) < _SAME_PATH_TOLERANCES[1]
        )


@dataclasses.dataclass(frozen=True)
class Placed:
    """A path whose poses are on the clock of the video's frames."""

    path: CameraPath
    intrinsics: Intrinsics
    """Intrinsics, with the focal length that fits the path if it was a guess."""
    warnings: tuple[str, ...]


def place_in_time(
    path: CameraPath,
    tracks: Tracks,
    intrinsics: Intrinsics,
    timestamps: Float[np.ndarray, " t"],
) -> Placed:
    """Converts the poses of a path to the clock of the video, by the tracks.

    A path on the video's own clock is kept, unless another offset fits significantly
    better. For any other path the offset is estimated from the tracks.

    Args:
        timestamps: times of the frames, s.

    **Raises:** `InputError` if the clock is not the video's and its offset cannot be
    found.
    """
    if path.poses is None or not path.clocks or len(timestamps) < MIN_VIEWS:
        return Placed(path, intrinsics, ())
    test = PathTest(tracks, intrinsics, len(timestamps))
    most = int(test.used.sum())
    given = path.clocks[0]
    if most < MIN_TESTED_OBSERVATIONS:
        if given.is_videos:
            return Placed(path, intrinsics, ())
        raise InputError(
            f"camera path: its clock is not the video's ({given.name}), and {most} "
            f"observations of background points, expected {MIN_TESTED_OBSERVATIONS} or "
            "more, do not tell the offset: give its times in seconds from the video's "
            "first frame."
        )
    warnings: list[str] = []
    search = OffsetSearch(test, path.poses, timestamps)
    if intrinsics.is_guess:
        search, intrinsics, text = _with_best_focal(search, path, tracks, intrinsics)
        warnings += text
    found = _best_clock(search, path.clocks)
    if found is None:
        raise InputError(
            f"camera path: its clock is not the video's ({given.name}), and no offset "
            "leaves points to compare it with: give its times in seconds from the "
            "video's first frame."
        )
    placed = search.path(found.times, path)
    fit = search.test.fit(placed.T_WC, placed.known)
    if not given.is_videos and not fit.convinces:
        raise InputError(
            f"camera path: its clock is not the video's ({given.name}), and no offset "
            f"explains the images: {100 * fit.share:.0f} % of the points fit at best, "
            f"with its first pose at {found.times[0]:.2f} s, expected "
            f"{100 * fit.doubtful:.0f} % or more: poses of another video, from world "
            "to camera, with other axes or another focal length, or poses left out "
            "and not numbered?"
        )
    if found.is_given:
        return Placed(path, intrinsics, tuple(warnings))
    found, range_, same = search.equally_good(found)
    placed = search.path(found.times, path)
    fit = search.test.fit(placed.T_WC, placed.known)
    rate = 1 / search.period
    if range_ is not None:
        between = (
            f"first poses between {range_[0]:.2f} and {range_[1]:.2f} s fit the images "
            "equally well"
        )
        if not same and not given.is_videos:
            raise InputError(
                f"camera path: its clock is not the video's ({given.name}), and "
                f"{between} but give different paths: give its times in seconds from "
                "the video's first frame."
            )
        if not same or given.is_videos:
            return Placed(path, intrinsics, tuple(warnings))
        warnings.append(f"camera path: {between} and give the same path.")
    first = found.times[0] - timestamps[0]
    text = (
        f"camera path: {found.clock.name}; the tracks put its first pose at "
        f"{found.times[0]:.3f} ± {found.sigma:.3f} s (frame {first * rate:.1f}), where "
        f"{100 * fit.share:.0f} % of the points fit ({100 * fit.expected:.0f} % are "
        "expected)"
    )
    if given.is_videos:
        before = search.test.fit(path.T_WC, path.known)
        text += f" and not at {given.times[0]:.3f} s, where {100 * before.share:.0f} %"
    warnings.append(text + ".")
    said = given.is_videos and placed.known.sum() == path.known.sum()
    if not placed.known.all() and not said:
        count = f"{int(placed.known.sum())} of {len(timestamps)}"
        warnings.append(f"camera path: poses for {count} frames.")
    return Placed(placed, intrinsics, tuple(warnings))


def _best_clock(
    search: OffsetSearch, clocks: tuple[PathClock, ...]
) -> ClockOffset | None:
    """Returns the clock and offset that fit best; the given one if none fits better.

    Other clocks than the first are tried only if that one does not fit as expected, or
    if its rate is nearly, but not exactly, that of the frames.
    """
    given, kept, found = clocks[0], None, []
    if given.is_videos:
        kept = ClockOffset(given, given.times, 0.0, is_given=True)
        offsets = np.arange(-_LOCAL_FRAMES, _LOCAL_FRAMES + 1) * search.period
        near = best_offset(search, given, offsets)
        found.append(kept)
        if near is not None:
            shift = abs(near.times[0] - given.times[0])
            if shift > max(SIGNIFICANCE_SIGMAS * near.sigma, search.period / 4):
                found.append(near)
    else:
        found.append(best_offset(search, given, search.offsets(given.times)))
    best = _best_of(search, found)
    rate = abs(usual_step(given.times) / search.period - 1)
    if (
        best is None
        or MAX_WHOLE_RATE_ERROR < rate < _MAX_ASSUMED_RATE_ERROR
        or not _fits_as_expected(search, best)
    ):
        others = clocks if given.is_videos else clocks[1:]
        others = [c for c in others if len(search.offsets(c.times))]
        found = [
            best,
            *(best_offset(search, c, search.offsets(c.times)) for c in others),
        ]
        best = _best_of(search, found)
    if kept is not None and best is not None and not best.is_given:
        # The given times of a path are kept, unless others convince by themselves.
        fit = search.test.fit(*at_times(best.times, search.poses, search.timestamps))
        return best if fit.convinces else kept
    return best


def _best_of(
    search: OffsetSearch, found: list[ClockOffset | None]
) -> ClockOffset | None:
    """Returns the first clock that no later one fits significantly better than."""
    best, cost = None, np.zeros((0, 2))
    for one in found:
        if one is None:
            continue
        its = search.costs(one.times)
        if best is None or is_worse(cost, its):
            best, cost = one, its
    return best


def _fits_as_expected(search: OffsetSearch, found: ClockOffset) -> bool:
    """Returns True if as many points fit as with a correct path."""
    fit = search.test.fit(*at_times(found.times, search.poses, search.timestamps))
    return fit.is_tested and fit.share >= MIN_EXPECTED_SHARE * fit.expected


def _with_best_focal(
    search: OffsetSearch, path: CameraPath, tracks: Tracks, guess: Intrinsics
) -> tuple[OffsetSearch, Intrinsics, list[str]]:
    """Corrects a guessed focal length by the one with which the path fits best."""
    assert path.poses is not None
    clock = path.clocks[0]
    tries: list[tuple[float, float, OffsetSearch, Intrinsics]] = []
    for factor in _FOCAL_FACTORS:
        params = guess.params.copy()
        params[:2] *= factor
        camera = dataclasses.replace(guess, params=params)
        test = PathTest(tracks, camera, len(search.timestamps))
        other = OffsetSearch(test, path.poses, search.timestamps)
        offsets = np.zeros(1) if clock.is_videos else search.offsets(clock.times)
        profile = other.profile(clock.times, offsets)
        count = profile[..., 1].sum(1)
        mean = profile[..., 0].sum(1) / np.maximum(count, 1)
        mean[count < enough_observations(count)] = np.inf
        tries.append((float(mean.min()), abs(factor - 1), other, camera))
    best = min(tries, key=lambda one: one[:2])
    same = next(one for one in tries if one[1] == 0.0)
    if best is same or best[0] > 0.9 * same[0]:
        return search, guess, []
    text = (
        f"the camera path fits the images with a focal length of about "
        f"{best[3].params[0]:.0f} px, not with the guess of {guess.params[0]:.0f} px."
    )
    return best[2], best[3], [text]


def enough_observations(count: Float[np.ndarray, " d"]) -> float:
    """Returns the number of tested observations, of `count` at each offset, from which
    offsets are compared: with few, by chance any fits."""
    return max(MIN_TESTED_OBSERVATIONS, 0.3 * float(count.max()))


def best_offset(
    search: OffsetSearch, clock: PathClock, offsets: Float[np.ndarray, " d"]
) -> ClockOffset | None:
    """Returns the best of the offsets (s) of a clock, refined; `None` without one."""
    profile = search.profile(clock.times, offsets)
    count = profile[..., 1].sum(1)
    enough = count >= enough_observations(count)
    if not enough.any():
        return None
    mean = np.where(enough, profile[..., 0].sum(1) / np.maximum(count, 1), np.inf)
    offset, sigma = search.refined(clock.times, float(offsets[int(np.argmin(mean))]))
    rate = usual_step(clock.times) / search.period
    if abs(rate / max(round(rate), 1) - 1) < MAX_WHOLE_RATE_ERROR:
        # The path was made from the frames of this video: poses are at whole frames.
        first = (clock.times[0] + offset - search.timestamps[0]) / search.period
        moved = (round(first) - first) * search.period
        if abs(moved) < max(SIGNIFICANCE_SIGMAS * sigma, 0.05 * search.period):
            offset += moved
    return ClockOffset(clock, clock.times + offset, sigma)


def _minimum(
    at: Float[np.ndarray, " d"],
    profile: Float[np.ndarray, "d b 2"],
    phase: Int[np.ndarray, " d"],
) -> tuple[float, float]:
    """Returns the offset of least cost by a parabola, and its sigma by
    the jackknife over blocks.

    Args:
        phase: index of the phase of each offset; each phase has its own constant.
    """
    parts = np.flatnonzero(profile[..., 1].min(0) > 0)
    total = profile.sum(1)
    left = total[:, None] - profile[:, parts]
    left = left[:, left[..., 1].min(0) > 0].swapaxes(0, 1)
    centre, half = at.mean(), (at[-1] - at[0]) / 2
    x = (at - centre) / half
    constants = phase[:, None] == np.unique(phase)
    A = np.column_stack([x**2, x, constants])

    def fitted(cost: Float[np.ndarray, "d 2"]) -> float:
        mean = cost[:, 0] / np.maximum(cost[:, 1], 1)
        # Offsets near the minimum have most weight: the cost is a parabola there.
        weight = 1 / (1 + ((mean - mean.min()) / (np.ptp(mean) / 4 + 1e-12)) ** 2)
        root = np.sqrt(weight)[:, None]
        found = np.linalg.lstsq(A * root, mean * root[:, 0], rcond=None)[0]
        if found[0] <= 0:
            return float(at[int(np.argmin(mean))])
        return float(centre + half * np.clip(-found[1] / (2 * found[0]), -1, 1))

    best = fitted(total)
    if len(left) < 2:
        return best, float(half)
    each = np.array([fitted(one) for one in left])
    count = len(each)
    spread = ((each - each.mean()) ** 2).sum()
    return best, float(np.sqrt((count - 1) / count * spread))
