"""Finds the ground of a map: the level plane below the camera with the most points."""

import numpy as np
from jaxtyping import Float

_MIN_LEVEL_COSINE = np.cos(np.radians(20.0))
"""Cosine of the largest angle between the ground's normal and the assumed up direction,
which is only known from people's trunks."""
_MAX_PLANE_DISTANCE = 0.05
"""Inlier distance from the plane, as a share of the camera's height above it."""
_MAX_SHARE_BELOW = 0.15
"""Largest share of points below the ground: under the plane of a table lie more."""
_RANSAC_SAMPLES = 1000
"""Number of planes through three random points that RANSAC evaluates."""


def find_ground(
    points: Float[np.ndarray, "l 3"],
    eyes: Float[np.ndarray, "t 3"],
    up: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, " 4"] | None:
    """Returns the ground plane `n x + d = 0`, with n a unit vector upwards, by RANSAC.

    Returns `None` if no plane has enough points. `points` and the camera's centres
    `eyes` are in the same, arbitrary unit; `up` is a unit vector that may err by 20
    degrees.
    """
    level = np.median(eyes @ up)
    below = points[points @ up < level]
    if len(below) < 30:
        return None
    rng = np.random.default_rng(0)
    best, most = None, max(30, 0.15 * len(points))
    for _ in range(_RANSAC_SAMPLES):
        a, b, c = below[rng.choice(len(below), 3, replace=False)]
        plane = _plane(np.cross(b - a, c - a), a, up)
        height = np.median(eyes @ plane[:3] + plane[3])
        if plane[:3] @ up < _MIN_LEVEL_COSINE or height <= 0:
            continue
        away = below @ plane[:3] + plane[3]
        near = np.abs(away) < _MAX_PLANE_DISTANCE * height
        deeper = np.count_nonzero(away < -2 * _MAX_PLANE_DISTANCE * height)
        if near.sum() > most and deeper < _MAX_SHARE_BELOW * len(points):
            best, most = near, near.sum()
    if best is None:
        return None
    chosen = below[best]
    centre = chosen.mean(axis=0)
    return _plane(np.linalg.svd(chosen - centre, full_matrices=False)[2][2], centre, up)


def _plane(
    normal: Float[np.ndarray, " 3"],
    point: Float[np.ndarray, " 3"],
    up: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, " 4"]:
    """Returns the plane through a point with a normal that is made unit and upward."""
    length = np.linalg.norm(normal)
    normal = normal / max(length, 1e-12) * (1 if normal @ up >= 0 else -1)
    return np.append(normal, -normal @ point)
