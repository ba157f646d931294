"""Cameras and poses of COLMAP models (text, binary) and of nerfstudio's files.

COLMAP, `src/colmap/scene/reconstruction_io`: poses are world to camera, quaternions
wxyz, and pixel (0, 0) is the corner of the top-left pixel, half a pixel off the
convention here. nerfstudio: poses are camera to world with OpenGL's axes (y up, z
back), the same pixels.
"""

import dataclasses
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.io.declared import MAX_QUATERNION_ERROR, Fields, as_array, shown
from bodyslam_jax.io.files import read_bytes, read_json_fields, read_lines, reading

_HALF_PIXEL = 0.5
"""Difference of COLMAP's pixel coordinates to those with centres at whole numbers,
px."""
_TRANSFORMS = "nerfstudio's transforms.json"
_MODELS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
)
"""Name and number of parameters of each model, by COLMAP's number."""


@dataclasses.dataclass(frozen=True)
class FoundCamera:
    """One camera of a file; pixel centres at whole numbers."""

    model: str
    width: int
    height: int
    params: list[float]
    """Parameters in COLMAP's order: px, and distortion coefficients."""


def read_cameras(path: Path) -> list[FoundCamera]:
    """Returns cameras of `cameras.txt`, `cameras.bin` or `transforms.json`.

    **Raises:** `InputError`, naming the file, if it is none of these.
    """
    if path.suffix == ".json":
        return [_nerfstudio_camera(read_json_fields(path, _TRANSFORMS))]
    what = "COLMAP's cameras"
    with reading(path, what):
        found = list(_binary_cameras(path) if path.suffix == ".bin" else _text(path))
    if not found:
        raise InputError(f"{path}: no camera in it, expected {what}.")
    return [_centred(path, camera) for camera in found]


def read_poses(path: Path) -> tuple[list[str], Float[np.ndarray, "n 4 4"]]:
    """Returns names of images and their poses T_WC, of `images.txt`, `images.bin` or
    `transforms.json`.

    **Raises:** `InputError`, naming the file, if it is none of these.
    """
    if path.suffix == ".json":
        return _nerfstudio_poses(read_json_fields(path, _TRANSFORMS))
    what = "COLMAP's images"
    with reading(path, what):
        rows = list(_binary_images(path) if path.suffix == ".bin" else _images(path))
    if not rows:
        raise InputError(f"{path}: no image in it, expected {what}.")
    names, numbers = zip(*rows, strict=True)
    # A quaternion and a translation.
    numbers = as_array(path, "poses", list(numbers), (None, 7))
    length = np.linalg.norm(numbers[:, :4], axis=1)
    if (abs(length - 1) > MAX_QUATERNION_ERROR).any():
        raise InputError(f"{path}: a quaternion of length {length.max():.3g}, not 1.")
    R_CW = so3.from_quaternion(numbers[:, [1, 2, 3, 0]])
    T_WC = np.tile(np.eye(4), (len(numbers), 1, 1))
    T_WC[:, :3, :3] = np.swapaxes(R_CW, 1, 2)
    T_WC[:, :3, 3] = -np.einsum("nji,nj->ni", R_CW, numbers[:, 4:])
    return list(names), T_WC


def _centred(path: Path, camera: FoundCamera) -> FoundCamera:
    expected = dict(_MODELS).get(camera.model)
    if expected is None or len(camera.params) != expected:
        known = ", ".join(name for name, _ in _MODELS)
        raise InputError(
            f"{path}: {len(camera.params)} parameters of camera model "
            f"{camera.model[:40]}, expected "
            f"{expected if expected else f'one of {known}'}."
        )
    first = 1 if camera.model.startswith("SIMPLE") or camera.model == "RADIAL" else 2
    params = list(camera.params)
    params[first : first + 2] = _from_corner(*params[first : first + 2])
    return dataclasses.replace(camera, params=params)


def _from_corner(cx: float, cy: float) -> list[float]:
    """Returns the principal point for pixel centres at whole numbers.

    One that is in units of the image stays as it is, and is refused later.
    """
    if max(abs(cx), abs(cy)) <= 1:
        return [cx, cy]
    return [cx - _HALF_PIXEL, cy - _HALF_PIXEL]


