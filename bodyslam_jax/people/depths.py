"""Relative depths of keypoints from BlazePose's 3-D landmarks: heading, limb in front.

They are weak evidence. On 180 rendered side views the depth of limbs has errors of 3 to
9 cm (1 σ) and a bias of up to 10 cm, correlated over about 0.15 s; the order of knees
or ankles 10 cm apart in depth was correct in all of 267 pairs, and no body was turned
round. They do not enter the fit. Its starts were chosen with them; of eleven rendered
sequences these were the same without them to 0.1 mm.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.people.found import Found
from bodyslam_jax.types import Intrinsics, Keypoints


def with_depths(
    keypoints: Keypoints, found: Found, intrinsics: Intrinsics
) -> Keypoints:
    """The keypoints with their depth behind the middle of the hips (m).

    BlazePose's landmarks are relative to the ray through the person: they are rotated
    into the camera frame.
    """
    depth = np.zeros(keypoints.confidence.shape)
    for h, t in zip(*np.nonzero(keypoints.confidence.any(axis=2)), strict=True):
        first, last = np.searchsorted(found.frame, [t, t + 1])
        for row in range(first, last):
            if np.array_equal(found.points[row, :, :2], keypoints.uv[h, t]):
                hips = keypoints.uv[h, t, 8]
                depth[h, t] = _turned(found.relative[row], hips, intrinsics)[:, 2]
    return dataclasses.replace(keypoints, depth=depth)


def _turned(
    relative: Float[np.ndarray, "25 3"], uv: np.ndarray, intrinsics: Intrinsics
) -> Float[np.ndarray, "25 3"]:
    fx, fy, cx, cy = intrinsics.params[:4]
    xy = np.array([(uv[0] - cx) / fx, (uv[1] - cy) / fy])
    return relative @ so3.exp(so3.optical_axis_to_ray(xy)).T
