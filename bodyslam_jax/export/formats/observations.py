"""Reads the pixel observations of a run's landmarks from its cached stage results."""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.archive import read_npz
from bodyslam_jax.types import Result

_ZOOM_KEY = ".zoom"
_MAX_LOG_ZOOM = 10.0
"""Logarithm of a factor on the focal length that exceeds any lens."""


@dataclasses.dataclass(frozen=True)
class Observations:
    """Inlier observations of a result's landmarks, `m` in all."""

    frame: Int[np.ndarray, " m"]
    landmark: Int[np.ndarray, " m"]
    """Index into `Result.landmarks`."""
    uv: Float[np.ndarray, "m 2"]
    """Pixels in the video's images, px; pixel centres have integer coordinates."""
    zoom: Float[np.ndarray, " t"] | None = None
    """Focal length of each frame relative to `Result.intrinsics`; `None` if the camera
    does not zoom."""


def read_observations(run: Path, result: Result) -> Observations | None:
    """Reads the observations from the stage results in the `.cache` of a run folder.

    Returns `None` if the folder has none that belong to `result`: the result can then
    still be exported, with landmarks that no image refers to.
    """
    found = sorted((run / ".cache").glob("cameras-*.npz"))
    if len(found) != 1 or not len(result.landmarks):
        return None
    t, l = len(result.timestamps), len(result.landmarks)
    try:
        archive = read_npz(found[0])
        if archive.header(".landmarks")[0] != (l, 3):
            return None
        index = {"kind": "whole", "low": 0}
        frame = archive.array(".tracks.frame", ("m",), high=t - 1, **index)
        landmark = archive.array(".tracks.landmark", ("m",), high=l - 1, **index)
        uv = archive.array(".tracks.uv", ("m", 2))
        keep = archive.array(".keep", ("m",), kind="boolean")
        zoom = None
        if _ZOOM_KEY in archive:
            zoom = archive.array(
                _ZOOM_KEY, (t,), low=-_MAX_LOG_ZOOM, high=_MAX_LOG_ZOOM
            )
    except InputError:
        return None
    frame, landmark, uv = frame[keep], landmark[keep], uv[keep]
    if zoom is None:
        return Observations(frame, landmark, uv)
    # The stages work on images whose zoom is undone about the principal point.
    factor, centre = np.exp(zoom), result.intrinsics[2:4]
    uv = centre + (uv - centre) * factor[frame][:, None]
    return Observations(frame, landmark, uv, factor)
