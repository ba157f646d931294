"""How high standing feet are: over one plane, and over the map's ground under each.

Feet on stairs or uneven ground are on no plane, but on the ground that the landmarks
about each foot show (`geometry.local_ground`). Somebody who floats is on neither.
"""

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.body.skeleton import FEET
from bodyslam_jax.geometry.local_ground import ground_under
from bodyslam_jax.geometry.stances import find_stances, standing_by_speed
from bodyslam_jax.types import Result

_FLOOR = 1.0
"""Least extent of standing feet for a slope, m."""
_FEWEST = 3
"""Stances that are judged."""
_KNOWN = 0.2
"""Share of standing frames with ground under the foot from which it counts, as in the
estimate (`initialisation.ground`)."""
_SHOWN = 0.5
"""Share of the standing feet's range of heights that those with known ground must have:
a rise that it does not show is not explained by it."""
_BETTER = 0.5
"""Share of a figure over a plane that the one over the ground under each foot must be
below: over level ground that people rise and sink above, the two are alike."""
_FEWEST_KNOWN = 6
"""Stances with known ground, for it to count."""
_OUTLIERS, _AT_EDGES = 0.05, 0.16
"""Share of stances at either end of their heights that does not count: over a plane,
and over the ground under each foot, which at the edge of a step is that of the next
one."""
_NORMAL = {_OUTLIERS: 1.0, _AT_EDGES: 1.645}
"""Factor from the range that is left to that of the middle 90 % of a normal
distribution."""
_SOLE = 0.027
"""Height of the toe joints above the sole in the default body, m."""
_UP = np.array([0.0, 1.0, 0.0])

Figures = dict[str, float]
"""`ground_slope`, degrees, and `feet_off_ground`, m."""


def standing_height_figures(
    joints: Float[np.ndarray, "t 24 3"],
    present: Bool[np.ndarray, " t"],
    fps: float,
    ground: Float[np.ndarray, "t 2"] | None = None,
) -> Figures:
    """Slope along the path of a person's standing feet, and their range of heights
    beside it, over a plane, or over `ground` where that explains the figure better.

    Args:
        ground: height of the ground under each toe joint (`ground_heights`).
    """
    feet = joints[:, list(FEET)]
    standing = standing_by_speed(feet, present, fps)
    (stances,) = find_stances(feet[None], present[None], fps, standing[None])
    found = _over_plane(stances)
    if ground is None or not found:
        return found
    known = standing & np.isfinite(ground)
    if known.sum() < _KNOWN * standing.sum():
        return found
    over = feet.copy()
    over[..., 1] -= np.where(known, ground, 0.0)
    there, above = (
        find_stances(x[None], present[None], fps, known[None])[0] for x in (feet, over)
    )
    if len(there) < _FEWEST_KNOWN:
        return found
    if np.ptp(there[:, 1]) < _SHOWN * np.ptp(stances[:, 1]):
        return found
    local = _over_plane(above, _AT_EDGES)
    better = {k: v for k, v in local.items() if v < _BETTER * found.get(k, 0.0)}
    return found | better


def ground_heights(
    result: Result, person: int, present: Bool[np.ndarray, " t"]
) -> Float[np.ndarray, "t 2"] | None:
    """Height of the map's ground under a person's toe joints where they stand, m.

    It is where the ray from the camera through the sole meets the landmarks; NaN where
    there are too few, `None` without a map.
    """
    if not len(result.landmarks):
        return None
    soles = result.joints[person][:, list(FEET)] - _SOLE * _UP
    standing = standing_by_speed(soles, present, result.fps)
    eyes = result.T_WC[:, :3, 3]
    found = np.full(standing.shape, np.nan)
    for foot, stands in enumerate(standing.T):
        rays = soles[stands, foot] - eyes[stands]
        found[stands, foot] = ground_under(eyes[stands], rays, result.landmarks, _UP)
    return found


def _over_plane(
    stances: Float[np.ndarray, "n 3"], outliers: float = _OUTLIERS
) -> Figures:
    """Of places of standing feet; the share `outliers` at either end does not count."""
    if len(stances) < _FEWEST:
        return {}
    height = stances[:, 1] - np.median(stances[:, 1])
    flat = stances[:, [0, 2]] - stances[:, [0, 2]].mean(axis=0)
    along = flat @ np.linalg.svd(flat, full_matrices=False)[2][0]
    found = {}
    if np.ptp(along) > _FLOOR:
        rise = float(np.polyfit(along, height, 1)[0])
        found["ground_slope"] = float(np.degrees(np.arctan(abs(rise))))
        height = height - rise * along
    span = float(np.ptp(np.quantile(height, [outliers, 1 - outliers])))
    found["feet_off_ground"] = span * _NORMAL[outliers]
    return found
