"""Motion of one body in AMASS's style: written, and read for the frames of a video."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.io.atomic import write_npz
from bodyslam_jax.io.bodies.body_format import BodyFormat
from bodyslam_jax.io.bodies.parts import (
    PELVIS_SMPL,
    PELVIS_SMPLX,
    Rows,
    Video,
    numbers_of,
)
from bodyslam_jax.io.formats import Source
from bodyslam_jax.io.frame_index import InvalidContent

_RATES = ("mocap_framerate", "mocap_frame_rate")
"""AMASS's names of the frame rate: in releases with SMPL-H, and with SMPL-X."""
_SMPLX_VALUES = 165
"""Number of values in a pose of SMPL-X: 3 for each of 55 joints."""
_RATE_TOLERANCE = 0.01
"""Relative difference of rates that counts as rounding."""
_MAX_RATIO = 2.5
"""Ratio of the durations of motion and video above which they do not belong
together."""


class Amass(BodyFormat):
    """AMASS style: the motion of one person, taken to be in the camera frame.

    Poses of SMPL (t, 72), SMPL-H (t, 156) or SMPL-X (t, 165), whose first 22 joints are
    the same; `betas` (b,) or (t, b), except that SMPL-X's have another meaning and are
    left out. Motion and video begin together; another frame rate is resampled to the
    times of the video's frames.
    """

    name = "AMASS"
    layout = ("trans", "betas")

    def recognises(self, source: Source) -> bool:
        """Returns True if these are AMASS' arrays, of any of its releases."""
        if not super().recognises(source):
            return False
        names = set(source.content)
        whole = "poses" in names or {"root_orient", "pose_body"} <= names
        return whole and "frame" not in names and bool(names & set(_RATES))

    def read(self, source: Source, video: Video) -> Rows:
        data = source.content
        if "poses" in data:
            poses = numbers_of(data, "poses", None)
        else:
            parts = (numbers_of(data, k, None) for k in ("root_orient", "pose_body"))
            poses = np.concatenate([p.reshape(len(p), -1) for p in parts], axis=-1)
        n = len(poses)
        if poses.ndim != 2 or poses.shape[1] < 66 or not n:
            raise InvalidContent(
                f"`poses` is {poses.shape}, not (t, 72), (t, 156) or (t, 165)"
            )
        smplx = is_smplx(data, poses.shape[1])
        poses, trans = body_pose(poses), numbers_of(data, "trans", (n, 3))
        if smplx:
            trans = trans + PELVIS_SMPLX - PELVIS_SMPL
        key = next(key for key in _RATES if key in data)
        rate = np.ravel(numbers_of(data, key, None))
        if len(rate) != 1 or not 0 < rate[0] < np.inf:
            raise InvalidContent(f"`{key}` is {rate.tolist()}, not a rate in 1/s")
        at, slack = _positions(n, float(rate[0]), video)
        video.warn("AMASS-style bodies taken as in the camera's frame, not in a world.")
        frame = np.flatnonzero(at <= n - 1 + slack)
        at = np.minimum(at[frame], n - 1)
        poses, trans = _between(poses, trans, at)
        betas = np.ravel(numbers_of(data, "betas", None))[: 0 if smplx else 10]
        betas = np.pad(betas, (0, 10 - len(betas)))
        return Rows(
            frame,
            np.zeros(len(frame), np.int64),
            poses,
            np.tile(betas, (len(frame), 1)),
            trans,
            shapes_regressed=smplx,
        )


def is_smplx(data: dict, width: int) -> bool:
    """Returns True if the poses are SMPL-X's, by their width or by
    `surface_model_type`."""
    named = str(np.asarray(data.get("surface_model_type", "")).reshape(-1)[:1])
    return width == _SMPLX_VALUES or "smplx" in named


def write_body(
    path: Path,
    poses: Float[np.ndarray, "t 72"],
    trans: Float[np.ndarray, "t 3"],
    betas: Float[np.ndarray, " 10"],
    fps: float,
    gender: str = "neutral",
    **more: np.ndarray,
) -> None:
    """Writes one person in AMASS's style, at `fps` (1/s), with any `more` arrays."""
    person = {"poses": poses, "trans": trans, "betas": betas}
    rate = {"mocap_framerate": np.array(fps), "gender": np.array(gender)}
    write_npz(path, person | rate | more)


def body_pose(poses: Float[np.ndarray, "t p"]) -> Float[np.ndarray, "t 72"]:
    """SMPL's poses from those of SMPL, SMPL-H or SMPL-X; hands are 0 for the latter."""
    width = 72 if poses.shape[1] == 72 else 66
    return np.pad(poses[:, :width], [(0, 0), (0, 72 - width)])


def _positions(n: int, rate: float, video: Video) -> tuple[np.ndarray, float]:
    """Returns the (fractional) frame of a motion of `n` frames at the time of each
    frame of the video, and the number of frames by which its last one may be
    exceeded."""
    t, fps = video.num_frames, video.fps
    if t is None:
        t = n if fps is None else round((n - 1) / rate * fps) + 1
        return np.arange(t) * (1.0 if fps is None else rate / fps), 0.5
    if n == t and fps is None:
        return np.arange(float(n)), 0.5
    if fps is None:
        raise InvalidContent(f"{n} frames at {rate:g}/s, but the video has {t} frames")
    # The video's rate may vary, so that its times count and not its mean rate.
    times = np.arange(t) / fps if video.times is None else video.times - video.times[0]
    filmed = float(times[-1]) * t / (t - 1) if t > 1 else 1 / fps
    moved = n / rate
    if n == t and abs(moved / filmed - 1) < _RATE_TOLERANCE:
        return np.arange(float(n)), 0.5
    if not 1 / _MAX_RATIO < moved / filmed < _MAX_RATIO:
        raise InvalidContent(
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
    """Returns poses (t, 72) and positions (t, 3) between frames; rotations are
    interpolated on the geodesic."""
    low = np.floor(at).astype(np.int64)
    high = np.minimum(low + 1, len(poses) - 1)
    part = (at - low)[:, None]
    finite = np.asarray(np.isfinite(poses).all(axis=1))[:, None]
    safe = np.where(finite, poses, 0.0)
    a, b = (safe[k].reshape(-1, 24, 3) for k in (low, high))
    turn = part[:, :, None] * so3.between(a, b)
    between = so3.compose(a, turn).reshape(-1, 72)
    between = np.where(part > 0, between, poses[low])
    between = np.where(finite[low] & (finite[high] | (part == 0)), between, np.nan)
    return between, (1 - part) * trans[low] + part * trans[high]
