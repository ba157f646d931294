"""Camera paths and intrinsics as recorders of Apple's ARKit export them, in metres.

Stray Scanner: a folder with `odometry.csv` (`timestamp, frame, x, y, z, qx, qy, qz,
qw`: camera to world, OpenCV's axes) and `camera_matrix.csv`. Record3D: `metadata.json`,
or `metadata` in an `.r3d` archive (`poses`: `qx qy qz qw x y z`, camera to world with
ARKit's axes, y up and z back; `K` by columns). Pixels have centres at whole numbers,
as in ARKit.
"""

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.io.camera.colmap import FoundCamera

PATH_FILES = ("odometry.csv", "metadata.json", "metadata")
CAMERA_FILES = ("camera_matrix.csv", "metadata.json", "metadata")
_COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
_TO_OPENCV = np.array([1.0, -1.0, -1.0])
"""Signs of the camera's axes, from y up and z back to y down and z forward."""


def is_path(path: Path) -> bool:
    """Whether a file holds poses of one of these recorders."""
    return (
        path.suffix == ".r3d"
        or path.name == "metadata"
        or path.name == "odometry.csv"
        or (path.suffix == ".json" and "poses" in _peek(path))
    )


def is_camera(path: Path) -> bool:
    """Whether a file holds intrinsics of one of these recorders."""
    return path.name == "camera_matrix.csv" or (
        path.name != "odometry.csv" and is_path(path)
    )


def read_arkit_poses(
    path: Path,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 4 4"]]:
    """Times since the first pose (s) and poses T_WC (m, OpenCV's axes).

    **Raises:** `InputError`, naming the file, if it is of none of these recorders.
    """
    if path.suffix == ".csv":
        table = _table(path)
        return table[:, 0] - table[0, 0], _poses(path, table[:, 5:], table[:, 2:5])
    data = _metadata(path)
    try:
        rows = np.asarray(data["poses"], float)
        times = np.arange(len(rows)) / float(data.get("fps") or 0)
        if data.get("frameTimestamps"):
            times = np.asarray(data["frameTimestamps"], float)
            times = times - times[0]
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise InputError(f"{path}: not Record3D's metadata ({error!r}).") from None
    if rows.ndim != 2 or rows.shape[1] != 7 or len(times) != len(rows):
        raise InputError(
            f"{path}: poses of shape {rows.shape} at {len(times)} times, expected rows "
            "of `qx qy qz qw x y z`."
        )
    T_WC = _poses(path, rows[:, :4], rows[:, 4:])
    T_WC[:, :3, :3] *= _TO_OPENCV
    return times, T_WC


def read_arkit_camera(path: Path, size: tuple[int, int] | None) -> FoundCamera:
    """The camera of a recording; Stray Scanner's file lacks the image's `size`, px.

    **Raises:** `InputError`, naming the file, if it is of none of these recorders.
    """
    if path.suffix == ".csv":
        try:
            K = np.loadtxt(path, delimiter=",", ndmin=2)
        except ValueError as error:
            raise InputError(f"{path}: not a matrix ({error}).") from None
        if size is None:
            raise InputError(f"{path}: of what image size? It needs the video.")
        width, height = size
    else:
        data = _metadata(path)
        try:
            K = np.asarray(data["K"], float).reshape(3, 3).T
            width, height = int(data["w"]), int(data["h"])
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: not Record3D's metadata ({error!r}).") from None
    if K.shape != (3, 3) or not np.isfinite(K).all():
        raise InputError(
            f"{path}: a matrix of shape {K.shape}, expected 3 x 3 numbers."
        )
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    return FoundCamera("PINHOLE", width, height, [float(value) for value in params])


def _table(path: Path) -> Float[np.ndarray, "n 9"]:
    try:
        head, *lines = path.read_text().splitlines()
        rows = [line.split(",") for line in lines if line.strip()]
        table = np.asarray(rows, float)
    except (ValueError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not Stray Scanner's odometry ({error}).") from None
    names = tuple(word.strip() for word in head.split(","))[: len(_COLUMNS)]
    if names != _COLUMNS or table.ndim != 2 or table.shape[1] < len(_COLUMNS):
        raise InputError(
            f"{path}: columns {', '.join(names)}, expected {', '.join(_COLUMNS)}."
        )
    return table[:, : len(_COLUMNS)]


def _poses(
    path: Path, xyzw: Float[np.ndarray, "n 4"], position: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 4 4"]:
    length = np.linalg.norm(xyzw, axis=1)
    if not np.isfinite(position).all() or not (abs(length - 1) < 0.05).all():
        raise InputError(f"{path}: a pose that is no rotation and position.")
    T_WC = np.tile(np.eye(4), (len(xyzw), 1, 1))
    T_WC[:, :3, :3] = so3.from_quaternion(xyzw)
    T_WC[:, :3, 3] = position
    return T_WC


def _metadata(path: Path) -> dict[str, Any]:
    try:
        if path.suffix == ".r3d":
            with zipfile.ZipFile(path) as archive:
                found = json.loads(archive.read("metadata"))
        else:
            found = json.loads(path.read_text())
    except (KeyError, ValueError, UnicodeDecodeError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: not Record3D's metadata ({error}).") from None
    if not isinstance(found, dict):
        raise InputError(f"{path}: a JSON object expected, found a list.")
    return found


def _peek(path: Path) -> dict[str, Any]:
    try:
        return _metadata(path)
    except (ValueError, OSError):
        return {}
