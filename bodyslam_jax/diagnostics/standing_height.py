"""Measures how well standing feet lie on one plane, and on the map's ground below each.

Feet on stairs or uneven ground are on no plane, but on the ground that the landmarks
about each foot show (`ground.heights`). Somebody who floats is on neither.
"""

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.body.skeleton import FEET
from bodyslam_jax.ground.heights import ground_under
from bodyslam_jax.ground.plane import find_ground
from bodyslam_jax.ground.stances import find_stances, standing_by_speed
from bodyslam_jax.types import Result

_MIN_SLOPE_EXTENT_M = 1.0
"""Extent of the standing feet along their path from which a slope is estimated, m."""
_MIN_STANCES = 3
"""Number of stances from which heights are judged."""
_MIN_KNOWN_GROUND_SHARE = 0.2
"""Share of the standing frames with known ground under the foot from which that ground
is used, as in the estimate (`initialisation.ground`)."""
_MIN_HEIGHT_RANGE_SHARE = 0.5
"""Share of the range of heights of all standing feet that those with known ground must
cover: ground known on the level part only does not explain a rise."""
_MAX_LOCAL_FIGURE_RATIO = 0.5
"""A figure over the local ground replaces the one over a plane only if it is below this
share of it. Where people float above level ground, the two are about equal."""
_MIN_STANCES_ON_KNOWN_GROUND = 6
"""Number of stances with known ground from which that ground is used."""
_PLANE_TAIL_SHARE, _LOCAL_TAIL_SHARE = 0.05, 0.16
"""Share of stances trimmed at either end of their heights: over a plane, and over the
local ground, where a foot at the edge of a step may be assigned the next step's
height."""
_NORMAL_RANGE_FACTORS = {_PLANE_TAIL_SHARE: 1.0, _LOCAL_TAIL_SHARE: 1.645}
"""Factor from the range that remains after trimming to that of the middle 90 % of a
normal distribution."""
_TOE_HEIGHT_M = 0.027
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
    """Returns the slope along the path of a person's standing feet, and the range of
    their heights beside that slope.

    Both are relative to a plane, or to `ground` where that makes a figure less than
    half. Figures that cannot be determined are missing.

    Args:
        joints: m, world frame, y up.
        ground: height of the ground under each toe joint, m (`ground_heights`).
    """
    feet = joints[:, list(FEET)]
    standing = standing_by_speed(feet, present, fps)
    (stances,) = find_stances(feet[None], present[None], fps, standing[None])
    found = _over_plane(stances)
    if ground is None or not found:
        return found
    known = standing & np.isfinite(ground)
    if known.sum() < _MIN_KNOWN_GROUND_SHARE * standing.sum():
        return found
    over = feet.copy()
    over[..., 1] -= np.where(known, ground, 0.0)
    there, above = (
        find_stances(x[None], present[None], fps, known[None])[0] for x in (feet, over)
    )
    if len(there) < _MIN_STANCES_ON_KNOWN_GROUND:
        return found
    if np.ptp(there[:, 1]) < _MIN_HEIGHT_RANGE_SHARE * np.ptp(stances[:, 1]):
        return found
    local = _over_plane(above, _LOCAL_TAIL_SHARE)
    better = {
        k: v
        for k, v in local.items()
        if v < _MAX_LOCAL_FIGURE_RATIO * found.get(k, 0.0)
    }
    return found | better


def ground_heights(
    result: Result, person: int, present: Bool[np.ndarray, " t"]
) -> Float[np.ndarray, "t 2"] | None:
    """Returns the height of the map's ground under a person's toe joints, m, in the
    frames in which the foot stands.

    The ground is where the ray from the camera through the sole meets the landmarks.
    NaN where there are too few of them or the foot does not stand; `None` without a
    map.
    """
    if not len(result.landmarks):
        return None
    soles = result.joints[person][:, list(FEET)] - _TOE_HEIGHT_M * _UP
    standing = standing_by_speed(soles, present, result.fps)
    eyes = result.T_WC[:, :3, 3]
    found = np.full(standing.shape, np.nan)
    for foot, stands in enumerate(standing.T):
        rays = soles[stands, foot] - eyes[stands]
        found[stands, foot] = ground_under(eyes[stands], rays, result.landmarks, _UP)
    return found


def ground_scale(result: Result) -> float | None:
    """Returns the factor by which the map would have to grow for its ground to lie
    under the people's feet.

    The ground is the plane, about level and below the camera, that most landmarks lie
    in. The ray from the camera to the lower foot meets it where the person should
    stand: the factor is the foot's distance over that one's, the median over frames.
    `None` where the map shows no ground, or there is nobody.
    """
    if not result.present.any():
        return None
    plane = find_ground(result.landmarks, result.T_WC[:, :3, 3], _UP)
    if plane is None:
        return None
    normal, offset = plane[:3], plane[3]
    factors = []
    for joints, present in zip(result.joints, result.present, strict=True):
        feet = joints[present][:, list(FEET)]
        low = feet[np.arange(len(feet)), (feet @ normal).argmin(axis=1)]
        low = low - _TOE_HEIGHT_M * normal
        eye = result.T_WC[present, :3, 3]
        towards = (low - eye) @ normal
        reach = np.full(len(low), np.nan)
        down = towards < -1e-3
        reach[down] = -(eye[down] @ normal + offset) / towards[down]
        factors.append(1 / reach[reach > 0])
    every = np.concatenate(factors)
    return float(np.median(every)) if len(every) else None


def _over_plane(
    stances: Float[np.ndarray, "n 3"], outliers: float = _PLANE_TAIL_SHARE
) -> Figures:
    """Returns the slope of the stances (m, y up), and the range of their heights beside
    it.

    The share `outliers` of the stances at either end of the heights is trimmed.
    """
    if len(stances) < _MIN_STANCES:
        return {}
    height = stances[:, 1] - np.median(stances[:, 1])
    flat = stances[:, [0, 2]] - stances[:, [0, 2]].mean(axis=0)
    along = flat @ np.linalg.svd(flat, full_matrices=False)[2][0]
    found = {}
    if np.ptp(along) > _MIN_SLOPE_EXTENT_M:
        rise = float(np.polyfit(along, height, 1)[0])
        found["ground_slope"] = float(np.degrees(np.arctan(abs(rise))))
        height = height - rise * along
    span = float(np.ptp(np.quantile(height, [outliers, 1 - outliers])))
    found["feet_off_ground"] = span * _NORMAL_RANGE_FACTORS[outliers]
    return found
