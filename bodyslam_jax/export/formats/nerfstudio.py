"""Writes nerfstudio's `transforms.json` (Tancik et al., 2023), in metres.

Poses are camera to world with OpenGL's camera axes (x right, y up, z back); pixel
coordinates count from the corner of the image. nerfstudio rescales and recentres its
input unless told otherwise: see `docs/export.md`.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from bodyslam_jax.export.folder import write_points
from bodyslam_jax.export.formats.scene import Scene, views_of

_POINTS_FILE = "points.ply"
_OPENGL_FROM_OPENCV = np.diag([1.0, -1.0, -1.0, 1.0])


def write(path: Path, scene: Scene) -> None:
    """Writes `transforms.json`, the map as `points.ply`, and the images of the video.

    Without a video images are only named, `images/frame_000000.jpg`, counted from 0.

    **Raises:** `ValueError` if the video is not the one of the result.
    """
    path.mkdir(parents=True)
    views = views_of(scene, path / "images")
    width, height = scene.size
    data: dict[str, Any] = {"camera_model": "OPENCV", "w": width, "h": height}
    if not views.zooms and len(views.intrinsics):
        data |= _intrinsics(views.intrinsics[0])
    data["frames"] = [
        {
            "file_path": f"images/{name}",
            "transform_matrix": (T_WC @ _OPENGL_FROM_OPENCV).tolist(),
            "time": float(scene.seconds[frame]),
        }
        for name, T_WC, frame in zip(views.names, views.T_WC, views.frames, strict=True)
    ]
    if views.zooms:
        for row, params in zip(data["frames"], views.intrinsics, strict=True):
            row |= _intrinsics(params)
    if len(scene.result.landmarks):
        data["ply_file_path"] = _POINTS_FILE
        write_points(path / _POINTS_FILE, scene.result.landmarks)
    (path / "transforms.json").write_text(json.dumps(data, indent=1) + "\n")


def _intrinsics(params: np.ndarray) -> dict[str, float]:
    names = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2")
    # As many as `names`: those of OPENCV.
    return dict(zip(names, np.pad(params, (0, 8 - len(params))).tolist(), strict=True))
