"""Represents keypoints and bodies by the same 14 image points, for comparison.

NumPy only, as this runs before anything is compiled. The points are those of BODY_25
that are joints of SMPL: neck, shoulders, elbows, wrists, hips, knees, ankles; neck and
middle hip are midpoints, as OpenPose defines them. Missing points are NaN.
"""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.body import BodyModel
from bodyslam_jax.people import joints_of
from bodyslam_jax.types import Bodies, Intrinsics, Keypoints, Sequence

POINTS = slice(1, 15)
"""The keypoints of BODY_25 that are compared."""
NECK, R_SHOULDER, L_SHOULDER, MID_HIP, R_HIP, L_HIP = 0, 1, 4, 7, 8, 11
ANKLES = (10, 13)
"""Indices among the 14 points."""
MIRRORED_POINTS = np.array([0, 4, 5, 6, 1, 2, 3, 7, 11, 12, 13, 8, 9, 10])
"""Index of each point's counterpart on the other side of the body."""

_SMPL_JOINTS = np.array([-1, 17, 19, 21, 16, 18, 20, -1, 2, 5, 8, 1, 4, 7])
"""SMPL's joint of each point; -1 for midpoints."""
_PIXEL_BEHIND_CAMERA = 1e6
"""Pixel coordinate assigned to points behind the camera, far from all others."""
_MIN_COMMON_POINTS = 5
"""Number of common points from which two people are compared."""
_MAX_DISTANCE_SIZES = 3.0
"""Distances are clipped to this, in sizes of a person."""
_MIN_CONFIDENCE_RATIO = 0.25
"""Least confidence of a keypoint, relative to the 90 % quantile of the person's."""
_MIN_DEPTH_M = 0.05
"""Depth, m, below which a point counts as behind the camera."""
_MIN_SIZE_PX = 10.0
"""Lower bound on sizes in denominators, px."""


@dataclasses.dataclass(frozen=True)
class People:
    """People in each of `t` frames, from keypoints and from bodies."""

    keypoints: Float[np.ndarray, "t k 14 2"]
    """Detected points, px."""
    bodies: Float[np.ndarray, "t b 14 3"]
    """Points of the bodies in the camera frame, m."""
    camera: Intrinsics

    @property
    def both(self) -> Bool[np.ndarray, " t"]:
        """Frames with both keypoints and bodies."""
        return np.logical_and(
            have_points(self.keypoints).any(1), have_points(self.bodies).any(1)
        )


def people_of(sequence: Sequence, body: BodyModel) -> People:
    """Returns all people in the order of the sequence; arrays of a missing kind are
    empty."""
    t = sequence.num_frames
    detected, projected = np.zeros((t, 0, 14, 2)), np.zeros((t, 0, 14, 3))
    if sequence.keypoints is not None:
        detected = sure_points(sequence.keypoints).transpose(1, 0, 2, 3)
    if sequence.bodies is not None:
        projected = body_points(sequence.bodies, body).transpose(1, 0, 2, 3)
    return People(detected, projected, sequence.intrinsics)


def sure_points(keypoints: Keypoints) -> Float[np.ndarray, "h t 14 2"]:
    """Returns the keypoints of high confidence, px; NaN for others."""
    confidence = keypoints.confidence[..., POINTS]
    # The 90 % quantile, as `_MIN_CONFIDENCE_RATIO` says.
    best = [np.quantile(c[c > 0], 0.9) if (c > 0).any() else 1.0 for c in confidence]
    least = _MIN_CONFIDENCE_RATIO * np.reshape(best, (-1, 1, 1))
    sure = (confidence > 0) & (confidence >= least)
    return np.where(sure[..., None], keypoints.uv[:, :, POINTS], np.nan)


def body_points(bodies: Bodies, body: BodyModel) -> Float[np.ndarray, "h t 14 3"]:
    """Returns the joints of bodies that correspond to the points, in the camera frame,
    m."""
    at = bodies.present
    points = joints_of(bodies, body)[:, _SMPL_JOINTS]
    points[:, NECK] = (points[:, R_SHOULDER] + points[:, L_SHOULDER]) / 2
    points[:, MID_HIP] = (points[:, R_HIP] + points[:, L_HIP]) / 2
    out = np.full((*at.shape, 14, 3), np.nan)
    out[at] = points
    return out


