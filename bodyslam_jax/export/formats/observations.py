"""Pixel observations of a run's landmarks, read from the stage results it keeps."""

import dataclasses
import zipfile
import zlib
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.types import Result

_ARRAYS = (".tracks.frame", ".tracks.landmark", ".tracks.uv", ".keep")
_ZOOM = ".zoom"
_UNREADABLE = (ValueError, KeyError, EOFError, OSError, zipfile.BadZipFile, zlib.error)


@dataclasses.dataclass(frozen=True)
class Observations:
    """`m` inlier observations of a result's landmarks."""

    frame: Int[np.ndarray, " m"]
    landmark: Int[np.ndarray, " m"]
    """Index into `Result.landmarks`."""
    uv: Float[np.ndarray, "m 2"]
    """px of the video's images; pixel centres are whole numbers."""
    zoom: Float[np.ndarray, " t"] | None = None
    """Focal length of each frame over that of `Result.intrinsics`; `None` where the
    camera does not zoom."""


def read_observations(run: Path, result: Result) -> Observations | None:
    """Observations from the stage results in the `.cache` of a run folder.

    `None` where the folder keeps none, or none that belong to `result`: a result can
    then still be written, with landmarks that no image refers to.
    """
    found = sorted((run / ".cache").glob("cameras-*.npz"))
    if len(found) != 1 or not len(result.landmarks):
        return None
    try:
        with np.load(found[0], allow_pickle=False) as archive:
            frame, landmark, uv, keep = (archive[name] for name in _ARRAYS)
            zoom = archive[_ZOOM] if _ZOOM in archive.files else None
            num_landmarks = len(archive[".landmarks"])
    except _UNREADABLE:
        return None
    t = len(result.timestamps)
    fits = num_landmarks == len(result.landmarks) and frame.max(initial=0) < t
    if not fits or (zoom is not None and len(zoom) != t):
        return None
    frame, landmark, uv = frame[keep], landmark[keep], uv[keep].astype(np.float64)
    if zoom is None:
        return Observations(frame, landmark, uv)
    # The stages work on images whose zoom is undone about the principal point.
    factor, centre = np.exp(zoom), result.intrinsics[2:4]
    uv = centre + (uv - centre) * factor[frame][:, None]
    return Observations(frame, landmark, uv, factor)
