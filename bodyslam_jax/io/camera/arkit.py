"""Camera paths and intrinsics as recorders of Apple's ARKit export them, in metres.

Stray Scanner: a folder with `odometry.csv` (`timestamp, frame, x, y, z, qx, qy, qz,
qw`: camera to world, OpenCV's axes) and `camera_matrix.csv`. Record3D: `metadata.json`,
or `metadata` in an `.r3d` archive (`poses`: `qx qy qz qw x y z`, camera to world with
ARKit's axes, y up and z back; `K` by columns). Pixels have centres at whole numbers,
as in ARKit.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.io.camera.colmap import FoundCamera
from bodyslam_jax.io.declared import MAX_QUATERNION_ERROR, Fields, as_array, fields
from bodyslam_jax.io.files import (
    parse_json,
    read_csv,
    read_json_fields,
    read_zip,
    reading,
)

PATH_FILES = ("odometry.csv", "metadata.json", "metadata")
CAMERA_FILES = ("camera_matrix.csv", "metadata.json", "metadata")
_COLUMNS = ("timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw")
_RECORD3D = "Record3D's metadata"
_MAX_TIME = 1e19
"""Largest time: in nanoseconds since 1970 it has 19 digits."""
_TO_OPENCV = np.array([1.0, -1.0, -1.0])
"""Signs of the camera's axes, from y up and z back to y down and z forward."""


def is_path(path: Path) -> bool:
    """Returns True if a file holds poses of one of these recorders."""
    return (
        path.suffix == ".r3d"
        or path.name == "metadata"
        or path.name == "odometry.csv"
        or (path.suffix == ".json" and _has_poses(path))
    )


def is_camera(path: Path) -> bool:
    """Returns True if a file holds intrinsics of one of these recorders."""
    return path.name == "camera_matrix.csv" or (
        path.name != "odometry.csv" and is_path(path)
    )


def read_arkit_poses(
    path: Path,
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 4 4"]]:
    """Returns times since the first pose (s) and poses T_WC (m, OpenCV's axes).

    **Raises:** `InputError`, naming the file, if it is of none of these recorders.
    """
    if path.suffix == ".csv":
        table = _table(path)
        _check_times(path, table[:, 0])
        return table[:, 0] - table[0, 0], _poses(path, table[:, 5:], table[:, 2:5])
    data = _metadata(path)
    rows = data.array("poses")
    # A quaternion and a position.
    if rows.ndim != 2 or rows.shape[1] != 7 or not len(rows):
        raise InputError(
            f"{path}: poses of shape {rows.shape}, expected rows of "
            "`qx qy qz qw x y z`."
        )
    if data.data.get("frameTimestamps"):
        times = data.array("frameTimestamps", (len(rows),), high=_MAX_TIME)
        _check_times(path, times)
        times = times - times[0]
    else:
        times = np.arange(len(rows)) / data.number("fps", 0.1, 1000)
    T_WC = _poses(path, rows[:, :4], rows[:, 4:])
    T_WC[:, :3, :3] *= _TO_OPENCV
    return times, T_WC


def read_arkit_camera(path: Path, size: tuple[int, int] | None) -> FoundCamera:
    """Returns the camera of a recording; Stray Scanner's file lacks the image's `size`,
    px.

    **Raises:** `InputError`, naming the file, if it is of none of these recorders.
    """
    if path.suffix == ".csv":
        K = _numbers(path, read_csv(path, "a camera matrix"))
        if size is None:
            raise InputError(f"{path}: of what image size? It needs the video.")
        width, height = size
    else:
        data = _metadata(path)
        K = data.array("K", (9,), (3, 3)).reshape(3, 3).T
        width, height = (data.whole(name, 1, 1_000_000) for name in ("w", "h"))
    if K.shape != (3, 3):
        raise InputError(
            f"{path}: a matrix of shape {K.shape}, expected 3 x 3 numbers."
        )
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    return FoundCamera("PINHOLE", width, height, [float(value) for value in params])


def _table(path: Path) -> Float[np.ndarray, "n 9"]:
    head, *rows = read_csv(path, "Stray Scanner's odometry") or [[]]
    names = tuple(word.strip() for word in head)[: len(_COLUMNS)]
    if names != _COLUMNS or not rows:
        raise InputError(
            f"{path}: not Stray Scanner's odometry: columns {', '.join(names)[:80]} "
            f"and {len(rows)} rows, expected {', '.join(_COLUMNS)}."
        )
    return _numbers(path, [row[: len(_COLUMNS)] for row in rows])


def _check_times(path: Path, times: Float[np.ndarray, " n"]) -> None:
    if (np.diff(times) <= 0).any():
        raise InputError(f"{path}: times of poses that do not increase.")


def _numbers(path: Path, rows: list[list[str]]) -> Float[np.ndarray, "n m"]:
    """Returns a table of numbers."""
    with reading(path, "a table of numbers"):
        table = np.array([[float(word) for word in row] for row in rows], float)
    return as_array(path, "table", table, (None, None), high=_MAX_TIME)


def _poses(
    path: Path, xyzw: Float[np.ndarray, "n 4"], position: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 4 4"]:
    length = np.linalg.norm(xyzw, axis=1)
    if (
        not np.isfinite(position).all()
        or not (abs(length - 1) < MAX_QUATERNION_ERROR).all()
    ):
        raise InputError(f"{path}: a pose that is no rotation and position.")
    T_WC = np.tile(np.eye(4), (len(xyzw), 1, 1))
    T_WC[:, :3, :3] = so3.from_quaternion(xyzw)
    T_WC[:, :3, 3] = position
    return T_WC


def _metadata(path: Path) -> Fields:
    if path.suffix != ".r3d":
        return read_json_fields(path, _RECORD3D)
    content = read_zip(path, "Record3D's archive").read("metadata")
    with reading(path, f"{_RECORD3D} in text"):
        text = content.decode()
    return fields(path, parse_json(text, path, _RECORD3D))


def _has_poses(path: Path) -> bool:
    try:
        return "poses" in _metadata(path)
    except InputError:
        return False
