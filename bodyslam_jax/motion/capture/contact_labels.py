"""Labels contacts of heels and toes in motion capture by their height and speed.

In captured motion the ground is known to a centimetre and speeds to a few centimetres
a second, so that a simple rule is accurate. In a video neither is known. The contact
network learns to predict these labels from postures.
"""

import numpy as np
from jaxtyping import Bool, Float

MAX_CONTACT_SPEED = 0.35
"""Speed below which a point is in contact, leg lengths per second (0.3 m/s)."""
MAX_CONTACT_HEIGHT = 0.06
"""Distance from the floor below which a point is in contact, leg lengths (5 cm)."""
_FLOOR_WINDOW_S = 1.0
"""Interval before and after a frame over which the floor is the median height of the
lowest slow point, s: stairs and stools have their own height."""
_SPEED_WINDOW_S = 1 / 15
"""Interval over which speed is measured, s."""


def standing_points(
    points: Float[np.ndarray, "t p 3"], fps: float
) -> Bool[np.ndarray, "t p"]:
    """Returns which points of both feet are in contact, in a world whose y axis is up.

    `points` are heels and toes in leg lengths. Speed counts in all directions.
    """
    frame = np.arange(len(points))
    half = max(1, round(_SPEED_WINDOW_S * fps / 2))
    before = np.maximum(frame - half, 0)
    after = np.minimum(frame + half, len(points) - 1)
    moved = np.linalg.norm(points[after] - points[before], axis=-1)
    slow = moved * fps / np.maximum(after - before, 1)[:, None] < MAX_CONTACT_SPEED
    lowest = np.where(slow, points[..., 1], np.inf).min(axis=1)
    floor = _running_median(lowest, round(_FLOOR_WINDOW_S * fps))
    return slow & (np.abs(points[..., 1] - floor[:, None]) < MAX_CONTACT_HEIGHT)


def _running_median(x: Float[np.ndarray, " t"], half: int) -> Float[np.ndarray, " t"]:
    """Returns the median of the finite values within `half` rows; infinite without
    any."""
    padded = np.pad(x, half, constant_values=np.inf)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1)
    ordered = np.sort(windows, axis=1)
    count = np.isfinite(ordered).sum(axis=1)
    middle = np.maximum(count - 1, 0) // 2
    return np.where(count > 0, ordered[np.arange(len(x)), middle], np.inf)
