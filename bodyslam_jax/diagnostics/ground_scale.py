"""Size of the map relative to the people who stand on its ground."""

import numpy as np

from bodyslam_jax.body.skeleton import FEET
from bodyslam_jax.geometry.ground_plane import find_ground
from bodyslam_jax.types import Result

_FEET = list(FEET)
_SOLE = 0.027
"""Height of these joints above the sole in the default body, m."""
_UP = np.array([0.0, 1.0, 0.0])


def ground_scale(result: Result) -> float | None:
    """Factor by which the map would have to grow for its ground to be under the feet.

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
        feet = joints[present][:, _FEET]
        low = feet[np.arange(len(feet)), (feet @ normal).argmin(axis=1)]
        low = low - _SOLE * normal
        eye = result.T_WC[present, :3, 3]
        towards = (low - eye) @ normal
        reach = np.full(len(low), np.nan)
        down = towards < -1e-3
        reach[down] = -(eye[down] @ normal + offset) / towards[down]
        factors.append(1 / reach[reach > 0])
    every = np.concatenate(factors)
    return float(np.median(every)) if len(every) else None
