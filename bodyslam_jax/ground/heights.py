"""Ground that is not a plane: its height under a foot, and its deviation from level.

The height under a foot follows from the landmarks around the point where the ray from
the camera through the foot meets them. It needs no scale, as a ray is scale-free.
"""

import numpy as np
from jaxtyping import Bool, Float

_MAX_RAY_DISTANCE = 0.25
"""Largest distance between landmark and ray, as a share of the camera's height above
the landmark: 0.4 m for a camera at eye level."""
_MIN_LANDMARKS = 5
"""Least number of landmarks that determine the height of the ground."""
_MIN_LEVEL_SHARE = 1 / 4
"""Least share of the landmarks near the ray that lie at the height of the ground. The
side of a box next to the foot has many landmarks, but fewer at any one height."""
_ROUGHNESS = 0.04
"""Largest difference between landmarks at one height, as a share of the camera's
height above them."""
_MIN_DOWNWARD_SINE = 0.05
"""Least sine of the angle between a ray and the horizontal, downwards."""
_MEDIAN_WINDOW_S = 1.0
"""Length of the running median of heights, s: two steps, over which errors of postures
average out."""
_WANDER_SIGMA_M = 0.03
"""Standard deviation of the running medians that estimation errors explain, m; that of
simulated walkers on level ground is 0.01 to 0.015."""
_LEVEL_DURATION_S = 3.0
"""Time after which somebody who climbs stands at another, independent height, s. With
it the errors of `elevation` are as large as it claims (`benchmarks/video.md`)."""


def ground_under(
    eyes: Float[np.ndarray, "t 3"],
    rays: Float[np.ndarray, "t 3"],
    landmarks: Float[np.ndarray, "l 3"],
    normal: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, " t"]:
    """Returns the height `n x` of the ground where rays from the camera meet it; NaN if
    unknown.

    Each landmark is compared with the point of the ray at its own height. The ground is
    the highest level with enough landmarks near the ray, as it would occlude lower
    ones.

    Args:
        eyes: the camera's centres, in the unit of `landmarks`.
        rays: directions towards a sole, in the world, of any length.
        normal: n, a unit vector that points upwards to within some degrees.
    """
    down = -(rays @ normal) / np.maximum(np.linalg.norm(rays, axis=1), 1e-12)
    level, high = landmarks @ normal, eyes @ normal
    found = np.full(len(eyes), np.nan)
    for k in np.flatnonzero(down > _MIN_DOWNWARD_SINE):
        below = level < high[k]
        depth = high[k] - level[below]
        towards = rays[k] / -(rays[k] @ normal)
        away = eyes[k] + depth[:, None] * towards - landmarks[below]
        near = (away**2).sum(axis=1) < (_MAX_RAY_DISTANCE * depth) ** 2
        found[k] = _highest(level[below][near], high[k])
    return found


def _highest(level: Float[np.ndarray, " n"], eye: float) -> float:
    """Returns the highest level that has enough of these landmarks; NaN if none has."""
    level = np.sort(level)
    depth = eye - level
    # A lower level has landmarks within a larger distance.
    weight = np.concatenate([[0.0], np.cumsum(depth**-2.0)])
    first = np.searchsorted(level, level - _ROUGHNESS * depth)
    stop = np.arange(len(level)) + 1
    enough = stop - first >= _MIN_LANDMARKS
    enough &= weight[stop] - weight[first] >= _MIN_LEVEL_SHARE * weight[-1]
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
    seconds: float = _MEDIAN_WINDOW_S,
) -> Float[np.ndarray, " t"]:
    """Returns the running median of `values` where `used`, over windows of `seconds`;
    NaN where a window has no value."""
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
    """Returns the deviation of the ground from each person's mean ground over time, m,
    and its standard deviation, m.

    The deviation is the running median of `heights` (of feet over the assumed ground,
    m), scaled by the share of its variance that estimation errors do not explain. Both
    results are 0 where the ground is as assumed.
    """
    slow = np.zeros(heights.shape)
    for h, (one, frames) in enumerate(zip(heights, used, strict=True)):
        if frames.any():
            median = running_median(one - np.median(one[frames]), frames, fps)
            slow[h] = np.where(frames, median, 0.0)
    if not used.any():
        return slow, 0.0
    # One standard deviation either way, of a normal distribution.
    low, high = np.quantile(slow[used], [0.16, 0.84])
    variance = ((high - low) / 2) ** 2
    excess = max(variance - _WANDER_SIGMA_M**2, 0.0)
    return slow * excess / max(variance, 1e-12), float(np.sqrt(excess))


def elevation(
    heights: Float[np.ndarray, " t"], used: Bool[np.ndarray, " t"], fps: float
) -> tuple[Float[np.ndarray, " t"], float]:
    """Returns how high over the floor one person stands, m, in each frame, and the
    standard deviation of the mean of that, m.

    Nobody stands below the floor. Somebody whose feet are at different heights stands
    on something else than the floor most of the time, and perhaps all of the time: with
    n independent heights, evenly distributed over a range r from the floor upwards, the
    floor is below the lowest of them by a distance with an exponential distribution of
    mean r / n. In half of the cases, by assumption, it is the lowest height itself.
    Then the floor's distance has the mean r / (2 n) and the standard deviation
    √3 r / (2 n).

    Both results are 0 where errors of the estimate explain the heights (`wander`).

    Args:
        heights: of the feet over a plane parallel to the floor, m.
    """
    slow, spread = wander(heights[None], used[None], fps)
    if not spread:
        return np.zeros(len(heights)), 0.0
    low, high = np.quantile(slow[0, used], [0.05, 0.95])
    beyond = (high - low) * _LEVEL_DURATION_S * fps / used.sum()
    above = np.where(used, slow[0] - low + beyond / 2, 0.0)
    # `wander` reduces heights by the probability p that they are errors; these two
    # cases differ by the mean height, with the variance p (1 - p) of that.
    either = above[used].mean() * _WANDER_SIGMA_M / spread
    # √3 / 2, as above; `beyond` is r / n.
    return above, float(np.hypot(beyond * np.sqrt(0.75), either))
