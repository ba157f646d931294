"""Cadence and step length of a walk, and whether the frame rate is plausible for them.

In walking, step length over cadence (the walk ratio) is about constant at all speeds:
0.0065 m per step a minute (Sekiya et al., 1997). In leg lengths L, with time in units
of sqrt(L / g), it distinguishes slow motion from a slow walk: slow motion by a factor k
keeps the step length and multiplies the walk ratio by k.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.arrays import runs
from bodyslam_jax.types import Result

_GRAVITY_M_S2 = 9.81
"""Standard gravity."""
_UP = np.array([0.0, 1.0, 0.0])
_HORIZONTAL_AXES = [0, 2]
_LEG_JOINTS = ([1, 4, 7], [2, 5, 8])
"""Hip, knee and ankle of either side."""
_WALK_RATIO = 1.7
"""Dimensionless walk ratio, the median of 85 walks and runs of the CMU archive, of
which nine of ten have 1.4 to 2.2."""
WALK_RATIO_SPREAD = 0.14
"""Standard deviation of the logarithm of the walk ratio: half of log(2.2 / 1.4), which
nine of ten are within, over 1.645."""
_SLOW_MOTION_FACTOR = 1.6
"""Ratio of the walk ratio to the usual one from which a walk is slow motion: two of
those 85 exceed it, with strides that are exaggerated on purpose."""
_MAX_WALKING_CADENCE_HZ = 2.6
"""Cadence that no walk exceeds, steps per second."""
_MIN_WALKING_CADENCE_HZ = 1.2
"""Cadence below that of usual walks, steps per second: of 76 walks and runs of the CMU
archive one has less (0.97), the next 1.28."""
_MIN_STRIDES = 1.5
"""Number of strides (two steps each) from which a stretch is analysed."""
_MIN_PEAK_CORRELATION, _MIN_PERIOD_CORRELATION = 0.2, 0.6
"""Autocorrelation from which a lag is a candidate for the period, and from which the
first candidate is accepted."""
MIN_STEP_LEGS = 0.35
"""Step length from which the frame rate is judged, and regular steps are a walk at any
speed, leg lengths."""


@dataclasses.dataclass(frozen=True)
class Gait:
    """Regular gait of one person: cadence, step length, leg length and reach."""

    frequency: float
    """Cadence, steps per second."""
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
        """Walk ratio divided by the usual one: the factor by which the motion is too
        slow.

        It is proportional to the frame interval, and to the inverse root of scale.
        """
        swing = self.frequency * np.sqrt(self.leg / _GRAVITY_M_S2)
        return float(self.step / swing / _WALK_RATIO)

    def is_slow_motion(self, unsure: float = 0.0) -> bool:
        """Returns whether the walk is implausibly slow even if lengths are
        overestimated by the relative error `unsure`."""
        return self.strides and self.slowness > _SLOW_MOTION_FACTOR * (1 + unsure)

    @property
    def strides(self) -> bool:
        """Whether the steps are long enough to judge the frame rate by them."""
        return self.step > MIN_STEP_LEGS

    def has_low_cadence(self) -> bool:
        """Returns whether the cadence is below that of nearly all walks, at any
        scale."""
        return self.strides and self.frequency < _MIN_WALKING_CADENCE_HZ

    def is_fast_motion(self, unsure: float = 0.0) -> bool:
        """Returns whether the walk is implausibly fast even if lengths are
        underestimated by the relative error `unsure`."""
        quick = self.slowness * _SLOW_MOTION_FACTOR * (1 + unsure) < 1
        return self.strides and quick and self.frequency > _MAX_WALKING_CADENCE_HZ


def gait(result: Result, person: int) -> Gait | None:
    """Returns a person's gait in the longest stretch of frames in which they are
    present.

    `None` where the legs do not swing for at least one and a half strides.
    """
    stretches = runs(result.present[person])
    if not stretches:
        return None
    run = max(stretches, key=lambda run: run.stop - run.start)
    ahead = so3.exp(result.poses[person, run, :3])[:, :, 2]
    return _steps(result.joints[person, run], ahead, result.fps)


def gait_of_joints(joints: Float[np.ndarray, "t 24 3"], fps: float) -> Gait | None:
    """Returns the gait of joint positions in m, y up.

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
    bones = [np.diff(joints[:, leg], axis=1) for leg in _LEG_JOINTS]
    leg = float(np.linalg.norm(bones, axis=-1).sum(axis=-1).mean())
    frequency = 2 * fps / period
    place = joints[:, 0, _HORIZONTAL_AXES]
    gone = np.linalg.norm(place[period:] - place[:-period], axis=1).mean()
    reach = float(np.ptp(np.percentile(spread, [5, 95])) / 2)
    return Gait(frequency, float(gone / 2 / leg), leg, reach / leg)


def _spread(
    joints: Float[np.ndarray, "t 24 3"], ahead: Float[np.ndarray, "t 3"]
) -> Float[np.ndarray, " t"]:
    """Returns the distance along the ground by which the left ankle is ahead of the
    right, m."""
    ahead = ahead - (ahead @ _UP)[:, None] * _UP
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    return ((joints[:, 7] - joints[:, 8]) * ahead).sum(axis=1)


def _period(signal: Float[np.ndarray, " t"]) -> int | None:
    """Returns the period of a signal in frames, by the first peak of its
    autocorrelation, or `None` if that is low."""
    t = len(signal)
    signal = signal - signal.mean()
    longest = int(t / _MIN_STRIDES)
    if t < 8 or signal.std() < 1e-9:
        return None
    like = np.correlate(signal, signal, "full")[t - 1 :] / np.arange(t, 0, -1)
    like = like[: longest + 1] / like[0]
    peaks = 1 + np.flatnonzero((like[1:-1] > like[:-2]) & (like[1:-1] >= like[2:]))
    peaks = peaks[peaks > np.argmax(like < 0)] if (like < 0).any() else peaks[:0]
    peaks = peaks[like[peaks] > _MIN_PEAK_CORRELATION]
    return (
        int(peaks[0])
        if len(peaks) and like[peaks[0]] > _MIN_PERIOD_CORRELATION
        else None
    )
