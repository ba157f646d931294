"""Do people stand on the ground of the map? A check the estimate knows nothing of."""

import numpy as np
from jaxtyping import Float

from bodyslam_jax.result import Result

_FEET = [10, 11]
_TILT = np.cos(np.radians(20.0))
"""The ground may lean this far from level, as up is only known from people's trunks."""
_THICKNESS = 0.05
"""Half the ground's thickness, of the camera's height above it."""
_TRIES = 1000


def ground_scale(result: Result) -> float | None:
    """Factor by which the map would have to grow for its ground to be under the feet.

    The ground is the plane, about level and below the camera, that most landmarks lie
    in. The ray from the camera to the lower foot meets it where the person should
    stand: the factor is the foot's distance over that one's, the median over frames.
    `None` where the map shows no ground, or there is nobody.
    """
    if not result.present.any():
        return None
    plane = find_ground(result.landmarks, result.T_WC[:, :3, 3])
    if plane is None:
        return None
    normal, offset = plane[:3], plane[3]
    factors = []
    for joints, here in zip(result.joints, result.present, strict=True):
        feet = joints[here][:, _FEET]
        low = feet[np.arange(len(feet)), feet[..., 1].argmin(axis=1)]
        eye = result.T_WC[here, :3, 3]
        towards = (low - eye) @ normal
        reach = np.full(len(low), np.nan)
        down = towards < -1e-3
        reach[down] = -(eye[down] @ normal + offset) / towards[down]
        factors.append(1 / reach[reach > 0])
    every = np.concatenate(factors)
    return float(np.median(every)) if len(every) else None


def find_ground(
    points: Float[np.ndarray, "l 3"], eyes: Float[np.ndarray, "t 3"]
) -> Float[np.ndarray, " 4"] | None:
    """The plane `n x + d = 0` (n up, unit) of the ground, or `None`; by RANSAC."""
    below = points[points[:, 1] < np.median(eyes[:, 1])]
    if len(below) < 30:
        return None
    rng = np.random.default_rng(0)
    best, most = None, max(30, 0.15 * len(points))
    for _ in range(_TRIES):
        a, b, c = below[rng.choice(len(below), 3, replace=False)]
        plane = _plane(np.cross(b - a, c - a), a)
        height = np.median(eyes @ plane[:3] + plane[3])
        if plane[1] < _TILT or height <= 0:
            continue
        near = np.abs(below @ plane[:3] + plane[3]) < _THICKNESS * height
        if near.sum() > most:
            best, most = near, near.sum()
    if best is None:
        return None
    chosen = below[best]
    centre = chosen.mean(axis=0)
    return _plane(np.linalg.svd(chosen - centre)[2][2], centre)


def _plane(
    normal: Float[np.ndarray, " 3"], point: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, " 4"]:
    length = np.linalg.norm(normal)
    normal = normal / max(length, 1e-12) * (1 if normal[1] >= 0 else -1)
    return np.append(normal, -normal @ point)
