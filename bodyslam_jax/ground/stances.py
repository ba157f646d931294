"""Stances and flight: frames in which a foot is on the ground, or no foot can be.

A foot stands while its toe joint is slow. Positions of feet are those of toe joints, m.

Postures alone do not distinguish a jump from a stance: a network that sees nothing else
classifies up to half of the frames of a recorded jump as standing. In flight the centre
of mass, and approximately the pelvis, accelerates downwards by 9.8 m/s²; the pelvis of
a walker accelerates by at most 3 m/s².
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from bodyslam_jax.geometry.arrays import runs

_MAX_STANCE_SPEED_MPS = 0.6
"""Speed below which the lower foot counts as standing, m/s: assumes that toe joints err
by well below 6 cm over `_SPEED_WINDOW_S`."""
_SPEED_WINDOW_S = 0.1
"""Interval over which the speed of a foot is measured, s, so that the noise of single
frames averages out."""
_MIN_STANCE_S = 0.1
"""Least duration of a stance, s."""
_MIN_CONTACT_PROBABILITY = 0.7
"""Contact probability above which a toe counts as standing, for gravity and floor."""
_MIN_FALL_ACCELERATION_MPS2 = 6.0
"""Downward acceleration above which nothing supports a person, m/s². It detects 41 of
49 flight frames of recorded jumps, and no other frame (`benchmarks/bench_jumps.py`)."""
_FALL_WINDOW_S = 0.2
"""Interval over which the acceleration is measured, s. Position errors of 1 cm cause
errors of 2 m/s²."""


def standing_feet(
    feet: Float[np.ndarray, "t 2 3"], up: Float[np.ndarray, " 3"], fps: float
) -> tuple[Bool[np.ndarray, " t"], Int[np.ndarray, " t"]]:
    """Returns the frames in which the lower foot stands, and the index of that foot.

    `feet` are the toe joints in consecutive frames, m, in any world; `up` may err by 20
    degrees. A foot stands where its speed, in any direction, is below
    `_MAX_STANCE_SPEED_MPS`.
    """
    frame = np.arange(len(feet))
    lower = (feet @ up).argmin(axis=1)
    half = max(1, round(_SPEED_WINDOW_S * fps / 2))
    before = np.maximum(frame - half, 0)
    after = np.minimum(frame + half, len(feet) - 1)
    moved = np.linalg.norm(feet[after, lower] - feet[before, lower], axis=-1)
    speed = moved * fps / np.maximum(after - before, 1)
    return (speed < _MAX_STANCE_SPEED_MPS) & (len(feet) > 1), lower


def find_stances(
    feet: Float[np.ndarray, "h t 2 3"],
    present: Bool[np.ndarray, "h t"],
    fps: float,
    standing: Bool[np.ndarray, "h t 2"] | None = None,
) -> list[Float[np.ndarray, "_ 3"]]:
    """Returns, for each person, the median toe position of each stance, m, in a frame
    whose y axis is roughly up.

    `standing` marks the toes that stand according to a contact network; without it,
    `standing_feet` decides by speed.
    """
    if standing is None:
        standing = np.zeros(feet.shape[:3], bool)
        for h, one in enumerate(present):
            standing[h] = standing_by_speed(feet[h], one, fps)
    frames = max(2, _MIN_STANCE_S * fps)
    return [
        _stances(f, s & p[:, None], frames)
        for f, s, p in zip(feet, standing, present, strict=True)
    ]


def standing_by_speed(
    feet: Float[np.ndarray, "t 2 3"], present: Bool[np.ndarray, " t"], fps: float
) -> Bool[np.ndarray, "t 2"]:
    """Returns which feet of one person stand, by the speed of the lower foot
    (`standing_feet`) within each run of present frames; y is up."""
    found = np.zeros(feet.shape[:2], bool)
    for run in runs(present):
        stands, lower = standing_feet(feet[run], np.array([0.0, 1.0, 0.0]), fps)
        found[np.arange(run.start, run.stop), lower] = stands
    return found


def _stances(feet, standing, frames) -> Float[np.ndarray, "s 3"]:
    """Returns the median position of each stance of either foot, in order of time."""
    found = []
    for foot in range(2):
        for run in runs(standing[:, foot]):
            if run.stop - run.start >= frames:
                place = np.median(feet[run, foot], axis=0)
                found.append((run.start, place))
    return np.array([place for _, place in sorted(found, key=lambda s: s[0])]).reshape(
        -1, 3
    )


def toes_standing(
    contacts: Float[np.ndarray, "h t 4"] | None,
) -> Bool[np.ndarray, "h t 2"] | None:
    """Returns which of the left and right toes stand according to the contact network's
    probabilities; `None` without them."""
    return None if contacts is None else contacts[..., ::2] > _MIN_CONTACT_PROBABILITY


def in_free_fall(
    pelvis: Float[np.ndarray, "t 3"],
    present: Bool[np.ndarray, " t"],
    up: Float[np.ndarray, " 3"],
    fps: float,
) -> Bool[np.ndarray, " t"]:
    """Returns the frames in which a person is in flight, rising or falling.

    Args:
        pelvis: position in the world, m.
        up: unit vector; it may err by some 20 degrees.
    """
    half = max(1, round(_FALL_WINDOW_S * fps / 2))
    k = np.arange(-half, half + 1)
    # Least squares with a parabola: its second derivative in the middle.
    weight = k**2 - np.mean(k**2)
    weight = 2 * weight / (weight @ k**2) * fps**2
    found = np.zeros(len(pelvis), bool)
    for run in runs(present):
        if run.stop - run.start > 2 * half:
            height = pelvis[run] @ up
            middle = np.arange(run.start + half, run.stop - half)
            acceleration = np.correlate(height, weight, "valid")
            found[middle] = acceleration < -_MIN_FALL_ACCELERATION_MPS2
    return found
