"""Statistics of a result: distances, speeds, statures."""

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.body import BodyModel
from bodyslam_jax.body import stature as stature
from bodyslam_jax.body.skeleton import FEET
from bodyslam_jax.geometry.arrays import runs
from bodyslam_jax.types import Result

_UP_AXIS = 1
"""The y axis of a result's world points up."""
_HORIZONTAL_AXES = [0, 2]
_FEET = list(FEET)
_SMOOTHING_WINDOW_S = 0.5
"""Window of the moving average that keeps jitter from counting as distance, s."""


@dataclasses.dataclass(frozen=True)
class PathStatistics:
    """Statistics of the path of the camera or of a person's pelvis."""

    seconds: float
    """Total time in which the camera or person is present, s."""
    distance: float
    """Length of the smoothed path projected onto the horizontal plane, m."""
    speed: Float[np.ndarray, " t"]
    """Horizontal speed of the smoothed path, m/s; NaN where absent."""
    height: float
    """Mean height above y = 0, m."""

    @property
    def mean_speed(self) -> float:
        """Distance over time, m/s."""
        return self.distance / self.seconds if self.seconds > 0 else 0.0


def camera_statistics(
    result: Result, used: Bool[np.ndarray, " t"] | None = None
) -> PathStatistics:
    """Returns the statistics of the camera's path in the frames `used`, by default
    those with a located camera."""
    if used is None:
        used = result.located
    return _path_statistics(result, result.T_WC[:, :3, 3], used)


def person_statistics(result: Result, person: int) -> PathStatistics:
    """Returns the statistics of the path of a person's pelvis joint, where the person
    is present."""
    return _path_statistics(result, result.joints[person, :, 0], result.present[person])


def _path_statistics(
    result: Result, points: Float[np.ndarray, "t 3"], present: Bool[np.ndarray, " t"]
) -> PathStatistics:
    t, fps = result.timestamps, result.fps
    speed = np.full(len(t), np.nan)
    distance, seconds = 0.0, 0.0
    for run in runs(present):
        smooth = smoothed(points[run][:, _HORIZONTAL_AXES], fps)
        steps = np.linalg.norm(np.diff(smooth, axis=0), axis=1)
        distance += float(steps.sum())
        seconds += float(t[run][-1] - t[run][0])
        if len(steps):
            rate = steps / np.maximum(np.diff(t[run]), 1e-9)
            speed[run] = np.append(rate, rate[-1])
    height = float(points[present, _UP_AXIS].mean()) if present.any() else 0.0
    return PathStatistics(seconds, distance, speed, height)


def smoothed(points: Float[np.ndarray, "t d"], fps: float) -> Float[np.ndarray, "t d"]:
    """Returns the moving average of points.

    The ends are extrapolated by point reflection, so that a straight path stays
    straight.
    """
    size = min(int(_SMOOTHING_WINDOW_S * fps) | 1, len(points) - 1 + len(points) % 2)
    if size < 3:
        return points
    # Without `scipy.signal`, whose import would delay every command.
    beyond = ((size // 2, size // 2), (0, 0))
    wide = np.pad(points, beyond, mode="reflect", reflect_type="odd")
    return np.lib.stride_tricks.sliding_window_view(wide, size, axis=0).mean(axis=-1)


def foot_skating(result: Result, person: int) -> float:
    """Returns the median horizontal speed of the lower foot, m/s.

    It is about 0.1 m/s for real walks, not 0, because the lower foot alternates.
    """
    speeds = [np.zeros(0)]
    for run in runs(result.present[person]):
        feet = result.joints[person, run][:, _FEET]
        moved = np.linalg.norm(np.diff(feet[..., _HORIZONTAL_AXES], axis=0), axis=-1)
        lower = np.argmin(feet[:-1, :, _UP_AXIS], axis=1)
        chosen = moved[np.arange(len(moved)), lower]
        speeds.append(chosen / np.maximum(np.diff(result.timestamps[run]), 1e-9))
    every = np.concatenate(speeds)
    return float(np.median(every)) if len(every) else 0.0


def distance_to_camera(result: Result, person: int) -> tuple[float, float]:
    """Returns the least and the greatest distance of the pelvis from the camera, m."""
    present = result.present[person]
    if not present.any():
        return 0.0, 0.0
    gap = result.joints[person, present, 0] - result.T_WC[present, :3, 3]
    length = np.linalg.norm(gap, axis=1)
    return float(length.min()), float(length.max())


def stature_and_sigma(
    body: BodyModel,
    betas: Float[np.ndarray, " 10"],
    covariance: Float[np.ndarray, "10 10"],
) -> tuple[float, float]:
    """Returns `stature` and its standard deviation from the covariance of β, m."""
    height = stature(body, betas)
    slope = np.array([stature(body, betas + e) - height for e in np.eye(10)])
    return height, float(np.sqrt(slope @ covariance @ slope))
