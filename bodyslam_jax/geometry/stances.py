"""Standing feet: in which frames a foot is on the ground, and where.

A foot stands while its toe joint is slow. Positions are of toe joints, m.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from bodyslam_jax.geometry.runs import runs

STANDING_SPEED = 0.6
"""The lower foot stands where it is slower than this, m/s: assumes that toe joints over
`_SPEED_WINDOW` err by well below 6 cm."""
_SPEED_WINDOW = 0.1
"""s, over which the speed of a foot is measured, so that the noise of single frames is
averaged out."""
_SHORTEST_STANCE = 0.1
"""s"""
_PROBABLE = 0.7
"""Probability above which a toe is taken to stand, for gravity and the floor."""


def standing_feet(
    feet: Float[np.ndarray, "t 2 3"], up: Float[np.ndarray, " 3"], fps: float
) -> tuple[Bool[np.ndarray, " t"], Int[np.ndarray, " t"]]:
    """Frames in which the lower foot stands, and which foot that is.

    `feet` are the toe joints in frames that follow one another, m, in any world; `up`
    need be right to 20 degrees only. A foot stands where it is slower than
    `STANDING_SPEED`, in every direction.
    """
    frame = np.arange(len(feet))
    lower = (feet @ up).argmin(axis=1)
    half = max(1, round(_SPEED_WINDOW * fps / 2))
    before = np.maximum(frame - half, 0)
    after = np.minimum(frame + half, len(feet) - 1)
    moved = np.linalg.norm(feet[after, lower] - feet[before, lower], axis=-1)
    speed = moved * fps / np.maximum(after - before, 1)
    return (speed < STANDING_SPEED) & (len(feet) > 1), lower


def find_stances(
    feet: Float[np.ndarray, "h t 2 3"],
    present: Bool[np.ndarray, "h t"],
    fps: float,
    standing: Bool[np.ndarray, "h t 2"] | None = None,
) -> list[Float[np.ndarray, "_ 3"]]:
    """Stances of each person: the median position of the standing toe joint, one for
    each stance, m, in a frame whose y axis is roughly up.

    `standing` are the toes that stand, if a contact network estimated them; else a foot
    stands by `standing_feet`.
    """
    if standing is None:
        standing = np.zeros(feet.shape[:3], bool)
        for h, one in enumerate(present):
            standing[h] = standing_by_speed(feet[h], one, fps)
    frames = max(2, _SHORTEST_STANCE * fps)
    return [
        _stances(f, s & p[:, None], frames)
        for f, s, p in zip(feet, standing, present, strict=True)
    ]


def standing_by_speed(
    feet: Float[np.ndarray, "t 2 3"], present: Bool[np.ndarray, " t"], fps: float
) -> Bool[np.ndarray, "t 2"]:
    """Feet of one person that stand, by the speed of the lower foot (`standing_feet`),
    in each run of present frames; y is up."""
    found = np.zeros(feet.shape[:2], bool)
    for run in runs(present):
        stands, lower = standing_feet(feet[run], np.array([0.0, 1.0, 0.0]), fps)
        found[np.arange(run.start, run.stop), lower] = stands
    return found


def _stances(feet, standing, frames) -> Float[np.ndarray, "s 3"]:
    """Median positions of both feet while they stand, in the order of time."""
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
    """Left and right toes that stand, by the contact network's probabilities."""
    return None if contacts is None else contacts[..., ::2] > _PROBABLE
