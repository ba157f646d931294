"""Gait: cadence and step length, and whether the frame rate is plausible for them.

In walking, step length over cadence (the walk ratio) is about constant at all speeds:
0.0065 m per step a minute (Sekiya et al., 1997). In leg lengths L, with time in units
of sqrt(L / g), it distinguishes slow motion from a slow walk: slow motion by a factor k
keeps the step length and multiplies the walk ratio by k.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.runs import runs
from bodyslam_jax.types import Result

_GRAVITY = 9.81
_UP = np.array([0.0, 1.0, 0.0])
_PLAN = [0, 2]
_LEGS = ([1, 4, 7], [2, 5, 8])
"""Hip, knee and ankle of either side."""
_WALK_RATIO = 1.7
"""Dimensionless walk ratio, the median of 85 walks and runs of the CMU archive, of
which nine of ten have 1.4 to 2.2."""
WALK_RATIO_SPREAD = 0.14
"""Standard deviation of the logarithm of the walk ratio: half of log(2.2 / 1.4), which
nine of ten are within, over 1.645."""
_SLOW = 1.6
"""Factor on the walk ratio from which it is slow motion: of those 85 two exceed it,
with strides that are exaggerated on purpose."""
_OFTEN = 2.6
"""Cadence that exceeds any walk, steps a second."""
_SELDOM = 1.2
"""Cadence below any usual walk, steps a second: of 76 walks and runs of the CMU archive
one has less (0.97), the next 1.28."""
_STRIDES = 1.5
"""Least number of strides (two steps each) in a stretch."""
_ALIKE, _REGULAR = 0.2, 0.6
"""Autocorrelation of a candidate for the period, and of an accepted one."""
_STEP = 0.35
"""Step length, in leg lengths, below which the frame rate is not judged."""


@dataclasses.dataclass(frozen=True)
class Gait:
    """A person's steps, where the legs swing regularly."""

    frequency: float
    """Steps a second."""
    step: float
    """Step length, in lengths of the leg from hip to ankle."""
    leg: float
    """Length of the leg, m."""
    reach: float = float("nan")
    """Distance by which the leading foot is ahead of the other, in leg lengths."""

    @property
    def step_over_reach(self) -> float:
        """Step length over reach, dimensionless and independent of the frame rate.

        It is 1 to 1.25 in walking, 1.6 to 1.9 in running, where both feet leave the
        ground, 0 on a treadmill, and larger than in any walk on a moving walkway.
        """
        return self.step / self.reach

    @property
    def slowness(self) -> float:
        """Walk ratio over the usual one: the factor by which the motion is too slow.

        It is proportional to the frame interval, and to the inverse root of scale.
        """
        swing = self.frequency * np.sqrt(self.leg / _GRAVITY)
        return float(self.step / swing / _WALK_RATIO)

    def is_slow_motion(self, unsure: float = 0.0) -> bool:
        """Whether the walk is implausibly slow, even if lengths are too large by the
        relative error `unsure`."""
        return self.strides and self.slowness > _SLOW * (1 + unsure)

    @property
    def strides(self) -> bool:
        """Whether steps are long enough that the frame rate can be judged by them."""
        return self.step > _STEP

    def has_low_cadence(self) -> bool:
        """Whether steps are taken more rarely than in nearly all walks, whatever the
        scale."""
        return self.strides and self.frequency < _SELDOM

    def is_fast_motion(self, unsure: float = 0.0) -> bool:
        """Whether the walk is implausibly quick, even if lengths are too small by the
        relative error `unsure`."""
        quick = self.slowness * _SLOW * (1 + unsure) < 1
        return self.strides and quick and self.frequency > _OFTEN


def gait(result: Result, person: int) -> Gait | None:
    """A person's gait in the longest stretch in which they are present.

    `None` where the legs do not swing for at least one and a half strides.
    """
    stretches = runs(result.present[person])
    if not stretches:
        return None
    run = max(stretches, key=lambda run: run.stop - run.start)
    ahead = so3.exp(result.poses[person, run, :3])[:, :, 2]
    return _steps(result.joints[person, run], ahead, result.fps)


def gait_of_joints(joints: Float[np.ndarray, "t 24 3"], fps: float) -> Gait | None:
    """The gait of joints in m, y up.

    Forward is perpendicular to the line from the right hip to the left one. `None` as
    for `gait`.
    """
    return _steps(joints, np.cross(joints[:, 1] - joints[:, 2], _UP), fps)


def _steps(
    joints: Float[np.ndarray, "t 24 3"], ahead: Float[np.ndarray, "t 3"], fps: float
) -> Gait | None:
    spread = _spread(joints, ahead)
    period = _period(spread)
    if period is None:
        return None
    bones = [np.diff(joints[:, leg], axis=1) for leg in _LEGS]
    leg = float(np.linalg.norm(bones, axis=-1).sum(axis=-1).mean())
    frequency = 2 * fps / period
    place = joints[:, 0, _PLAN]
    gone = np.linalg.norm(place[period:] - place[:-period], axis=1).mean()
    reach = float(np.ptp(np.percentile(spread, [5, 95])) / 2)
    return Gait(frequency, float(gone / 2 / leg), leg, reach / leg)


def _spread(
    joints: Float[np.ndarray, "t 24 3"], ahead: Float[np.ndarray, "t 3"]
) -> Float[np.ndarray, " t"]:
    """Distance along the ground by which the left ankle is ahead of the right, m."""
    ahead = ahead - (ahead @ _UP)[:, None] * _UP
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    return ((joints[:, 7] - joints[:, 8]) * ahead).sum(axis=1)


def _period(signal: Float[np.ndarray, " t"]) -> int | None:
    """Period of a signal in frames, by the first peak of its autocorrelation; `None`
    where that is low."""
    t = len(signal)
    signal = signal - signal.mean()
    longest = int(t / _STRIDES)
    if t < 8 or signal.std() < 1e-9:
        return None
    like = np.correlate(signal, signal, "full")[t - 1 :] / np.arange(t, 0, -1)
    like = like[: longest + 1] / like[0]
    peaks = 1 + np.flatnonzero((like[1:-1] > like[:-2]) & (like[1:-1] >= like[2:]))
    peaks = peaks[peaks > np.argmax(like < 0)] if (like < 0).any() else peaks[:0]
    peaks = peaks[like[peaks] > _ALIKE]
    return int(peaks[0]) if len(peaks) and like[peaks[0]] > _REGULAR else None
