"""Figures by which a result is checked, by name; NaN or missing if not applicable."""

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.body.skeleton import FEET
from bodyslam_jax.diagnostics import posture
from bodyslam_jax.diagnostics.gait import MIN_STEP_LEGS, Gait, gait_of_joints
from bodyslam_jax.diagnostics.moments import MOMENT_S
from bodyslam_jax.diagnostics.standing_height import standing_height_figures
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.arrays import runs as runs_of
from bodyslam_jax.ground.stances import find_stances

_WALKING_SPEEDS_M_S = (0.7, posture.RUNNING_SPEED_M_S)
"""Range of median horizontal speeds in walking."""
_MIN_STRETCH_FRAMES = 15
"""Length from which a stretch is judged, frames."""

_SPEED_PERCENTILE = 95
"""Percentile of the speeds that `thresholds` names and judges."""
_MIN_MISFIT_RATIO = 2.2
"""Ratio of the worst misfit to the median over the video below which it is noise: on
simulated sequences it is nowhere twice the median (`thresholds`)."""

_FRONT_BACK_ANGLE_DEG = 90.0
"""Angle from which a difference in orientation is a front/back ambiguity, not an
error."""

_MIN_REACH_LEGS = 0.45
"""Reach of steps from which their length is judged, leg lengths."""
_WALKING_STEPS_OVER_REACH = (0.8, 1.4)
"""Range of step length over reach in walking."""
_MIN_RUNNING_CADENCE_HZ = 2.4
"""Cadence from which steps may be those of a run, steps per second."""
_MIN_ADVANCING_SPEED_M_S = 0.8
"""Mean speed from which either foot must stand in turn."""
_LEG_FIGURES = (
    *("standing_foot_speed", "gliding", "quick_steps", "step_short_of_reach"),
    *("step_beyond_reach", "step_beyond_reach_of_runner", "feet_off_ground"),
    *("ground_slope", "knee", "straighter_knee", "hip_over_ankle"),
)


def person_figures(
    joints: Float[np.ndarray, "t 24 3"],
    present: Bool[np.ndarray, " t"],
    fps: float,
    ground: Float[np.ndarray, "t 2"] | None = None,
) -> dict[str, float]:
    """Returns the figures of one person's posture, feet and motion; joints in m, y up.

    `ground` is the height of the map's ground under the toe joints
    (`standing_height.ground_heights`); without it feet are compared with a plane.
    Medians and means are over all stretches of frames in which the person is present;
    differences are never taken across a gap.
    """
    runs = [
        joints[run]
        for run in runs_of(present)
        if run.stop - run.start >= _MIN_STRETCH_FRAMES
    ]
    if not runs:
        return {}
    every = np.concatenate(runs)
    joined = lambda figure, *args: np.concatenate([figure(x, *args) for x in runs])
    speed = joined(posture.pelvis_speed, fps)
    knee = posture.knee_flexion(every)
    found = {
        "speed": float(np.percentile(speed, _SPEED_PERCENTILE)),
        "joint_acceleration": float(np.median(joined(posture.joint_acceleration, fps))),
        "turn": float(joined(posture.turning_rate, fps, MOMENT_S).max()),
        "velocity_jump": float(joined(posture.speed_change, fps, MOMENT_S).max()),
    }
    if speed.mean() > _MIN_ADVANCING_SPEED_M_S:
        slower = joined(posture.slower_foot_speed, fps, MOMENT_S / 2)
        found["gliding"] = float(100 * np.percentile(slower, 25) / speed.mean())
    steps = gait_of_joints(max(runs, key=len), fps)
    found |= _strides(steps)
    if speed.mean() < posture.RUNNING_SPEED_M_S:
        sliding = joined(posture.lower_foot_speed, fps)
        found["standing_foot_speed"] = float(np.median(sliding))
    if _goes_on_foot(steps, speed):
        found |= {
            "knee": float(knee.mean()),
            "straighter_knee": float(knee.min(axis=1).mean()),
            "hip_over_ankle": float(posture.hip_over_ankle(every).mean()),
            "trunk_lean": float(posture.trunk_lean(every).mean()),
            "turn_of_walker": found["turn"],
            "velocity_jump_of_walker": found["velocity_jump"],
        }
        found |= standing_height_figures(joints, present, fps, ground)
    return found


def with_legs_of(
    everything: dict[str, float], legs: dict[str, float]
) -> dict[str, float]:
    """Returns one person's figures, with those of feet and steps replaced by those of
    `legs`, computed from the frames in which legs are visible."""
    kept = {name: x for name, x in everything.items() if name not in _LEG_FIGURES}
    return kept | {name: x for name, x in legs.items() if name in _LEG_FIGURES}


