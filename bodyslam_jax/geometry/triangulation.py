"""Triangulation of many points, each from any number of views.

The linear solution comes first: the point nearest to its rays in space, by iteratively
reweighted least squares with a Cauchy loss. Gauss--Newton on reprojection errors then
removes the bias of that point towards the cameras. Coordinates `xy` are undistorted,
at depth 1 (a pixel over the focal length).
"""

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.geometry.arrays import sum_by

_MIN_DEPTH = 1e-9
"""Smallest depth that counts as in front of the camera, in the unit of the scene."""


def unit_rays(xy: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 3"]:
    """Returns the unit vectors in the camera frame through `xy` at depth 1."""
    rays = np.concatenate([xy, np.ones_like(xy[:, :1])], axis=-1)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


def triangulate(
    R_CW: Float[np.ndarray, "m 3 3"],
    centre: Float[np.ndarray, "m 3"],
    xy: Float[np.ndarray, "m 2"],
    landmark: Int[np.ndarray, " m"],
    num_landmarks: int,
    scale: float,
) -> Float[np.ndarray, "l 3"]:
    """Triangulates `l` points of the world from `m` views.

    A landmark without views, or with parallel rays only, gets a finite but meaningless
    point: see `widest_angle`.

    Args:
        R_CW, centre: world-to-camera rotation and camera centre of each view, in the
            unit of the scene.
        landmark: index of the point that each view observes.
        scale: scale of the Cauchy loss at depth 1: of the order of one pixel.
    """
    ray = np.einsum("mji,mj->mi", R_CW, unit_rays(xy))
    projector = np.eye(3) - ray[:, :, None] * ray[:, None]
    projected = np.einsum("mij,mj->mi", projector, centre)
    weight = np.ones(len(ray))
    points = np.zeros((num_landmarks, 3))
    for _ in range(4):
        normal = sum_by(landmark, weight[:, None, None] * projector, num_landmarks)
        rhs = sum_by(landmark, weight[:, None] * projected, num_landmarks)
        size = np.trace(normal, axis1=1, axis2=2)
        normal += (1e-12 * size + 1e-30)[:, None, None] * np.eye(3)
        points = np.linalg.solve(normal, rhs[..., None])[..., 0]
        p_C = np.einsum("mij,mj->mi", R_CW, points[landmark] - centre)
        z = np.where(p_C[:, 2] > _MIN_DEPTH, p_C[:, 2], 1 / _MIN_DEPTH)
        error = np.linalg.norm(p_C[:, :2] / z[:, None] - xy, axis=-1) / scale
        distance = np.linalg.norm(p_C, axis=-1) + 1e-12
        weight = 1 / distance**2 / (1 + error**2)
    return _refined(R_CW, centre, xy, landmark, points, scale)


def _refined(R_CW, centre, xy, landmark, points, scale) -> Float[np.ndarray, "l 3"]:
    """Refines points by Gauss--Newton on reprojection errors with a Cauchy loss.

    The linear solution is biased towards the cameras: noise of the ray directions adds
    apparent parallax, by a fifth where rays are 0.5 degrees apart.
    """
    for _ in range(5):
        p_C = np.einsum("mij,mj->mi", R_CW, points[landmark] - centre)
        front = p_C[:, 2] > _MIN_DEPTH
        z = np.where(front, p_C[:, 2], 1.0)[:, None]
        predicted = p_C[:, :2] / z
        error = xy - predicted
        J = (R_CW[:, :2] - predicted[:, :, None] * R_CW[:, 2:]) / z[:, :, None]
        weight = front / (1 + np.sum((error / scale) ** 2, axis=-1))
        gradient = np.einsum("mki,mk->mi", J, error) * weight[:, None]
        hessian = np.einsum("mki,mkj->mij", J, J) * weight[:, None, None]
        normal = sum_by(landmark, hessian, len(points))
        size = np.trace(normal, axis1=1, axis2=2)
        normal += (1e-9 * size + 1e-30)[:, None, None] * np.eye(3)
        rhs = sum_by(landmark, gradient, len(points))
        points = points + np.linalg.solve(normal, rhs[..., None])[..., 0]
    return points


def widest_angle(
    centre: Float[np.ndarray, "m 3"],
    landmark: Int[np.ndarray, " m"],
    points: Float[np.ndarray, "l 3"],
) -> Float[np.ndarray, " l"]:
    """Returns the parallax of each point (rad): the largest angle at the point between
    the camera centre of its first view and that of another; 0 without views."""
    to = centre - points[landmark]
    to = to / np.maximum(np.linalg.norm(to, axis=-1, keepdims=True), 1e-12)
    first = np.full(len(points), len(to))
    np.minimum.at(first, landmark, np.arange(len(to)))
    chord = np.linalg.norm(to - to[first[landmark]], axis=-1)
    angle = np.zeros(len(points))
    np.maximum.at(angle, landmark, 2 * np.arcsin(np.clip(chord / 2, 0, 1)))
    return angle
