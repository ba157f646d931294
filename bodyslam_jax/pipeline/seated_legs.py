"""Poses the legs of people who sit, where no knee and no ankle is in view.

Of hidden legs nothing but the prior tells the posture, and that is of two kinds: people
sit or stand. The mean of both is neither, so legs have the mean of the more probable
kind (`diagnostics.seated`); `joint_sigma` is of both. A fit guesses legs that stand, so
only those that sit are posed here. Thighs of people who sit are about level however the
trunk leans, and the pitch of a pelvis without thighs is not measured: legs are placed
in the world, at the pelvis' heading, not beneath the pelvis. The rest of the body and
frames with a leg in view are not changed.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt

from bodyslam_jax.body.skeleton import ANKLES, FEET, HIPS, KNEES, NECK, PELVIS
from bodyslam_jax.diagnostics import seated
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.arrays import runs

THIGH, KNEE, ANKLE = (-1.30, 0.16, 0.15), (1.43, 0.03, 0.11), (0.19, -0.21, -0.47)
"""Mean posture of the left leg of people who sit, rotation vectors, rad: of the thigh
in the frame of the pelvis' heading (x to the left, y up), of the knee and of the ankle.
Of recordings of three people on stools, who count alike
(`tools/sitting_probability.py`)."""
_MIRRORED = np.array([1.0, -1.0, -1.0])
"""Signs of a rotation vector's components in the mirror image, left for right."""
_MIN_UPRIGHT = 0.44
"""Least cosine of the trunk's lean of somebody who sits: in 99 % of the frames of these
recordings."""


def with_seated_legs(
    poses: Float[np.ndarray, "h t 72"],
    joints: Float[np.ndarray, "h t 24 3"],
    shown: Bool[np.ndarray, "h t 25"],
    present: Bool[np.ndarray, "h t"],
    fps: float,
    eyes: Float[np.ndarray, "t 3"] | None = None,
) -> Float[np.ndarray, "h t 72"]:
    """Returns the poses; legs sit where none is in view and the person probably sits.

    Args:
        poses: SMPL poses, rad, in a world whose y axis is up.
        joints: their joints, m.
        shown: keypoints of BODY_25 that are visible in the image.
        eyes: positions of the camera, m.
    """
    found = poses.copy()
    for h, here in enumerate(present):
        unseen = seated.legs_unseen(shown[h], here, fps)
        sits = seated.sits(joints[h], unseen, fps, eyes) & _upright(joints[h])
        if sits.any():
            found[h] = _blended(poses[h], _share(sits, here, fps))
    return found


def nearer_floor(
    before: Float[np.ndarray, "h t 24 3"],
    after: Float[np.ndarray, "h t 24 3"],
    changed: Bool[np.ndarray, "h t"],
    floor: float | None,
) -> Bool[np.ndarray, "h t"]:
    """Returns the frames `changed` whose legs are to sit: all of a stretch, unless feet
    that hang as before are nearer to a floor on which somebody was seen to stand.

    Args:
        before, after: joints of legs that hang and that sit, m, y up.
        floor: its height, m; `None` if it is not known.
    """
    found = changed.copy()
    if floor is None:
        return found
    off = lambda joints: np.abs(joints[:, list(FEET), 1].min(axis=1) - floor)
    for h, here in enumerate(changed):
        for run in runs(here):
            hang, sit = (np.median(off(x[h, run])) for x in (before, after))
            found[h, run] = sit < hang
    return found


def _upright(joints: Float[np.ndarray, "t 24 3"]) -> Bool[np.ndarray, " t"]:
    trunk = joints[:, NECK] - joints[:, PELVIS]
    return trunk[:, 1] > _MIN_UPRIGHT * np.linalg.norm(trunk, axis=1)


def _share(
    sits: Bool[np.ndarray, " t"], present: Bool[np.ndarray, " t"], fps: float
) -> Float[np.ndarray, " t"]:
    """Returns the share of the seated posture in each frame: it grows to 1 within a
    second from any frame in which the person is there and does not sit."""
    away = np.flatnonzero(present & ~sits)
    if not len(away):
        return sits.astype(float)
    apart = np.asarray(distance_transform_edt(sits | ~present))
    return np.where(sits, np.minimum(apart / (seated.WINDOW_S * fps), 1.0), 0.0)


def _blended(
    pose: Float[np.ndarray, "t 72"], share: Float[np.ndarray, " t"]
) -> Float[np.ndarray, "t 72"]:
    """Returns the pose, of whose legs `share` is the seated posture's."""
    rows = np.flatnonzero(share > 0)
    angles = pose[rows].reshape(-1, 24, 3)
    turn = so3.exp(angles)
    seat = turn.copy()
    pelvis = turn[:, PELVIS]
    heading = _heading(pelvis)
    for side, sign in enumerate((np.ones(3), _MIRRORED)):
        thigh = heading @ so3.exp(sign * THIGH)
        seat[:, HIPS[side]] = np.swapaxes(pelvis, -1, -2) @ thigh
        seat[:, KNEES[side]] = so3.exp(sign * KNEE)
        seat[:, ANKLES[side]] = so3.exp(sign * ANKLE)
    legs = [*HIPS, *KNEES, *ANKLES]
    part = share[rows, None].repeat(len(legs), axis=1)
    angles[:, legs] = so3.log(so3.interpolate(turn[:, legs], seat[:, legs], part))
    found = pose.copy()
    found[rows] = angles.reshape(-1, 72)
    return found


def _heading(pelvis: Float[np.ndarray, "t 3 3"]) -> Float[np.ndarray, "t 3 3"]:
    """Returns the upright frames whose x axes are the pelvis' left, made level."""
    left = pelvis[:, :, 0] * [1.0, 0.0, 1.0]
    left = left / np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-9)
    up = np.broadcast_to([0.0, 1.0, 0.0], left.shape)
    return np.stack([left, up, np.cross(left, up)], axis=-1)