def camera_figures(T_WC: Float[np.ndarray, "t 4 4"], fps: float) -> dict[str, float]:
    """Returns the camera's speed (95th percentile, m/s), acceleration (m/s²) and
    rotation rate (degrees/s), each measured over a tenth of a second to suppress noise
    of single frames."""
    n = max(1, round(0.1 * fps))
    place, turn = T_WC[:, :3, 3], T_WC[:, :3, :3]
    if len(place) <= 2 * n:
        return {}
    moved = np.linalg.norm(place[n:] - place[:-n], axis=1) * fps / n
    bent = place[2 * n :] - 2 * place[n:-n] + place[: -2 * n]
    trace = np.einsum("tij,tij->t", turn[:-n], turn[n:])
    angle = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    return {
        "camera_speed": float(np.percentile(moved, _SPEED_PERCENTILE)),
        "camera_acceleration": float(
            np.linalg.norm(bent, axis=1).max() * (fps / n) ** 2
        ),
        "camera_turning": float(angle.max() * fps / n),
    }


def up_in_image(T_WC: Float[np.ndarray, "t 4 4"]) -> float:
    """Returns the angle between up and the direction to the top of the image, degrees
    (median)."""
    return float(np.degrees(np.median(np.arccos(np.clip(-T_WC[:, 1, 1], -1, 1)))))


def turned_from_body(
    turn: Float[np.ndarray, "t 3 3"], given: Float[np.ndarray, "t 3"]
) -> float:
    """Returns the angle of the rotation, common to all frames, between a person and the
    given body, degrees.

    `turn` is the estimated orientation in the camera frame, `given` (axis-angle, rad)
    the regressor's, in the frames that have both. NaN where there are fewer than 15, or
    where front and back are confused, which other checks detect.
    """
    if len(turn) < _MIN_STRETCH_FRAMES:
        return np.nan
    apart = so3.between(given, so3.log(turn))
    angle = float(np.degrees(np.linalg.norm(np.median(apart, axis=0))))
    return angle if angle < _FRONT_BACK_ANGLE_DEG else np.nan


def floors_apart(
    joints: Float[np.ndarray, "h t 24 3"], present: Bool[np.ndarray, "h t"], fps: float
) -> float:
    """Returns the greatest difference between the heights at which people stand, m; NaN
    if fewer than two of them stand."""
    stances = find_stances(joints[:, :, list(FEET)], present, fps)
    heights = [np.median(places[:, 1]) for places in stances if len(places)]
    return float(np.ptp(heights)) if len(heights) > 1 else np.nan


def worst_misfit(
    error: Float[np.ndarray, "t k"], size: Float[np.ndarray, " t"], fps: float
) -> tuple[float, tuple[int, int] | None]:
    """Returns the largest distance of keypoints from the body over a third of a second,
    % of the person's size in the image, and the first and last frame of that interval.

    To reject outliers, medians are taken over the keypoints of a frame and over the
    frames of the interval. `error` (px) is NaN where nothing is measured. Returns NaN
    unless the worst value exceeds the median over the video by `_MIN_MISFIT_RATIO`: a
    uniform level is keypoint noise, not another person.
    """
    measured = np.isfinite(error).sum(axis=1) >= 5
    frames = np.flatnonzero(measured)
    n = max(3, round(fps / 3))
    if len(frames) < n:
        return np.nan, None
    share = 100 * np.nanmedian(error[frames], axis=1) / np.maximum(size[frames], 1e-6)
    lasting = np.median(np.lib.stride_tricks.sliding_window_view(share, n), axis=-1)
    k = int(lasting.argmax())
    worst = float(lasting[k])
    if worst <= _MIN_MISFIT_RATIO * np.median(share):
        return np.nan, None
    return worst, (int(frames[k]), int(frames[k + n - 1]))


def _strides(steps: Gait | None) -> dict[str, float]:
    """Returns the figures of step length over reach, and of cadence."""
    if steps is None or not steps.reach > _MIN_REACH_LEGS:
        return {}
    figure = steps.step_over_reach
    runner = steps.frequency > _MIN_RUNNING_CADENCE_HZ
    beyond = "step_beyond_reach_of_runner" if runner else "step_beyond_reach"
    found = {"step_short_of_reach": figure, beyond: figure}
    if _WALKING_STEPS_OVER_REACH[0] < figure < _WALKING_STEPS_OVER_REACH[1]:
        found["quick_steps"] = steps.frequency
    return found


def _goes_on_foot(steps: Gait | None, speed: Float[np.ndarray, " u"]) -> bool:
    """Returns whether the person walks: with regular steps, or at a walking speed most
    of the time."""
    slow, fast = _WALKING_SPEEDS_M_S
    if slow < np.median(speed) < fast:
        return True
    return (
        steps is not None and steps.step > MIN_STEP_LEGS and bool(speed.mean() < fast)
    )
