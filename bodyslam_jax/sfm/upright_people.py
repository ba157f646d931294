"""Plausibility of people under a camera model and its map, from keypoints alone.

Two cues that need no body: people are upright over the ground of the map, and keep
their size while they walk over it. A wrong camera bends and tilts the map, so that the
image of its vertical leans against people's trunks, and stretches its depth, so that
people grow or shrink as they come nearer.
"""

import numpy as np
from jaxtyping import Float

from bodyslam_jax.geometry.arrays import SIGMA_OF_MEDIAN
from bodyslam_jax.ground.plane import find_ground
from bodyslam_jax.io.camera.calibration import as_opencv, rays
from bodyslam_jax.sfm.sfm import Reconstruction
from bodyslam_jax.types import Intrinsics, Keypoints

_NECK, _HIPS, _ANKLES = 1, 8, (11, 14)
"""Indices of keypoints in BODY_25."""
_LEAN_SIGMA_RAD = np.radians(4.0)
"""Standard deviation of a person's mean lean across the view from the normal of the
ground: 2 degrees of trunks, and of ground that slopes by up to 4."""
_SIZE_SIGMA = 0.03
"""Standard deviation of the distance from neck to ankles, relative to a person's mean,
by its change within a step."""
_STUDENT_FREEDOM = 4.0
"""Degrees of freedom of Student's distribution: people also bend, sit and jump."""
_MIN_FRAMES = 8


def plausibility(
    found: Reconstruction,
    intrinsics: Intrinsics,
    people: Keypoints | None,
    zoom: Float[np.ndarray, " t"],
) -> float:
    """Returns the log-likelihood of people's lean and of the scatter of their size.

    It is 0 without people or a ground that they stand on. Each person counts once, as
    errors of lean and size persist while the person is seen.

    Args:
        zoom: logarithm of the ratio of each frame's focal length to that of
            `intrinsics`.
    """
    if people is None or found.kind != "moving":
        return 0.0
    K, distortion = as_opencv(intrinsics.params)
    centre = np.asarray(intrinsics.params[2:4], float)
    uv = centre + (people.uv - centre) * np.exp(-zoom)[:, None, None]
    xy = rays(uv.reshape(-1, 2), K, distortion).reshape(uv.shape)
    seen = (people.confidence > 0)[..., [_NECK, _HIPS, *_ANKLES]].all(axis=-1)
    seen &= found.registered
    up = _roughly_up(xy, seen, found)
    eyes = found.T_WC[:, :3, 3]
    plane = None
    if up is not None:
        plane = find_ground(found.landmarks, eyes[found.registered], up)
    if plane is None:
        return 0.0
    total = 0.0
    for person, frames in zip(xy, seen, strict=True):
        which = np.flatnonzero(frames)
        if len(which) < _MIN_FRAMES:
            continue
        lean, size = _lean_and_size(person[which], found.T_WC[which], plane)
        if not len(size):
            continue
        scatter = SIGMA_OF_MEDIAN * np.median(np.abs(np.log(size / np.median(size))))
        total += _student(np.median(lean) / _LEAN_SIGMA_RAD) + _student(
            scatter / _SIZE_SIGMA
        )
    return total


def _student(x: float) -> float:
    return float(-(_STUDENT_FREEDOM + 1) / 2 * np.log1p(x**2 / _STUDENT_FREEDOM))


def _roughly_up(
    xy: Float[np.ndarray, "h t 25 2"], seen: np.ndarray, found: Reconstruction
) -> Float[np.ndarray, " 3"] | None:
    """Returns the mean direction of trunks in the world, as if they were parallel to
    the image; `None` without people."""
    h, t = np.nonzero(seen)
    if not len(h):
        return None
    trunk = xy[h, t, _NECK] - xy[h, t, _HIPS]
    trunk = trunk / np.maximum(np.linalg.norm(trunk, axis=-1, keepdims=True), 1e-9)
    up = np.einsum("mij,mj->mi", found.T_WC[t, :3, :2], trunk).mean(axis=0)
    return up / max(float(np.linalg.norm(up)), 1e-9)


def _lean_and_size(
    xy: Float[np.ndarray, "t 25 2"],
    T_WC: Float[np.ndarray, "t 4 4"],
    plane: Float[np.ndarray, " 4"],
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the angle of the trunk from the ground's normal in each image, rad, and
    the height of the neck over the feet, in units of the map, where feet are on the
    ground."""
    R, eye = T_WC[:, :3, :3], T_WC[:, :3, 3]
    normal = np.einsum("tij,i->tj", R, plane[:3])
    hips = xy[:, _HIPS]
    # The image of a line along the normal through the hips.
    along = normal[:, :2] - normal[:, 2:] * hips
    trunk = xy[:, _NECK] - hips
    across = along[:, 0] * trunk[:, 1] - along[:, 1] * trunk[:, 0]
    lean = np.arctan2(across, (along * trunk).sum(axis=-1))
    feet = xy[:, list(_ANKLES)].max(axis=1)
    feet[:, 0] = xy[:, list(_ANKLES), 0].mean(axis=1)
    ray = np.einsum("tij,tj->ti", R, np.column_stack([feet, np.ones(len(feet))]))
    down = ray @ plane[:3]
    height = eye @ plane[:3] + plane[3]
    ahead = (height > 0) & (down < -1e-3)
    depth = height[ahead] / -down[ahead]
    span = np.linalg.norm(xy[ahead, _NECK] - feet[ahead], axis=-1)
    return lean, np.maximum(span * depth, 1e-9)
