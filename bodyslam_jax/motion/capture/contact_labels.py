"""Which of heels and toes stand, from motion capture: by height and speed.

In captured motion the ground is known to a centimetre and speeds to a few centimetres
a second, so that a rule decides well. From a video neither is known. These are the
labels that the contact network learns to predict from postures.
"""

import numpy as np
from jaxtyping import Bool, Float

SPEED = 0.35
"""A point stands where it is slower, leg lengths per second (0.3 m/s)."""
HEIGHT = 0.06
"""... and no further than this from the floor, leg lengths (5 cm)."""
_FLOOR = 1.0
"""The floor is the median height of the lowest slow point within so many seconds:
stairs and stools have a height of their own."""
_SPEED_WINDOW = 1 / 15
"""s, over which speed is measured."""


def standing_points(
    points: Float[np.ndarray, "t p 3"], fps: float
) -> Bool[np.ndarray, "t p"]:
    """Which of the points of both feet stand, in a world whose y axis is up.

    `points` are heels and toes in leg lengths. Speed counts in all directions.
    """
    frame = np.arange(len(points))
    half = max(1, round(_SPEED_WINDOW * fps / 2))
    before = np.maximum(frame - half, 0)
    after = np.minimum(frame + half, len(points) - 1)
    moved = np.linalg.norm(points[after] - points[before], axis=-1)
    slow = moved * fps / np.maximum(after - before, 1)[:, None] < SPEED
    lowest = np.where(slow, points[..., 1], np.inf).min(axis=1)
    floor = _running_median(lowest, round(_FLOOR * fps))
    return slow & (np.abs(points[..., 1] - floor[:, None]) < HEIGHT)


def _running_median(x: Float[np.ndarray, " t"], half: int) -> Float[np.ndarray, " t"]:
    """Median of the finite values within `half` rows of each; infinite without any."""
    padded = np.pad(x, half, constant_values=np.inf)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1)
    ordered = np.sort(windows, axis=1)
    count = np.isfinite(ordered).sum(axis=1)
    middle = np.maximum(count - 1, 0) // 2
    return np.where(count > 0, ordered[np.arange(len(x)), middle], np.inf)
