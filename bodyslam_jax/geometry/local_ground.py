"""Ground that is not a plane: its height under a foot, and how far it wanders.

The height under a foot follows from the landmarks about the point where the ray from
the camera through the foot meets them. That needs no scale: a ray has none.
"""

import numpy as np
from jaxtyping import Bool, Float

_REACH = 0.25
"""Landmarks count within this distance of the ray, as a share of the camera's height
above them: 0.4 m for a camera at eye level."""
_FEWEST = 5
"""Landmarks that determine the height of the ground."""
_SHARE = 1 / 4
"""Of the landmarks near the ray, the share at one height for the ground to be there;
more are at the side of a box beside the foot than at any one height of it."""
_ROUGHNESS = 0.04
"""By which landmarks of one height differ, as a share of the camera's height above
them."""
_STEEPEST = 0.05
"""Least sine of the angle by which a ray goes downwards."""
_SECOND = 1.0
"""Length of the running median of heights, s: two steps, in which the errors of
postures average out."""
_WANDER = 0.03
"""Standard deviation of running medians that errors of estimates explain, m; simulated
walkers on level ground have 0.01 to 0.015."""


def ground_under(
    eyes: Float[np.ndarray, "t 3"],
    rays: Float[np.ndarray, "t 3"],
    landmarks: Float[np.ndarray, "l 3"],
    normal: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, " t"]:
    """Height `n x` of the ground where rays from the camera meet it; NaN if unknown.

    Each landmark is compared with the ray's point at its own height. The ground is the
    highest level at which there are enough that are near: it would hide a lower one.

    Args:
        eyes: the camera's centres, in the unit of `landmarks`.
        rays: towards a sole, in the world, of any length.
        normal: n, a unit vector, upwards to some degrees.
    """
    down = -(rays @ normal) / np.maximum(np.linalg.norm(rays, axis=1), 1e-12)
    level, high = landmarks @ normal, eyes @ normal
    found = np.full(len(eyes), np.nan)
    for k in np.flatnonzero(down > _STEEPEST):
        below = level < high[k]
        depth = high[k] - level[below]
        towards = rays[k] / -(rays[k] @ normal)
        away = eyes[k] + depth[:, None] * towards - landmarks[below]
        near = (away**2).sum(axis=1) < (_REACH * depth) ** 2
        found[k] = _highest(level[below][near], high[k])
    return found


def _highest(level: Float[np.ndarray, " n"], eye: float) -> float:
    """The highest of the heights at which many of these landmarks are; NaN if none."""
    level = np.sort(level)
    depth = eye - level
    # A lower level has landmarks within a larger distance.
    weight = np.concatenate([[0.0], np.cumsum(depth**-2.0)])
    first = np.searchsorted(level, level - _ROUGHNESS * depth)
    stop = np.arange(len(level)) + 1
    enough = stop - first >= _FEWEST
    enough &= weight[stop] - weight[first] >= _SHARE * weight[-1]
    if not enough.any():
        return np.nan
    k = np.flatnonzero(enough)[-1]
    found = float(np.median(level[first[k] : stop[k]]))
    for _ in range(3):  # from its upper edge to its middle
        near = np.abs(level - found) < _ROUGHNESS * (eye - found)
        found = float(np.median(level[near]))
    return found


def running_median(
    values: Float[np.ndarray, " t"],
    used: Bool[np.ndarray, " t"],
    fps: float,
    seconds: float = _SECOND,
) -> Float[np.ndarray, " t"]:
    """Median of the values in use within `seconds` of time; NaN where there is none."""
    half = max(1, round(seconds * fps / 2))
    padded = np.pad(np.where(used, values, np.nan), half, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1)
    found = np.full(len(values), np.nan)
    some = np.isfinite(windows).any(axis=1)
    found[some] = np.nanmedian(windows[some], axis=1)
    return found


def wander(
    heights: Float[np.ndarray, "h t"], used: Bool[np.ndarray, "h t"], fps: float
) -> tuple[Float[np.ndarray, "h t"], float]:
    """How far the ground is from each person's mean ground over time, m.

    Of the running medians of `heights` (of feet over the ground that is assumed, m) it
    is the share of their variance that errors of estimates do not explain, and the
    standard deviation of that part. Both are 0 on ground that is as assumed.
    """
    slow = np.zeros(heights.shape)
    for h, (one, frames) in enumerate(zip(heights, used, strict=True)):
        if frames.any():
            median = running_median(one - np.median(one[frames]), frames, fps)
            slow[h] = np.where(frames, median, 0.0)
    if not used.any():
        return slow, 0.0
    low, high = np.quantile(slow[used], [0.16, 0.84])
    variance = ((high - low) / 2) ** 2
    excess = max(variance - _WANDER**2, 0.0)
    return slow * excess / max(variance, 1e-12), float(np.sqrt(excess))
