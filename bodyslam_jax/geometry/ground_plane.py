"""The ground of a map: the level plane below the camera that most points lie in."""

import numpy as np
from jaxtyping import Float

_TILT = np.cos(np.radians(20.0))
"""The ground may lean this far from level, as up is only known from people's trunks."""
_THICKNESS = 0.05
"""Half the ground's thickness, of the camera's height above it."""
_BELOW = 0.15
"""Share of points that may lie under the ground: under a table there are more."""
_TRIES = 1000


def find_ground(
    points: Float[np.ndarray, "l 3"],
    eyes: Float[np.ndarray, "t 3"],
    up: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, " 4"] | None:
    """The plane `n x + d = 0` (n upwards, unit) of the ground, or `None`; by RANSAC.

    `points` and the camera's centres `eyes` are in any one unit; `up` is a unit vector,
    right to within 20 degrees.
    """
    level = np.median(eyes @ up)
    below = points[points @ up < level]
    if len(below) < 30:
        return None
    rng = np.random.default_rng(0)
    best, most = None, max(30, 0.15 * len(points))
    for _ in range(_TRIES):
        a, b, c = below[rng.choice(len(below), 3, replace=False)]
        plane = _plane(np.cross(b - a, c - a), a, up)
        height = np.median(eyes @ plane[:3] + plane[3])
        if plane[:3] @ up < _TILT or height <= 0:
            continue
        away = below @ plane[:3] + plane[3]
        near = np.abs(away) < _THICKNESS * height
        deeper = np.count_nonzero(away < -2 * _THICKNESS * height)
        if near.sum() > most and deeper < _BELOW * len(points):
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
    length = np.linalg.norm(normal)
    normal = normal / max(length, 1e-12) * (1 if normal @ up >= 0 else -1)
    return np.append(normal, -normal @ point)
