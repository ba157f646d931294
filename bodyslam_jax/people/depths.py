"""Relative depths of keypoints from BlazePose's 3-D landmarks: heading, limb in front.

They are weak evidence. On 180 rendered side views the depth of limbs has errors of 3 to
9 cm (1 σ) and a bias of up to 10 cm, correlated over about 0.15 s; the order of knees
or ankles 10 cm apart in depth was correct in all of 267 pairs, and no body was turned
round. So depths do not enter the fit: they help to choose among fits with about equal
reprojection errors.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.people.found import Found
from bodyslam_jax.types import Intrinsics, Keypoints

_POINTS = (2, 3, 4, 5, 6, 7, 10, 11, 13, 14)
"""BODY_25's shoulders, elbows, wrists, knees and ankles."""
_JOINTS = (17, 19, 21, 16, 18, 20, 5, 8, 4, 7)
"""SMPL's joints of these."""
_SIGMA = 0.12
"""m: mean and scatter of the errors together."""
_ROBUST = 2.0
"""Scale of the Cauchy loss, in standard deviations."""
_ALIKE = 4.0
"""Depths per independent one, as their errors are correlated: two for successive fitted
frames (0.1 s apart) times two for the limbs of a body."""


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


def depth_costs(
    depth: Float[np.ndarray, "f 25"], joints: Float[np.ndarray, "f s 24 3"]
) -> Float[np.ndarray, "f s"]:
    """-log likelihood of depths, up to a constant, for each of several fits a frame.

    Args:
        depth: behind the middle of the hips, m; 0 where unknown.
        joints: relative to the pelvis, in C, m.
    """
    measured = depth[:, None, _POINTS]
    error = np.where(measured != 0, joints[:, :, _JOINTS, 2] - measured, 0.0)
    cost = _ROBUST**2 / 2 * np.log1p((error / _SIGMA / _ROBUST) ** 2)
    return cost.sum(axis=2) / _ALIKE


def _turned(
    relative: Float[np.ndarray, "25 3"], uv: np.ndarray, intrinsics: Intrinsics
) -> Float[np.ndarray, "25 3"]:
    fx, fy, cx, cy = intrinsics.params[:4]
    xy = np.array([(uv[0] - cx) / fx, (uv[1] - cy) / fy])
    return relative @ so3.exp(so3.optical_axis_to_ray(xy)).T
