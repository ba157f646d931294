"""Readers and writers of files: video, keypoints, bodies, cameras, masks, tracks.

The names below are imported on first use, so that other packages can use one part, such
as `io.safe_pickle` or `io.atomic`, without loading all readers.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bodyslam_jax.io.bodies.formats.amass import write_body as write_body
    from bodyslam_jax.io.camera.path import read_tum as read_tum
    from bodyslam_jax.io.camera.path import write_tum as write_tum
    from bodyslam_jax.io.detected import with_detections as with_detections
    from bodyslam_jax.io.sequence import read_sequence as read_sequence
    from bodyslam_jax.io.video import frames as frames

_HOME = {
    "frames": "video",
    "read_sequence": "sequence",
    "read_tum": "camera.path",
    "with_detections": "detected",
    "write_body": "bodies.formats.amass",
    "write_tum": "camera.path",
}
__all__ = sorted(_HOME)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'bodyslam_jax.io' has no attribute {name!r}")
    return getattr(importlib.import_module(f"bodyslam_jax.io.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return list(__all__)
