"""Figures of one person's posture, feet and motion, computed from the joints alone.

All functions take SMPL's joints (t, 24, 3) in consecutive frames, in metres, in a world
frame whose y axis is up. "Horizontal" is the plane of x and z.
"""

import numpy as np
from jaxtyping import Float

from bodyslam_jax.body.skeleton import ANKLES, FEET, HIPS, KNEES, NECK, PELVIS

_HORIZONTAL_AXES = (0, 2)
RUNNING_SPEED_M_S = 2.2
"""Speed above which neither foot need be on the ground for half of the time."""


def knee_flexion(joints: Float[np.ndarray, "t 24 3"]) -> Float[np.ndarray, "t 2"]:
    """Returns the angle between thigh and shin, left and right; 0 is straight;
    degrees."""
    hip, knee, ankle = (joints[:, list(of)] for of in (HIPS, KNEES, ANKLES))
    return _angle(knee - hip, ankle - knee)


def hip_over_ankle(joints: Float[np.ndarray, "t 24 3"]) -> Float[np.ndarray, " t"]:
    """Returns the height of the hips over the lower ankle, as a share of the leg's
    length."""
    hip = joints[:, list(HIPS), 1].mean(axis=1)
    leg = _length(joints[:, 1] - joints[:, 4]) + _length(joints[:, 4] - joints[:, 7])
    return (hip - joints[:, list(ANKLES), 1].min(axis=1)) / np.maximum(leg, 1e-6)


def trunk_lean(joints: Float[np.ndarray, "t 24 3"]) -> Float[np.ndarray, " t"]:
    """Returns the angle of the line from the pelvis to the neck with the vertical,
    degrees."""
    trunk = joints[:, NECK] - joints[:, PELVIS]
    return _angle(trunk, np.broadcast_to([0.0, 1.0, 0.0], trunk.shape))


def lower_foot_speed(
    joints: Float[np.ndarray, "t 24 3"], fps: float
) -> Float[np.ndarray, " u"]:
    """Returns the horizontal speed of the lower foot's toe joint, frame by frame,
    m/s."""
    feet = joints[:, list(FEET)]
    moved = _length(np.diff(feet[..., _HORIZONTAL_AXES], axis=0)) * fps
    return moved[np.arange(len(moved)), feet[:-1, :, 1].argmin(axis=1)]


def slower_foot_speed(
    joints: Float[np.ndarray, "t 24 3"], fps: float, over: float
) -> Float[np.ndarray, " u"]:
    """Returns the horizontal speed (mean over `over` seconds) of the slower toe joint,
    m/s."""
    n = max(1, min(round(over * fps), len(joints) - 1))
    feet = joints[:, list(FEET)][..., _HORIZONTAL_AXES]
    return _length(feet[n:] - feet[:-n]).min(axis=1) * fps / n


def joint_acceleration(
    joints: Float[np.ndarray, "t 24 3"], fps: float
) -> Float[np.ndarray, " u"]:
    """Returns the magnitude of the acceleration of each joint by second differences,
    m/s².

    One flat array over frames and joints, `u = 24 (t - 2)`.
    """
    return _length(np.diff(joints, n=2, axis=0)).ravel() * fps**2


def turning_rate(
    joints: Float[np.ndarray, "t 24 3"], fps: float, over: float
) -> Float[np.ndarray, " u"]:
    """Returns the absolute yaw rate of the line between the hips, degrees/s.

    It is the difference of yaw over an interval of `over` seconds, wrapped to at most
    180 degrees, divided by the length of the interval.
    """
    side = joints[:, HIPS[0]] - joints[:, HIPS[1]]
    heading = np.arctan2(side[:, 0], side[:, 2])
    n = max(1, round(over * fps))
    if len(heading) <= n:
        return np.zeros(0)
    turn = heading[n:] - heading[:-n]
    turn = (turn + np.pi) % (2 * np.pi) - np.pi
    return np.abs(np.degrees(turn)) * fps / n


def speed_change(
    joints: Float[np.ndarray, "t 24 3"], fps: float, over: float
) -> Float[np.ndarray, " u"]:
    """Returns the magnitude of the change of the pelvis' horizontal velocity, m/s.

    Velocities are means over two successive intervals of `over` seconds.
    """
    n = max(1, round(over * fps))
    place = joints[:, PELVIS][:, _HORIZONTAL_AXES]
    if len(place) <= 2 * n:
        return np.zeros(0)
    return _length(place[2 * n :] - 2 * place[n:-n] + place[: -2 * n]) * fps / n


def pelvis_speed(
    joints: Float[np.ndarray, "t 24 3"], fps: float
) -> Float[np.ndarray, " u"]:
    """Returns the horizontal speed of the pelvis, mean over half a second, m/s."""
    place = joints[:, PELVIS][:, _HORIZONTAL_AXES]
    n = max(1, min(round(fps / 2), len(place) - 1))
    return _length(place[n:] - place[:-n]) * fps / n


def _length(x: np.ndarray) -> np.ndarray:
    return np.linalg.norm(x, axis=-1)


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    cosine = (a * b).sum(-1) / np.maximum(_length(a) * _length(b), 1e-9)
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
