"""NumPy archives of keypoints, which any program writes easily."""

import math
from typing import Any

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.archive import Archive
from bodyslam_jax.io.budget import last_frame_problem
from bodyslam_jax.io.declared_size import size_in
from bodyslam_jax.io.files import reading
from bodyslam_jax.io.formats import Source
from bodyslam_jax.io.keypoints.keypoint_format import (
    KeypointFormat,
    Listed,
    detector_in,
    part_names,
)

_MAX_METADATA_ENTRIES = 300
"""Largest number of entries of an array that may be metadata."""


class Arrays(KeypointFormat):
    """`keypoints` (t, j, 3) or (h, t, j, 3), or `uv` and `confidence`.

    Without an axis of people it is one person; along the axis, people are tracked.
    """

    name = "arrays (`keypoints`, or `uv` and `confidence`)"

    def recognises(self, source: Source) -> bool:
        names = source.content
        if not isinstance(names, Archive):
            return False
        return "keypoints" in names or ("uv" in names and "confidence" in names)

    def read(self, source: Source, num_frames: int | None) -> Listed:
        path, archive = source.path, source.content
        if "keypoints" in archive:
            shapes = ("t", "j", 3), ("h", "t", "j", 3)
            points = archive.array("keypoints", *shapes, finite=False)
        else:
            shapes = ("t", "j", 2), ("h", "t", "j", 2)
            uv = archive.array("uv", *shapes, finite=False)
            confidence = archive.array("confidence", uv.shape[:-1], finite=False)
            points = np.concatenate([uv, confidence[..., None]], axis=-1)
        header = _header(archive)
        if points.ndim == 3:
            points = points[None]
        if num_frames is not None and points.shape[1] != num_frames:
            raise InputError(
                f"{path}: keypoints of {points.shape[1]} frames, but the video has "
                f"{num_frames}."
            )
        if num_frames is None and (
            problem := last_frame_problem(
                points.shape[1] - 1, points.shape[1], "keypoints"
            )
        ):
            raise InputError(f"{path}: {problem}.")
        rows = [
            (str(k), points[h, k], int(h))
            for h, k in np.argwhere(~(points[..., 2] <= 0).all(axis=-1))
        ]
        return Listed(
            rows,
            [str(k) for k in range(points.shape[1])],
            parts=part_names(header),
            size=size_in(path, header),
            detector=detector_in(header),
        )


def _header(archive: Archive) -> dict[str, Any]:
    """Returns the small arrays of numbers or text beside the keypoints, as lists."""
    found = {}
    for name in archive.names:
        shape, dtype = archive.header(name)
        if math.prod(shape) < _MAX_METADATA_ENTRIES and dtype.kind in "fiuU":
            with reading(archive.path, f"`{name}` of numbers or text"):
                found[name] = archive.raw(name).tolist()
    return found
