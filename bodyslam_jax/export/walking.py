"""How people walk: how often they step and how far, and whether time runs as it should.

Somebody who walks takes longer steps the faster they are, and more of them, so that the
step's length over its frequency is about the same at every speed: 0.0065 m per step a
minute (Sekiya et al., 1997). In lengths of the leg, with the time in which one swings
(sqrt(L / g)), it tells slow motion from a slow walk: slow motion by k leaves steps as
long as they are and makes it k times as much.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from bodyslam_jax.export.folder import frame_rate
from bodyslam_jax.export.statistics import runs
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.types import Result

_GRAVITY = 9.81
_UP = np.array([0.0, 1.0, 0.0])
_PLAN = [0, 2]
_LEGS = ([1, 4, 7], [2, 5, 8])
"""Hip, knee and ankle of either side."""
_WALK_RATIO = 1.7
"""Step's length over its frequency, in legs and swings of the leg: the median of 85
walks and runs of the CMU archive, of which nine of ten have 1.4 to 2.2."""
_SLOW = 1.6
"""How many times that much makes it slow motion: of those 85 only two have as much,
with strides that are exaggerated on purpose."""
_OFTEN = 2.6
"""Steps a second, more than of any walk."""
_STRIDES = 1.5
"""Of two steps each: how many must be seen."""
_ALIKE, _REGULAR = 0.2, 0.6
"""Correlations: what may be the next stride, and how much it must be like this one."""
_STEP = 0.35
"""Legs: who takes shorter steps need not be walking."""


@dataclasses.dataclass(frozen=True)
class Gait:
    """A person's steps, where their legs swing to and fro regularly."""

    frequency: float
    """Steps a second."""
    step: float
    """How far one goes, in lengths of the leg from hip to ankle."""
    leg: float
    """That length, m."""
    reach: float = float("nan")
    """How far the foot that steps is ahead of the other, in the same lengths."""

    @property
    def step_over_reach(self) -> float:
        """How far a step carries the person, over how far it reaches.

        Without unit, and the same at any frame rate: 1 to 1.25 of who walks, 1.6 to
        1.9 of who runs, as both feet leave the ground. On a treadmill it is 0, and on
        a moving walkway more than of any walk.
        """
        return self.step / self.reach

    @property
    def slowness(self) -> float:
        """How many times as fast as seen people take such steps; 1 is usual.

        Scale has little to say in it (its square root), and the frame rate all.
        """
        swing = self.frequency * np.sqrt(self.leg / _GRAVITY)
        return float(self.step / swing / _WALK_RATIO)

    def is_slow_motion(self, unsure: float = 0.0) -> bool:
        """Whether nobody walks like that unless on purpose, even if steps are shorter
        by `unsure`, the share by which metres may be off."""
        return self.step > _STEP and self.slowness > _SLOW * (1 + unsure)

    def is_fast_motion(self, unsure: float = 0.0) -> bool:
        """Whether nobody steps so often who steps so far, even if steps are longer by
        `unsure`, the share by which metres may be off."""
        quick = self.slowness * _SLOW * (1 + unsure) < 1
        return self.step > _STEP and quick and self.frequency > _OFTEN


def gait(result: Result, person: int) -> Gait | None:
    """How a person walks in the longest stretch in which they are there.

    `None` where the legs do not swing to and fro at least one and a half times.
    """
    stretches = runs(result.present[person])
    if not stretches:
        return None
    run = max(stretches, key=lambda run: run.stop - run.start)
    ahead = so3.exp(result.poses[person, run, :3])[:, :, 2]
    return _steps(result.joints[person, run], ahead, frame_rate(result))


def gait_of_joints(joints: Float[np.ndarray, "t 24 3"], fps: float) -> Gait | None:
    """How somebody walks of whom only the joints are known, m, y up.

    Forward is at right angles to the line from the right hip to the left one. `None`
    as for `gait`.
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
    """How far the left ankle is before the right one, along the ground, m."""
    ahead = ahead - (ahead @ _UP)[:, None] * _UP
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    return ((joints[:, 7] - joints[:, 8]) * ahead).sum(axis=1)


def _period(signal: Float[np.ndarray, " t"]) -> int | None:
    """Frames after which a signal is like itself, by its autocorrelation, for the first
    time; `None` where it is not much like itself then."""
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
