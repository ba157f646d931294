"""The offset of one clock of a given camera path from the video's, by tracks.

The offset is the one at which the tracks fit the path best (`given_path.PathTest`). Its
standard deviation is that of the jackknife over blocks of time, because errors of
neighbouring frames are correlated.
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.io.camera.path import at_times, usual_step
from bodyslam_jax.sfm.given_path import (
    MIN_TESTED_OBSERVATIONS,
    MIN_VIEWS,
    PathTest,
    is_worse,
    mean_cost,
)
from bodyslam_jax.types import CameraPath, PathClock

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