def _lines(path: Path) -> Iterator[str]:
    for line in read_lines(path, "COLMAP's text"):
        if not line.startswith("#"):
            yield line.strip()


def _text(path: Path) -> Iterator[FoundCamera]:
    for line in filter(None, _lines(path)):
        _, model, width, height, *params = line.split()
        yield FoundCamera(model, int(width), int(height), [float(p) for p in params])


def _images(path: Path) -> Iterator[tuple[str, list[float]]]:
    """Yields names and poses of `images.txt`, whose lines alternate between an image
    and its points, which may be empty."""
    for line in list(_lines(path))[::2]:
        if line:
            words = line.split(maxsplit=9)
            yield words[9], [float(word) for word in words[1:8]]


class _Reader:
    """Reads consecutive little-endian numbers."""

    def __init__(self, path: Path) -> None:
        self.data, self.at = read_bytes(path, "COLMAP's binary file"), 0

    def take(self, form: str) -> tuple[Any, ...]:
        if self.at > len(self.data):
            raise ValueError(f"ends after {len(self.data)} bytes")
        found = struct.unpack_from("<" + form, self.data, self.at)
        self.at += struct.calcsize("<" + form)
        return found


def _binary_cameras(path: Path) -> Iterator[FoundCamera]:
    reader = _Reader(path)
    for _ in range(reader.take("Q")[0]):
        _, model, width, height = reader.take("iiQQ")
        if not 0 <= model < len(_MODELS):
            raise InputError(f"{path}: camera model number {model}.")
        name, count = _MODELS[model]
        yield FoundCamera(name, width, height, list(reader.take(f"{count}d")))


def _binary_images(path: Path) -> Iterator[tuple[str, list[float]]]:
    reader = _Reader(path)
    for _ in range(reader.take("Q")[0]):
        _, *numbers, _ = reader.take("i7di")
        end = reader.data.index(b"\0", reader.at)
        name = reader.data[reader.at : end].decode()
        reader.at = end + 1
        (points,) = reader.take("Q")
        reader.at += 24 * points
        yield name, numbers


def _nerfstudio_camera(data: Fields) -> FoundCamera:
    frames = list(data.each("frames")) if "frames" in data else []

    def of(name: str) -> Fields:
        """Returns the entries with this value: the file's or its first frame's."""
        is_shared = data.data.get(name) is not None or not frames
        return data if is_shared else frames[0]

    def bent(name: str) -> float:
        within = of(name)
        return within.number(name) if within.data.get(name) is not None else 0.0

    model = "OPENCV"
    if of("camera_model").data.get("camera_model") is not None:
        model = of("camera_model").text("camera_model")
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE"):
        raise InputError(
            f"{data.path}: camera_model {shown(model)}, expected OPENCV or PINHOLE: "
            "undistort the images first."
        )
    fx, fy, cx, cy = (of(n).number(n) for n in ("fl_x", "fl_y", "cx", "cy"))
    width, height = (of(n).whole(n, 1, 1_000_000) for n in ("w", "h"))
    params = [fx, fy, *_from_corner(cx, cy)]
    distortion = [bent(name) for name in ("k1", "k2", "p1", "p2")]
    if any(distortion):
        return FoundCamera("OPENCV", width, height, params + distortion)
    return FoundCamera("PINHOLE", width, height, params)


def _nerfstudio_poses(data: Fields) -> tuple[list[str], Float[np.ndarray, "n 4 4"]]:
    path, rows = data.path, list(data.each("frames"))
    names = [row.text("file_path") for row in rows]
    matrices = [row.array("transform_matrix", (4, 4), (3, 4))[:3] for row in rows]
    if not rows:
        raise InputError(f"{path}: no frame in it, expected {_TRANSFORMS}.")
    found = np.tile(np.eye(4), (len(rows), 1, 1))
    found[:, :3] = np.stack(matrices) * [1.0, -1.0, -1.0, 1.0]
    rigid = found[:, :3, :3] @ np.swapaxes(found[:, :3, :3], 1, 2)
    if np.abs(rigid - np.eye(3)).max() > 0.01:
        raise InputError(f"{path}: a transform_matrix that is no rigid motion.")
    return names, found
