"""Cameras, images and points in the conventions of photogrammetry, which the files of
COLMAP and nerfstudio share."""

import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.export.formats.observations import Observations
from bodyslam_jax.export.formats.scene import Scene
from bodyslam_jax.geometry.camera import project
from bodyslam_jax.io.video import extract_frames, frame_name

PIXEL_CENTRE_OFFSET_PX = 0.5
"""Offset from coordinates with integer pixel centres to those with the origin at the
image's corner."""


@dataclasses.dataclass(frozen=True)
class Views:
    """Located frames, `n` in all, with the intrinsics of each."""

    frames: Int[np.ndarray, " n"]
    """Indices of the result's frames, increasing."""
    names: list[str]
    """Names of their images."""
    T_WC: Float[np.ndarray, "n 4 4"]
    model: str
    """COLMAP's name of the camera model: `PINHOLE` or `OPENCV`."""
    intrinsics: Float[np.ndarray, "c i"]
    """`fx fy cx cy`, with `k1 k2 p1 p2` for `OPENCV`; px from the image's corner. One
    row, or one for each view of a camera that zooms."""

    @property
    def zooms(self) -> bool:
        """Whether each view has intrinsics of its own."""
        return len(self.intrinsics) > 1


def views_of(scene: Scene, images: Path) -> Views:
    """Returns the located frames; their images are written into a folder if there is a
    video.

    **Raises:** `ValueError` if the video is not the one of the result.
    """
    result = scene.result
    frames = np.flatnonzero(result.located)
    if scene.video is None:
        names = [frame_name(int(k)) for k in frames]
    else:
        names = extract_frames(scene.video, result.timestamps, frames, images)
    factor = scene.focal_factor[frames]
    factor = factor if len(factor) and np.ptp(factor) > 0 else factor[:1]
    intrinsics = np.tile(result.intrinsics, (len(factor), 1)).astype(np.float64)
    intrinsics[:, :2] *= factor[:, None]
    intrinsics[:, 2:4] += PIXEL_CENTRE_OFFSET_PX
    model = "PINHOLE" if intrinsics.shape[1] == 4 else "OPENCV"
    return Views(frames, names, result.T_WC[frames], model, intrinsics)


def reprojection_errors(scene: Scene, seen: Observations) -> Float[np.ndarray, " m"]:
    """Returns the distance between each observation and its landmark's projection,
    px."""
    result = scene.result
    T = result.T_WC[seen.frame]
    offset = result.landmarks[seen.landmark] - T[:, :3, 3]
    p_C = np.einsum("mji,mj->mi", T[:, :3, :3], offset)
    intrinsics = np.tile(result.intrinsics, (len(T), 1)).astype(np.float64)
    intrinsics[:, :2] *= scene.focal_factor[seen.frame][:, None]
    uv = np.asarray(project(jnp.asarray(intrinsics), jnp.asarray(p_C)))
    return np.linalg.norm(uv - seen.uv, axis=1)
