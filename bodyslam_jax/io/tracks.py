"""Point tracks of another tool -> one checked table."""

import logging
from pathlib import Path

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.archive import read_npz
from bodyslam_jax.io.budget import last_frame_problem
from bodyslam_jax.io.frame_index import Warn
from bodyslam_jax.types import Tracks

_log = logging.getLogger(__name__)
_MAX_OUTSIDE_SHARE = 0.1
"""Largest share of the points that may be outside the image."""
_MIN_FINITE_SHARE = 0.5
"""Least share of the observations that are finite."""


def read_tracks(
    path: Path,
    *,
    num_frames: int | None,
    size: tuple[int, int],
    warn: Warn = _log.warning,
) -> Tracks:
    """Reads the arrays `frame` (m,), `landmark` (m,) and `uv` (m, 2; px).

    Observations that are not finite are left out, with a warning.

    **Raises:** `InputError`, naming the file, if they do not fit the video.
    """
    archive = read_npz(path)
    archive.require("frame", "landmark", "uv")
    frame = archive.array("frame", ("m",), finite=False, low=0)
    landmark = archive.array("landmark", ("m",), finite=False)
    uv = archive.array("uv", ("m", 2), finite=False)
    finite = np.isfinite(uv).all(axis=1) & np.isfinite(frame) & np.isfinite(landmark)
    if not finite.all():
        text = f"{int((~finite).sum())} of {len(uv)} observations not finite"
        if finite.mean() < _MIN_FINITE_SHARE:
            raise InputError(f"{path}: {text}.")
        warn(f"tracks: {text}: left out.")
        frame, landmark, uv = frame[finite], landmark[finite], uv[finite]
    if not len(uv):
        raise InputError(f"{path}: no observation.")
    if (frame % 1 != 0).any() or (landmark % 1 != 0).any():
        raise InputError(f"{path}: frame and landmark must be whole numbers from 0.")
    if num_frames is None:
        observed = len(np.unique(frame))
        if problem := last_frame_problem(int(frame.max()), observed, "tracks"):
            raise InputError(f"{path}: {problem}.")
    elif frame.max() >= num_frames:
        raise InputError(
            f"{path}: tracks up to frame {frame.max():.0f}, but the video has "
            f"{num_frames} frames."
        )
    beyond = lambda size: ((uv < -1) | (uv > np.asarray(size))).any(axis=-1).mean()
    outside = beyond(size)
    if outside > _MAX_OUTSIDE_SHARE and beyond(size[::-1]) < outside / 10:
        raise InputError(
            f"the camera file is of {size[0]}x{size[1]} px, but "
            f"{100 * outside:.0f} % of the points of {path} are outside such an image, "
            f"and within {size[1]}x{size[0]} px: are its width and height exchanged, "
            "or the tracks of the image before it was turned?"
        )
    if outside > _MAX_OUTSIDE_SHARE:
        raise InputError(
            f"{path}: {100 * outside:.0f} % of the points outside the image of "
            f"{size[0]}x{size[1]} px: of another video?"
        )
    _, index = np.unique(landmark, return_inverse=True)
    frame = frame.astype(np.int64)
    if len(np.unique(frame * (index.max() + 1) + index)) < len(frame):
        raise InputError(f"{path}: a landmark observed twice in one frame.")
    return Tracks(frame, index.astype(np.int64), uv)
