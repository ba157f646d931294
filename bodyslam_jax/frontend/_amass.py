"""AMASS-style motion of one body -> rows for the frames of a video."""

import numpy as np
from scipy.spatial.transform import Rotation

from bodyslam_jax.frontend._body_parts import numbers_of
from bodyslam_jax.frontend._numbering import Unfit
from bodyslam_jax.frontend._rows import Rows, Video

_SAME_RATE = 0.01
"""Relative difference of rates that is still the same rate, rounded."""
_MAX_RATIO = 2.5
"""Motion and video of durations further apart do not belong together."""


def from_amass(data: dict, video: Video) -> Rows:
    """AMASS style, one body for the whole video, taken to be in the camera frame.

    Both begin together. Another rate is resampled to the times of the video's frames.
    """
    poses = numbers_of(data, "poses", None)
    n = len(poses)
    if poses.ndim != 2 or poses.shape[1] < 66 or not n:
        raise Unfit(f"`poses` is {poses.shape}, not (t, 72) or (t, 156)")
    width = 72 if poses.shape[1] == 72 else 66
    poses = np.pad(poses[:, :width], [(0, 0), (0, 72 - width)])
    trans = numbers_of(data, "trans", (n, 3))
    rate = np.ravel(numbers_of(data, "mocap_framerate", None))
    if len(rate) != 1 or rate[0] <= 0:
        raise Unfit(f"`mocap_framerate` is {rate.tolist()}, not a rate in 1/s")
    at, slack = _places(n, float(rate[0]), video)
    video.warn("AMASS-style bodies taken as in the camera's frame, not in a world.")
    frame = np.flatnonzero(at <= n - 1 + slack)
    at = np.minimum(at[frame], n - 1)
    poses, trans = _between(poses, trans, at)
    betas = np.ravel(numbers_of(data, "betas", None))[:10]
    betas = np.pad(betas, (0, 10 - len(betas)))
    return Rows(
        frame,
        np.zeros(len(frame), np.int64),
        poses,
        np.tile(betas, (len(frame), 1)),
        trans,
        shapes_regressed=False,
    )


def _places(n: int, rate: float, video: Video) -> tuple[np.ndarray, float]:
    """Where in a motion of `n` frames each frame of the video is, and how far beyond
    its end is still its last frame."""
    t, fps = video.num_frames, video.fps
    if t is None:
        t = n if fps is None else round((n - 1) / rate * fps) + 1
        return np.arange(t) * (1.0 if fps is None else rate / fps), 0.5
    if n == t and fps is None:
        return np.arange(float(n)), 0.5
    if fps is None:
        raise Unfit(f"{n} frames at {rate:g}/s, but the video has {t} frames")
    # Its rate may vary, and that of the frames that are used is another one.
    times = np.arange(t) / fps if video.times is None else video.times - video.times[0]
    filmed = float(times[-1]) * t / (t - 1) if t > 1 else 1 / fps
    moved = n / rate
    if n == t and abs(moved / filmed - 1) < _SAME_RATE:
        return np.arange(float(n)), 0.5
    if not 1 / _MAX_RATIO < moved / filmed < _MAX_RATIO:
        raise Unfit(
            f"{n} frames at {rate:g}/s are {moved:.3g} s, but the video has "
            f"{filmed:.3g} s"
        )
    slack = 0.5 * max(1.0, rate / fps)
    if abs(moved - filmed) * rate > 2 * slack:
        what = "the rest left out" if moved > filmed else "nobody after its end"
        video.warn(
            f"motion of {moved:.3g} s for a video of {filmed:.3g} s: both taken to "
            f"begin together, {what}."
        )
    return times * rate, slack


def _between(
    poses: np.ndarray, trans: np.ndarray, at: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Poses (t, 72) and positions between frames; joints turn by the shortest way."""
    low = np.floor(at).astype(np.int64)
    high = np.minimum(low + 1, len(poses) - 1)
    part = (at - low)[:, None]
    a, b = (Rotation.from_rotvec(poses[k].reshape(-1, 3)) for k in (low, high))
    turn = (a.inv() * b).as_rotvec() * np.repeat(part, 24, axis=0)
    between = (a * Rotation.from_rotvec(turn)).as_rotvec().reshape(-1, 72)
    between = np.where(part > 0, between, poses[low])
    return between, (1 - part) * trans[low] + part * trans[high]