def project(
    camera: Intrinsics, p_C: Float[np.ndarray, "*n 3"]
) -> Float[np.ndarray, "*n 2"]:
    """Projects points of the camera frame (m) to pixels (px).

    Points behind the camera get a pixel far away; missing points stay NaN.
    """
    fx, fy, cx, cy = camera.params[:4]
    missing, front = np.isnan(p_C[..., 2]), p_C[..., 2] > _MIN_DEPTH_M
    z = np.where(front, p_C[..., 2], 1.0)
    x, y = p_C[..., 0] / z, p_C[..., 1] / z
    if len(camera.params) > 4:
        k1, k2, p1, p2 = camera.params[4:]
        corner = (camera.width / fx) ** 2 + (camera.height / fy) ** 2
        r2 = x * x + y * y
        held = np.minimum(r2, corner)  # beyond the image the polynomial folds back
        radial = 1 + held * (k1 + held * k2)
        fade = np.where(r2 > 0, held / np.where(r2 > 0, r2, 1.0), 1.0)
        x, y = (
            x * radial + fade * (2 * p1 * x * y + p2 * (r2 + 2 * x * x)),
            y * radial + fade * (p1 * (r2 + 2 * y * y) + 2 * p2 * x * y),
        )
    uv = np.stack([fx * x + cx, fy * y + cy], axis=-1)
    uv = np.where(front[..., None], uv, _PIXEL_BEHIND_CAMERA)
    return np.where(missing[..., None], np.nan, uv)


def have_points(points: Float[np.ndarray, "*n 14 c"]) -> Bool[np.ndarray, "*n"]:
    """Returns whether enough of a person's points are valid for a comparison."""
    return np.isfinite(points[..., 0]).sum(-1) >= _MIN_COMMON_POINTS


def sizes(uv: Float[np.ndarray, "*n 14 2"]) -> Float[np.ndarray, "*n"]:
    """Returns the longer side of the box around each person, px; NaN for an absent
    person."""
    valid = np.isfinite(uv)
    low = np.where(valid, uv, np.inf).min(-2)
    high = np.where(valid, uv, -np.inf).max(-2)
    size = np.where(np.isfinite(low), high - np.where(np.isfinite(low), low, 0), 0)
    return np.where(have_points(uv), size.max(-1).clip(_MIN_SIZE_PX), np.nan)


def distances(
    detected: Float[np.ndarray, "t k 14 2"], projected: Float[np.ndarray, "t b 14 2"]
) -> Float[np.ndarray, "t k b"]:
    """Returns the mean distance of the points of two people, in sizes of the first; NaN
    where they share too few."""
    apart = np.hypot(*np.moveaxis(detected[:, :, None] - projected[:, None], -1, 0))
    valid = np.isfinite(apart)
    size = sizes(detected)[:, :, None]
    limit = _MAX_DISTANCE_SIZES * np.where(np.isfinite(size), size, 1.0)
    total = np.where(valid, np.minimum(apart, limit[..., None]), 0.0).sum(-1)
    count = valid.sum(-1)
    return np.where(
        count >= _MIN_COMMON_POINTS, total / np.maximum(count, 1) / size, np.nan
    )


def centred(
    uv: Float[np.ndarray, "*n 14 2"],
) -> tuple[Float[np.ndarray, "*n 2"], Float[np.ndarray, "*n"]]:
    """Returns the median of each person's points, and the mean distance from it of the
    nearest three quarters of the points, px."""
    middle = _median(uv, -2)
    away = np.sort(np.hypot(*np.moveaxis(uv - middle[..., None, :], -1, 0)), -1)
    count = np.isfinite(away).sum(-1)
    kept = np.arange(away.shape[-1]) < np.ceil(0.75 * count)[..., None]
    total = np.where(kept, away, 0.0).sum(-1)
    fine = have_points(uv)
    radius = total / np.maximum(kept.sum(-1), 1)
    return np.where(fine[..., None], middle, np.nan), np.where(fine, radius, np.nan)


def in_common(
    a: Float[np.ndarray, "*n 14 2"], b: Float[np.ndarray, "*n 14 2"]
) -> tuple[Float[np.ndarray, "*n 14 2"], Float[np.ndarray, "*n 14 2"]]:
    """Returns the points of two people, NaN where either lacks the point."""
    valid = np.isfinite(a) & np.isfinite(b)
    return np.where(valid, a, np.nan), np.where(valid, b, np.nan)


def _median(values: Float[np.ndarray, "*n"], axis: int) -> Float[np.ndarray, "*m"]:
    """Returns the median that ignores NaN; NaN if all values are."""
    count = np.isfinite(values).sum(axis, keepdims=True)
    ordered = np.sort(values, axis=axis)  # NaN last
    at = lambda i: np.take_along_axis(ordered, np.maximum(i, 0), axis=axis)
    return ((at((count - 1) // 2) + at(count // 2 * (count > 0))) / 2).squeeze(axis)


def compact(points: Float[np.ndarray, "t h 14 c"], most: int):
    """Returns the first `most` people of each frame; a row need not stay with one
    person."""
    valid = have_points(points)
    order = np.argsort(~valid, axis=1, kind="stable")
    width = min(most, int(valid.sum(1).max(initial=0)))
    order = order[:, :width]
    chosen = np.take_along_axis(points, order[:, :, None, None], axis=1)
    kept = np.take_along_axis(valid, order, axis=1)
    return np.where(kept[..., None, None], chosen, np.nan)
