"""Given camera poses -> a pose for each frame of the video."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.io.camera import arkit
from bodyslam_jax.io.camera.colmap import read_poses
from bodyslam_jax.io.camera.tum import read_tum
from bodyslam_jax.io.frame_index import InvalidContent, Warn, frames_of_names
from bodyslam_jax.types import CameraPath

_FEWEST = 2
"""Frames with a pose, at least."""
_LONGEST_GAP = 0.5
"""Time between poses across which frames are interpolated, s."""


def read_camera_path(
    path: Path,
    *,
    timestamps: Float[np.ndarray, " t"],
    metric: bool,
    images: tuple[str, ...] = (),
    warn: Warn,
) -> CameraPath:
    """Reads a TUM trajectory, COLMAP's images, nerfstudio's transforms.json, or the
    poses that Stray Scanner or Record3D recorded, which are in metres.

    A trajectory with as many poses as the video has frames is taken frame by frame, any
    other is interpolated at the frames' `timestamps` (s). Images are matched to frames
    by the numbers in their names.

    Args:
        metric: whether the poses are in metres.
        images: names of the video's frames, if it is a folder of images.

    **Raises:** `InputError`, naming the file, if it is none of these or belongs to
    another video.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file, expected a camera path.")
    if path.is_dir():
        names = ("images.bin", "images.txt", "transforms.json", *arkit.PATH_FILES)
        inside = [path / n for n in names]
        path = next((p for p in inside if p.exists()), inside[0])
        if not path.exists():
            raise InputError(f"{path.parent}: no {', '.join(names)} in this folder.")
    count = len(timestamps)
    if arkit.is_path(path):
        metric = True
        times, poses = arkit.read_arkit_poses(path)
        T_WC, known = _at_times(times, poses, timestamps)
    elif path.suffix in (".bin", ".json") or path.name == "images.txt":
        names, poses = read_poses(path)
        try:
            frames = frames_of_names(
                names,
                what="poses",
                num_frames=count,
                images=images,
                complete=False,
                warn=warn,
            )
        except InvalidContent as error:
            raise InputError(f"{path}: {error}.") from None
        T_WC, known = np.tile(np.eye(4), (count, 1, 1)), np.zeros(count, bool)
        at = [frames[name] for name in names]
        T_WC[at], known[at] = poses, True
    else:
        times, poses = read_tum(path)
        if len(times) < _FEWEST:
            raise InputError(f"{path}: one pose, expected {_FEWEST} or more.")
        T_WC, known = _at_times(times, poses, timestamps)
    if known.sum() < _FEWEST:
        raise InputError(
            f"{path}: poses for {known.sum()} of the video's {count} frames, expected "
            f"{_FEWEST} or more: of another video, or another clock?"
        )
    if known.sum() < count:
        warn(f"{path.name}: poses for {known.sum()} of {count} frames.")
    return CameraPath(T_WC, known, metric)


def _at_times(
    times: Float[np.ndarray, " n"],
    poses: Float[np.ndarray, "n 4 4"],
    timestamps: Float[np.ndarray, " t"],
) -> tuple[Float[np.ndarray, "t 4 4"], Bool[np.ndarray, " t"]]:
    """Interpolated poses at the frames' times, and the frames that have one."""
    if len(times) == len(timestamps):
        return poses, np.ones(len(timestamps), bool)
    if times[0] > timestamps[-1]:
        times = times - times[0]  # of another clock, taken to start with the video
    after = np.clip(np.searchsorted(times, timestamps), 1, len(times) - 1)
    gap = times[after] - times[after - 1]
    inside = (timestamps >= times[0] - 1e-6) & (timestamps <= times[-1] + 1e-6)
    known = inside & (gap <= _LONGEST_GAP)
    at = np.clip(timestamps, times[0], times[-1])
    T_WC = np.tile(np.eye(4), (len(timestamps), 1, 1))
    T_WC[:, :3, :3] = so3.interpolate_path(times, poses[:, :3, :3], at)
    for axis in range(3):
        T_WC[:, axis, 3] = np.interp(at, times, poses[:, axis, 3])
    return T_WC, known
