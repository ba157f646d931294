"""Measures errors of detected keypoints of rendered people, whose joints are known."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.body import KEYPOINT_NAMES
from bodyslam_jax.body.skeleton import KEYPOINT_JOINT, SURFACE_POINTS
from bodyslam_jax.simulation import SimulatedSequence
from bodyslam_jax.simulation.point_tracks import is_behind
from bodyslam_jax.types import Keypoints, Sequence

_MIN_HEIGHT_PX = 60.0
"""Height in the image from which a person counts as detectable."""
_OUTLIER_ERROR_STATURES = 0.1
"""Error, in statures, from which a keypoint is an outlier."""
_KEYPOINT_NAMES = KEYPOINT_NAMES["body25"]


def detection_figures(simulated: SimulatedSequence, found: Sequence) -> dict[str, Any]:
    """Returns the detection rate of the first person, and the errors of each keypoint.

    `found` is the detection rate over the frames in which the person is taller than 60
    px and half of the joints are visible. `keypoints` has for each name: `offset`, the
    mean error in the frame of the joint that the keypoint moves with (x to the left on
    the left side, mirrored on the right, y up and z forward at rest), a constant fitted
    to the errors in the image at the true depth; `spread`, the standard deviation of
    the residuals in the image; both in statures; `seen`, the detection rate of the
    keypoint in the frames in which the person is found and the point is visible;
    `gross`, the share of outliers among these detections.
    """
    exact, depth, R_CJ, inside = _truth(simulated)
    wanted = (np.ptp(exact[:, :15, 1], axis=1) > _MIN_HEIGHT_PX) & (
        inside.mean(axis=1) > 0.5
    )
    if found.keypoints is None or not wanted.any():
        return {"found": 0.0, "keypoints": {}}
    uv, valid, number = _nearest(found.keypoints, exact)
    stature = np.ptp(simulated.person.skin[:, 1])
    error = (uv - exact) / simulated.intrinsics[:2] * depth[:, :, None] / stature
    return {
        "found": float(number[wanted].mean()),
        "keypoints": {
            name: _offset(
                error[:, k], R_CJ[:, k], valid[:, k], inside[:, k], number & wanted,
                mirrored=name.startswith("right"),
            )
            for k, name in enumerate(_KEYPOINT_NAMES)
        },
    }  # fmt: skip


def _truth(simulated: SimulatedSequence):
    """Returns pixels and depths of BODY_25, the orientations of its joints in the
    camera frame, and which points are in the image and not occluded by furniture or
    others."""
    person, walk = simulated.person, simulated.walk
    G, joints = person.joints(walk.poses, walk.pelvis)
    points = person.keypoints(G, joints)
    R_CW = np.swapaxes(simulated.T_WC[:, :3, :3], 1, 2)
    p = np.einsum("tab,tkb->tka", R_CW, points - simulated.T_WC[:, None, :3, 3])
    depth = np.maximum(p[..., 2], 0.05)
    uv = p[..., :2] / depth[..., None] * simulated.intrinsics[:2]
    uv = uv + simulated.intrinsics[2:]
    free = ((uv >= 0) & (uv <= np.array(simulated.size) - 1)).all(axis=2)
    free &= p[..., 2] > 0.1
    for k, T in enumerate(simulated.T_WC):
        free[k] &= ~simulated.room.is_hidden(T[:3, 3], points[k])
    for other in simulated.others:
        off = other.joints - simulated.T_WC[:, None, :3, 3]
        q = np.einsum("tab,tjb->tja", R_CW, off)
        free &= ~is_behind(p, q, simulated.intrinsics)
    leads = [_leader(name) for name in _KEYPOINT_NAMES]
    return uv, depth, R_CW[:, None] @ G[:, leads], free


def _leader(name: str) -> int:
    """Returns the joint that a keypoint moves with."""
    if name not in SURFACE_POINTS:
        return KEYPOINT_JOINT[name]
    if "toe" in name or "heel" in name:
        return KEYPOINT_JOINT[f"{name.split('_')[0]}_ankle"]
    return KEYPOINT_JOINT["head"]


def _nearest(
    found: Keypoints, exact: Float[np.ndarray, "t 25 2"]
) -> tuple[
    Float[np.ndarray, "t 25 2"], Bool[np.ndarray, "t 25"], Bool[np.ndarray, " t"]
]:
    """Returns, for each frame, the detection that belongs to the person, if any: its
    median distance is within a quarter of the person's height."""
    uv, valid = found.uv, found.confidence > 0
    away = np.linalg.norm(uv - exact, axis=-1)
    few = valid.sum(axis=-1) < 5
    middle = np.ma.median(np.ma.masked_array(away, ~valid), axis=-1).filled(np.inf)
    middle = np.where(few, np.inf, middle)
    who, frame = middle.argmin(axis=0), np.arange(uv.shape[1])
    near = middle[who, frame] < 0.25 * np.ptp(exact[..., 1], axis=1)
    return uv[who, frame], valid[who, frame] & near[:, None], near


def _offset(error, R_CJ, given, in_view, counted, *, mirrored: bool) -> dict[str, Any]:
    """Returns the `detection_figures` of one keypoint; `error` is in the image, in
    statures."""
    detected = given & in_view & counted
    good = detected & (np.linalg.norm(error, axis=1) < _OUTLIER_ERROR_STATURES)
    row: dict[str, Any] = {
        "seen": float(detected.sum() / max((counted & in_view).sum(), 1)),
        "gross": float(1 - good.sum() / detected.sum()) if detected.any() else np.nan,
    }
    if good.sum() < 10:
        return {**row, "offset": [np.nan] * 3, "spread": np.nan}
    A, b = R_CJ[good, :2].reshape(-1, 3), error[good].reshape(-1)
    # A constant view does not determine the offset in depth: a ridge keeps it small.
    ridge = 1e-3 * len(A) * np.eye(3)
    offset = np.linalg.solve(A.T @ A + ridge, A.T @ b)
    rest = b - A @ offset
    offset = offset * ([-1, 1, 1] if mirrored else 1)
    return {**row, "offset": offset.tolist(), "spread": float(rest.std())}
