"""Frames of a video as image files, under the names that camera files refer to."""

import shutil
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.video import frames, list_images, look_at, picked

_JPEG_QUALITY = 95
"""Quality of JPEG files, 0 to 100."""


def frame_name(frame: int, suffix: str = ".jpg") -> str:
    """Returns the name of a frame's image, counted from 0."""
    return f"frame_{frame:06d}{suffix}"


def extract_frames(
    video: Path,
    timestamps: Float[np.ndarray, " t"],
    chosen: Int[np.ndarray, " n"],
    folder: Path,
) -> list[str]:
    """Writes frames of a result into a folder and returns their names.

    Images of a folder are copied, under their own names. Of a video the frames at those
    times are written as `frame_000000.jpg`, numbered as in the result.

    Args:
        timestamps: of all frames of the result, s from the first frame of the video.
        chosen: which of them are written, increasing.

    **Raises:** `InputError`, naming the video, if it is another one.
    """
    rate = (len(timestamps) - 1) / max(np.ptp(timestamps), 1e-9)
    times = look_at(video, rate).timestamps
    files = list_images(video) if video.is_dir() else None
    if len(times) == len(timestamps):
        at = np.arange(len(times))
    else:
        at = np.abs(times[:, None] - timestamps).argmin(axis=0)
        away = np.abs(times[at] - timestamps).max()
        if away > 0.5 / rate or len(np.unique(at)) < len(at):
            raise InputError(
                f"{video}: {len(times)} frames in {times[-1]:.2f} s, expected the "
                f"run's {len(timestamps)}, to {timestamps[-1]:.2f} s: another video."
            )
    folder.mkdir(parents=True, exist_ok=True)
    at = at[chosen]
    if files is not None:
        for k in at:
            shutil.copyfile(files[k], folder / files[k].name)
        return [files[k].name for k in at]
    names = [frame_name(int(k)) for k in chosen]
    images = picked(frames(video), at)
    for name, image in zip(names, images, strict=True):
        _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        (folder / name).write_bytes(data.tobytes())
    return names
