"""Figures of a result that checks are applied to, by name; NaN if not applicable."""

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.body.skeleton import FEET
from bodyslam_jax.diagnostics import posture
from bodyslam_jax.diagnostics.gait import Gait, gait_of_joints
from bodyslam_jax.diagnostics.moments import MOMENT
from bodyslam_jax.diagnostics.standing_height import standing_height_figures
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.runs import runs as runs_of
from bodyslam_jax.geometry.stances import find_stances

_WALKING = (0.7, posture.RUNNING)
"""Range of median speeds over the ground in walking, m/s."""
_STEP = 0.35
"""Step length, in leg lengths, from which regular steps are a walk at any speed."""
_FEWEST = 15
"""Least length of a stretch that is judged, frames."""

_STANDS_OUT = 2.2

_FRONT_OR_BACK = 90.0
"""Angle from which a difference is a front/back ambiguity, not an error, degrees."""

_STRIDE = 0.45
"""Reach of steps, in leg lengths, from which their length is judged."""
_WALKS = (0.8, 1.4)
"""Range of step length over reach in walking."""
_RUNNERS_STEPS = 2.4
"""Cadence from which steps may be of a run, steps a second."""
_GETS_ON = 0.8
"""Speed from which feet have to stand in turn, m/s."""
_OF_LEGS = (
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
    """One person's posture, feet and motion; y is up, in m.

    `ground` is the height of the map's ground under the toe joints
    (`standing_height.ground_heights`); without it feet are compared with a plane.
    Medians and means are over all stretches of frames in which the person is present;
    differences are never taken across a gap.
    """
    runs = [joints[run] for run in runs_of(present) if run.stop - run.start >= _FEWEST]
    if not runs:
        return {}
    every = np.concatenate(runs)
    joined = lambda figure, *args: np.concatenate([figure(x, *args) for x in runs])
    speed = joined(posture.pelvis_speed, fps)
    knee = posture.knee_flexion(every)
    found = {
        "speed": float(np.percentile(speed, 95)),
        "joint_acceleration": float(np.median(joined(posture.joint_acceleration, fps))),
        "turn": float(joined(posture.turning_rate, fps, MOMENT).max()),
        "velocity_jump": float(joined(posture.speed_change, fps, MOMENT).max()),
    }
    if speed.mean() > _GETS_ON:
        slower = joined(posture.slower_foot_speed, fps, MOMENT / 2)
        found["gliding"] = float(100 * np.percentile(slower, 25) / speed.mean())
    steps = gait_of_joints(max(runs, key=len), fps)
    found |= _strides(steps)
    if speed.mean() < posture.RUNNING:
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
    """The figures of one person, those of feet and steps from `legs`: figures of the
    frames in which legs are not only guessed."""
    kept = {name: x for name, x in everything.items() if name not in _OF_LEGS}
    return kept | {name: x for name, x in legs.items() if name in _OF_LEGS}


def camera_figures(T_WC: Float[np.ndarray, "t 4 4"], fps: float) -> dict[str, float]:
    """The camera's speed (m/s), acceleration (m/s²) and turning (degrees/s), each over
    a tenth of a second, so that noise of single frames counts less."""
    n = max(1, round(0.1 * fps))
    place, turn = T_WC[:, :3, 3], T_WC[:, :3, :3]
    if len(place) <= 2 * n:
        return {}
    moved = np.linalg.norm(place[n:] - place[:-n], axis=1) * fps / n
    bent = place[2 * n :] - 2 * place[n:-n] + place[: -2 * n]
    trace = np.einsum("tij,tij->t", turn[:-n], turn[n:])
    angle = np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))
    return {
        "camera_speed": float(np.percentile(moved, 95)),
        "camera_acceleration": float(
            np.linalg.norm(bent, axis=1).max() * (fps / n) ** 2
        ),
        "camera_turning": float(angle.max() * fps / n),
    }


def up_in_image(T_WC: Float[np.ndarray, "t 4 4"]) -> float:
    """Angle between up and the direction to the top of the image, degrees (median)."""
    return float(np.degrees(np.median(np.arccos(np.clip(-T_WC[:, 1, 1], -1, 1)))))


def turned_from_body(
    turn: Float[np.ndarray, "t 3 3"], given: Float[np.ndarray, "t 3"]
) -> float:
    """Rotation, common to all frames, between a person and the given body, degrees.

    `turn` is the estimated orientation in the camera's frame, `given` (axis-angle,
    rad) the regressor's, of the frames that have both. NaN where there are few, or
    where front and back are confused, which other checks find.
    """
    if len(turn) < _FEWEST:
        return np.nan
    apart = so3.between(given, so3.log(turn))
    angle = float(np.degrees(np.linalg.norm(np.median(apart, axis=0))))
    return angle if angle < _FRONT_OR_BACK else np.nan


def floors_apart(
    joints: Float[np.ndarray, "h t 24 3"], present: Bool[np.ndarray, "h t"], fps: float
) -> float:
    """Greatest difference between the heights at which people stand, m; NaN if fewer
    than two do."""
    stances = find_stances(joints[:, :, list(FEET)], present, fps)
    heights = [np.median(places[:, 1]) for places in stances if len(places)]
    return float(np.ptp(heights)) if len(heights) > 1 else np.nan


def keypoint_misfit(
    error: Float[np.ndarray, "t k"], size: Float[np.ndarray, " t"], fps: float
) -> float:
    """As `worst_misfit`, without the frames."""
    return worst_misfit(error, size, fps)[0]


def worst_misfit(
    error: Float[np.ndarray, "t k"], size: Float[np.ndarray, " t"], fps: float
) -> tuple[float, tuple[int, int] | None]:
    """Largest distance of keypoints from the body over a third of a second, % of the
    person's size in the image, and the first and last frame of that third of a second.

    `error` is NaN where nothing is measured; of a frame the median counts, of the third
    of a second too, so that outliers do not. NaN where it is nowhere `_STANDS_OUT`
    times as large as mostly: noise is no other person.
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
    if worst <= _STANDS_OUT * np.median(share):
        return np.nan, None
    return worst, (int(frames[k]), int(frames[k + n - 1]))


def _strides(steps: Gait | None) -> dict[str, float]:
    """Figures of step length over reach, and of cadence."""
    if steps is None or not steps.reach > _STRIDE:
        return {}
    figure = steps.step_over_reach
    runner = steps.frequency > _RUNNERS_STEPS
    beyond = "step_beyond_reach_of_runner" if runner else "step_beyond_reach"
    found = {"step_short_of_reach": figure, beyond: figure}
    if _WALKS[0] < figure < _WALKS[1]:
        found["quick_steps"] = steps.frequency
    return found


def _goes_on_foot(steps: Gait | None, speed: Float[np.ndarray, " u"]) -> bool:
    """Whether somebody walks: regular steps, or a walking speed most of the time."""
    slow, fast = _WALKING
    if slow < np.median(speed) < fast:
        return True
    return steps is not None and steps.step > _STEP and bool(speed.mean() < fast)
