"""Cameras and poses of COLMAP models (text, binary) and of nerfstudio's files.

COLMAP, `src/colmap/scene/reconstruction_io`: poses are world to camera, quaternions
wxyz, and pixel (0, 0) is the corner of the top-left pixel, half a pixel off the
convention here. nerfstudio: poses are camera to world with OpenGL's axes (y up, z
back), the same pixels.
"""

import dataclasses
import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3_numpy as so3

_HALF = 0.5
"""px that COLMAP's pixel coordinates exceed those with centres at whole numbers."""
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
"""By COLMAP's model number: name, and number of parameters."""


@dataclasses.dataclass(frozen=True)
class FoundCamera:
    """One camera of a file; pixel centres at whole numbers."""

    model: str
    width: int
    height: int
    params: list[float]
    """In COLMAP's order; px, and distortion coefficients."""


def read_cameras(path: Path) -> list[FoundCamera]:
    """Cameras of `cameras.txt`, `cameras.bin` or `transforms.json`.

    **Raises:** `InputError`, naming the file, if it is none of these.
    """
    if path.suffix == ".json":
        return [_nerfstudio_camera(path, _load(path))]
    try:
        found = list(_binary_cameras(path) if path.suffix == ".bin" else _text(path))
    except (struct.error, ValueError, IndexError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not COLMAP's cameras ({error}).") from None
    if not found:
        raise InputError(f"{path}: no camera in it, expected COLMAP's cameras.")
    return [_centred(camera) for camera in found]


def read_poses(path: Path) -> tuple[list[str], Float[np.ndarray, "n 4 4"]]:
    """Names of images and their poses T_WC, of `images.txt`, `images.bin` or
    `transforms.json`.

    **Raises:** `InputError`, naming the file, if it is none of these.
    """
    if path.suffix == ".json":
        return _nerfstudio_poses(path, _load(path))
    try:
        rows = list(_binary_images(path) if path.suffix == ".bin" else _images(path))
    except (struct.error, ValueError, IndexError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not COLMAP's images ({error}).") from None
    if not rows:
        raise InputError(f"{path}: no image in it, expected COLMAP's images.")
    names, numbers = zip(*rows, strict=True)
    numbers = np.asarray(numbers, float)
    if not np.isfinite(numbers).all():
        raise InputError(f"{path}: a pose that is not finite numbers.")
    length = np.linalg.norm(numbers[:, :4], axis=1)
    if (abs(length - 1) > 0.05).any():
        raise InputError(f"{path}: a quaternion of length {length.max():.3g}, not 1.")
    R_CW = so3.from_quaternion(numbers[:, [1, 2, 3, 0]])
    T_WC = np.tile(np.eye(4), (len(numbers), 1, 1))
    T_WC[:, :3, :3] = np.swapaxes(R_CW, 1, 2)
    T_WC[:, :3, 3] = -np.einsum("nji,nj->ni", R_CW, numbers[:, 4:])
    return list(names), T_WC


def _centred(camera: FoundCamera) -> FoundCamera:
    first = 1 if camera.model.startswith("SIMPLE") or camera.model == "RADIAL" else 2
    params = list(camera.params)
    for at in (first, first + 1):
        params[at] -= _HALF
    return dataclasses.replace(camera, params=params)


def _lines(path: Path) -> Iterator[str]:
    for line in path.read_text().splitlines():
        if not line.startswith("#"):
            yield line.strip()


def _text(path: Path) -> Iterator[FoundCamera]:
    for line in filter(None, _lines(path)):
        _, model, width, height, *params = line.split()
        yield FoundCamera(model, int(width), int(height), [float(p) for p in params])


def _images(path: Path) -> Iterator[tuple[str, list[float]]]:
    """Lines alternate between an image and its points, which may be empty."""
    for line in list(_lines(path))[::2]:
        if line:
            words = line.split(maxsplit=9)
            yield words[9], [float(word) for word in words[1:8]]


class _Reader:
    """Little-endian numbers, one after the other."""

    def __init__(self, path: Path) -> None:
        self.data, self.at = path.read_bytes(), 0

    def take(self, form: str) -> tuple[Any, ...]:
        found = struct.unpack_from("<" + form, self.data, self.at)
        self.at += struct.calcsize("<" + form)
        return found


def _binary_cameras(path: Path) -> Iterator[FoundCamera]:
    reader = _Reader(path)
    for _ in range(reader.take("Q")[0]):
        _, model, width, height = reader.take("iiQQ")
        if not 0 <= model < len(_MODELS):
            raise InputError(f"camera model number {model}")
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


def _load(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_text())
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise InputError(f"{path}: not a JSON file ({error}).") from None
    if not isinstance(found, dict):
        raise InputError(f"{path}: a JSON object expected, found a list.")
    return found


def _nerfstudio_camera(path: Path, data: dict[str, Any]) -> FoundCamera:
    frames = data.get("frames")
    first = frames[0] if isinstance(frames, list) and frames else {}

    def value(name: str) -> Any:
        """Of all frames, else of the first; `None` if neither has it."""
        return data.get(name, first.get(name))

    needed = ("fl_x", "fl_y", "cx", "cy", "w", "h")
    missing = [name for name in needed if value(name) is None]
    if missing:
        raise InputError(f"{path}: no {', '.join(missing)}, expected nerfstudio's.")
    model = str(value("camera_model") or "OPENCV")
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE"):
        raise InputError(
            f"{path}: camera_model {model}, expected OPENCV or PINHOLE: "
            "undistort the images first."
        )
    try:
        fx, fy, cx, cy = (float(value(n)) for n in needed[:4])
        bent = [float(value(n) or 0.0) for n in ("k1", "k2", "p1", "p2")]
        width, height = int(value("w")), int(value("h"))
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: numbers expected ({error}).") from None
    params = [fx, fy, cx - _HALF, cy - _HALF]
    if any(bent):
        return FoundCamera("OPENCV", width, height, params + bent)
    return FoundCamera("PINHOLE", width, height, params)


def _nerfstudio_poses(
    path: Path, data: dict[str, Any]
) -> tuple[list[str], Float[np.ndarray, "n 4 4"]]:
    try:
        rows = data["frames"]
        names = [str(row["file_path"]) for row in rows]
        T_WC = np.asarray([row["transform_matrix"] for row in rows], float)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: not nerfstudio's frames ({error!r}).") from None
    if T_WC.ndim != 3 or T_WC.shape[1:] not in ((4, 4), (3, 4)) or not len(T_WC):
        raise InputError(f"{path}: transform_matrix of shape {T_WC.shape[1:]}.")
    found = np.tile(np.eye(4), (len(T_WC), 1, 1))
    found[:, :3] = T_WC[:, :3] * [1.0, -1.0, -1.0, 1.0]
    rigid = found[:, :3, :3] @ np.swapaxes(found[:, :3, :3], 1, 2)
    if not np.isfinite(found).all() or np.abs(rigid - np.eye(3)).max() > 0.01:
        raise InputError(f"{path}: a transform_matrix that is no rigid motion.")
    return names, found
