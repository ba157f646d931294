"""Estimates the shift and ratio of frame rates between keypoints and bodies.

People move, so keypoints of a frame fit the bodies of the same time better than those
of its neighbours. Shifts and ratios of frame rates are searched for the best fit.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from bodyslam_jax.diagnostics.agreement.explanations import disagreement, evenly
from bodyslam_jax.diagnostics.agreement.image_points import (
    People,
    distances,
    have_points,
    project,
)

_FRAME_STEPS = (2, 3, 4, 5, 6, 8, 10)
"""Values of n that are tested for the hypothesis that every n-th frame was processed
and renumbered."""
_FRAME_RATE_RATIOS = (24 / 25, 24 / 30, 25 / 30, 24 / 60, 25 / 60, 30 / 50, 24 / 50)
"""Ratios of frame rates between which videos are commonly converted."""
_MAX_SHIFT_FRAMES = 90
"""Largest shift that is tested."""
_SAMPLE_FRAMES = 50
"""Number of frames that are compared."""
_MIN_COMPARED_FRAMES = 8
_SHIFT_PENALTY, _RATE_PENALTY = 2e-4, 0.003
"""Penalties, in sizes of a person, per frame of a shift, and on ratios of rates that
are not integers: among equal fits the simplest is chosen."""

_INTEGER_RATIO_TOLERANCE, _INTEGER_RATIO_MARGIN = 0.06, 0.01


@dataclasses.dataclass(frozen=True)
class Timing:
    """Maps frame k of the keypoints to frame `rate * k + shift` of the bodies."""

    rate: float = 1.0
    shift: int = 0
    disagreement: float = np.nan
    """Distance at this timing (`explanations.disagreement`)."""
    better: float = 0.0
    """Share of frames in which the distance is smaller than at the given timing."""

    def __call__(self, frame: np.ndarray) -> np.ndarray:
        return np.round(self.rate * frame + self.shift + 1e-9).astype(int)

    @property
    def step(self) -> int:
        """The n if every n-th frame was processed: positive for keypoints, negative for
        bodies, 0 if the ratio of rates is no such integer."""
        for n in _FRAME_STEPS:
            if self.shift == 0 and self.rate in (n, 1 / n):
                return n if self.rate > 1 else -n
        return 0


def best_timing(people: People) -> tuple[Timing, Timing]:
    """Returns the given timing, and the one at which bodies and keypoints fit best."""
    projected = project(people.camera, people.bodies)
    (where,) = np.nonzero(have_points(people.keypoints).any(1))
    pairs = people.keypoints.shape[1] * projected.shape[1]
    where = evenly(
        where,
        max(_SAMPLE_FRAMES // 3, min(_SAMPLE_FRAMES, 4 * _SAMPLE_FRAMES // pairs)),
    )
    given = _fit(people.keypoints[where], projected, where, Timing(), 3)
    reach = min(_MAX_SHIFT_FRAMES, len(projected) // 3)
    tries = [Timing(shift=d) for d in range(-reach, reach + 1) if d]
    ratios = [*map(float, _FRAME_STEPS), *_FRAME_RATE_RATIOS]
    ends = [
        int(np.flatnonzero(have_points(p).any(1))[-1])
        for p in (people.keypoints, people.bodies)
    ]
    for rate in (r for a in ratios for r in (a, 1 / a)):
        # A renumbered kind ends early enough to fit into the video when put back.
        last = ends[0] * rate if rate > 1 else ends[1] / rate
        if last < len(projected) + max(rate, 1 / rate):
            tries.append(Timing(rate=rate))
    found = [
        _fit(people.keypoints[where], projected, where, t, _MIN_COMPARED_FRAMES)
        for t in tries
    ]
    best = min((given, *found), key=_cost)
    if best.rate != 1:
        # A rate close to an integer ratio fits nearly as well, and is less likely.
        steps = [
            t
            for t in found
            if t.step and abs(t.rate / best.rate - 1) < _INTEGER_RATIO_TOLERANCE
        ]
        steps = [
            t
            for t in steps
            if t.disagreement < best.disagreement + _INTEGER_RATIO_MARGIN
        ]
        best = min(steps, key=_cost, default=best)
    if best.rate == 1 and best.shift:
        share = _share_better(people.keypoints, projected, best.shift)
        best = dataclasses.replace(best, better=share)
    return given, best


def _share_better(detected, projected, shift: int) -> float:
    """Returns the share of frames that fit better at `shift`, among those with bodies
    at both timings."""
    frame = np.arange(len(projected))
    frame = frame[(frame + shift >= 0) & (frame + shift < len(projected))]
    nearest = []
    for at in (frame, frame + shift):
        apart = distances(detected[frame], projected[at])
        nearest.append(np.where(np.isfinite(apart), apart, np.inf).min((1, 2)))
    both = np.isfinite(nearest).all(0)
    return float((nearest[1] < nearest[0])[both].mean()) if both.any() else 0.0


def _cost(timing: Timing) -> float:
    odd = timing.rate != 1 and not timing.step
    return (
        timing.disagreement + _SHIFT_PENALTY * abs(timing.shift) + _RATE_PENALTY * odd
    )


def _fit(
    detected: Float[np.ndarray, "s k 14 2"],
    projected: Float[np.ndarray, "t b 14 2"],
    where: np.ndarray,
    timing: Timing,
    fewest: int,
) -> Timing:
    at = timing(where)
    inside = (at >= 0) & (at < len(projected))
    inside[inside] = have_points(projected[at[inside]]).any(1)
    if inside.sum() < max(fewest, 0.3 * len(where)):
        return dataclasses.replace(timing, disagreement=np.inf)
    value = disagreement(detected[inside], projected[at[inside]])
    value = value if np.isfinite(value) else np.inf
    return dataclasses.replace(timing, disagreement=value)
