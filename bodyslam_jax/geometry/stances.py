"""Standing feet: in which frames a foot is on the ground, and where.

A foot stands while its toe joint is slow. Positions are of toe joints, m.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

STANDING_SPEED = 0.6
"""The lower foot stands where it is slower than this, m/s: assumes that toe joints over
`_SPEED_WINDOW` err by well below 6 cm."""
_SPEED_WINDOW = 0.1
"""s, over which the speed of a foot is measured, so that the noise of single frames is
averaged out."""
_SHORTEST_STANCE = 0.1
"""s"""


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
    edges = np.flatnonzero(np.diff(np.concatenate([[0], present, [0]])))
    for start, stop in edges.reshape(-1, 2):
        stands, lower = standing_feet(feet[start:stop], np.array([0.0, 1.0, 0.0]), fps)
        found[start + np.arange(stop - start), lower] = stands
    return found


def _stances(feet, standing, frames) -> Float[np.ndarray, "s 3"]:
    """Median positions of both feet while they stand, in the order of time."""
    found = []
    for foot in range(2):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], standing[:, foot], [0]])))
        for start, stop in edges.reshape(-1, 2):
            if stop - start >= frames:
                place = np.median(feet[start:stop, foot], axis=0)
                found.append((start, place))
    return np.array([place for _, place in sorted(found, key=lambda s: s[0])]).reshape(
        -1, 3
    )
