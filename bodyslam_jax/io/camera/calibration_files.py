"""Calibrations as other tools write them, recognised by their content.

- Text of numbers: `fx fy cx cy [k1 k2 p1 p2 [k3]]`, as DROID-SLAM, DPVO and WHAM have
  it (`calib.txt`), or a matrix of 3 x 3 (or 3 x 4, 4 x 4 with nothing more in it).
- `.npy` of such a matrix or vector; `.npz` and JSON with `K` or `camera_matrix` and
  distortion coefficients.
- OpenCV's FileStorage (YAML, XML) and ROS's `camera_info` (YAML).
- ORB-SLAM2's and 3's settings (YAML: `Camera.fx` or `Camera1.fx`, ...).
- Pose2Sim's TOML (a table for each camera), Qualisys' `.qca.txt` (XML).

Pixels: the calibrations of all of these are OpenCV's (`cv2.calibrateCamera`, whose
corners have pixel centres at whole numbers), so that nothing is shifted. Qualisys
counts in parts of a pixel whose last, `sensorMaxU`, is at the number of the last pixel
of `fov_video_max`: whole numbers are centres there, too. Its distortion coefficients
have no unit, and so are not divided by 64 as its other numbers are.
"""

import dataclasses
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.archive import read_npy, read_npz
from bodyslam_jax.io.declared import Fields, as_array, as_number, fields
from bodyslam_jax.io.files import (
    read_json,
    read_text,
    read_toml,
    read_xml,
    read_yaml,
    reading,
)

_MATRIX = ("K", "k", "camera_matrix", "cameraMatrix", "intrinsic_matrix", "mtx")
_MATRIX += ("intrinsics", "intrinsic", "cam_K", "cam_intrinsics", "matrix")
_DISTORTION = ("dist", "dist_coeffs", "distCoeffs", "distortion_coefficients", "D")
_DISTORTION += (
    "distortion",
    "distortions",
    "distCoef",
    "dist_coeff",
    "distortion_model",
)
"""Names of the camera matrix and of the distortion coefficients."""
_WIDTH = ("width", "image_width", "imageWidth", "w")
_HEIGHT = ("height", "image_height", "imageHeight", "h")


@dataclasses.dataclass(frozen=True)
class NamedCamera:
    """One camera of a file; pixel centres at whole numbers."""

    name: str
    K: Float[np.ndarray, "3 3"]
    """Camera matrix, px."""
    distortion: Float[np.ndarray, " d"]
    """`k1 k2 p1 p2 [k3 [k4 k5 k6]]`, as OpenCV has them."""
    size: tuple[int, int] | None = None
    """Width and height, px; `None` if the file does not tell."""
    fps: float | None = None
    """1/s"""


def read_named_cameras(path: Path) -> list[NamedCamera] | None:
    """Returns the cameras of a file of one of these kinds; `None` if it is of another.

    **Raises:** `InputError`, naming the file, if it is of one of these kinds but
    something is missing or impossible.
    """
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return [_of_numbers(path, read_npy(path, "a camera matrix (.npy)"))]
    if suffix == ".npz":
        archive = read_npz(path, "a camera matrix (.npz)")
        held = {n: archive.raw(n) for n in archive.names if _is_ours(n)}
        return [_of_names(fields(path, held))]
    if suffix in (".bin", ".r3d", ".csv"):
        return None
    text = read_text(path, "a camera's calibration")
    start = text.lstrip()[:200]
    if start.startswith("<"):
        return _of_xml(path)
    if suffix == ".toml":
        return _of_toml(path)
    if suffix in (".yaml", ".yml") or start.startswith("%YAML"):
        return _of_yaml(fields(path, read_yaml(path, "a camera (YAML)")))
    if start.startswith("{"):
        data = read_json(path, "a camera (JSON)")
        ours = isinstance(data, dict) and "model" not in data and "w" not in data
        if ours and any(name in data for name in (*_MATRIX, "fx")):
            return [_of_names(fields(path, data))]
        return None
    if suffix == ".json":
        rows = read_json(path, "a camera (JSON)")
        return [_of_numbers(path, as_array(path, "matrix", rows))]
    rows = _numbers(text)
    if rows is None:
        return None
    shape = {len(row) for row in rows}
    table = np.array(rows) if len(shape) == 1 else np.concatenate(rows)
    return [_of_numbers(path, table)]


def _numbers(text: str) -> list[list[float]] | None:
    """Returns rows of numbers; `None` if anything else is in the text."""
    rows = []
    for line in text.splitlines():
        words = re.sub(r"[\[\](),;]", " ", line.partition("#")[0]).split()
        try:
            row = [float(word) for word in words]
        except ValueError:
            return None
        if row:
            rows.append(row)
    return rows or None


def _of_numbers(path: Path, values: Any) -> NamedCamera:
    """Returns a camera from a matrix, or from `fx fy cx cy [k1 k2 [p1 p2 [k3]]]`."""
    values = as_array(path, "camera", values)
    flat = values.ravel()
    square = values.shape in ((3, 3), (3, 4), (4, 4))
    if values.ndim == 2 and square:
        return NamedCamera(path.stem, _matrix(path, values), np.zeros(0))
    if flat.size == 9 and np.allclose(flat[[1, 3, 6, 7, 8]], [0, 0, 0, 0, 1]):
        return NamedCamera(path.stem, _matrix(path, flat.reshape(3, 3)), np.zeros(0))
    if min(values.shape, default=0) > 1 or flat.size not in (4, 5, 6, 8, 9):
        raise InputError(
            f"{path}: numbers of shape {values.shape}, expected a matrix of 3 x 3 or "
            "`fx fy cx cy [k1 k2 p1 p2 [k3]]`."
        )
    fx, fy, cx, cy = flat[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return NamedCamera(path.stem, _matrix(path, K), flat[4:].copy())


def _matrix(path: Path, values: Any, place: str = "camera matrix") -> np.ndarray:
    """Returns a checked camera matrix, px, from one of 3 x 3, 3 x 4 or 4 x 4."""
    if isinstance(values, dict):  # OpenCV's and ROS's: rows, cols, data
        held = fields(path, values, place)
        rows, columns = held.whole("rows", 1, 4), held.whole("cols", 1, 4)
        data = held.array("data", (rows * columns,), (rows, columns))
        values = data.reshape(rows, columns)
    values = as_array(path, place, values)
    if values.size == 9 and values.ndim == 1:
        values = values.reshape(3, 3)
    if values.ndim == 3 and len(values):  # one for each frame
        if not np.allclose(values, values[0], rtol=1e-6):
            raise InputError(
                f"{path}: {len(values)} different matrices, expected one of all frames."
            )
        values = values[0]
    if values.shape not in ((3, 3), (3, 4), (4, 4)):
        raise InputError(f"{path}: {place} of shape {values.shape}, expected 3 x 3.")
    K = values[:3, :3].copy()
    rest = values.copy()
    rest[:3, :3] = 0
    if values.shape == (4, 4):
        rest[3, 3] -= 1
    lower = K[[1, 2, 2], [0, 0, 1]]
    is_camera = K[0, 0] > 0 and K[1, 1] > 0 and K[2, 2] == 1
    if np.any(rest) or np.any(lower) or not is_camera:
        raise InputError(
            f"{path}: {place} {np.round(values, 4).tolist()}, expected rows `fx 0 cx`, "
            "`0 fy cy`, `0 0 1`."
        )
    if K[0, 0] < 10 and K[1, 1] < 10:
        raise InputError(
            f"{path}: focal length {K[0, 0]:g}, {K[1, 1]:g}, expected px: it seems in "
            "units of the image; multiply by the video's width and height."
        )
    return K


def _of_names(data: Fields, name: str | None = None) -> NamedCamera:
    """Returns a camera from a matrix and coefficients, or from fx, fy, cx, cy, by
    name."""
    path = data.path
    if any(data.data.get(one) is not None for one in _MATRIX):
        found = data.value(*_MATRIX)
        if isinstance(found, np.ndarray) and found.ndim == 1 and found.size != 9:
            K = _of_numbers(path, found).K
        else:
            K = _matrix(path, found)
    else:
        fx, cx, cy = (data.number(n) for n in ("fx", "cx", "cy"))
        fy = data.number("fy") if data.data.get("fy") is not None else fx
        K = _matrix(path, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
    distortion = np.zeros(0)
    model = str(data.data.get("distortion_model", "plumb_bob"))
    if model in ("equidistant", "fisheye") or data.data.get("fisheye") is True:
        raise InputError(
            f"{path}: a fisheye model, expected OpenCV's: undistort first."
        )
    names = [n for n in _DISTORTION if n != "distortion_model"]
    if any(data.data.get(n) is not None for n in names):
        distortion = _coefficients(path, data.value(*names))
    elif any(n in data for n in ("k1", "k2", "p1", "p2")):
        distortion = _listed(data, "")
    size = None
    if any(data.data.get(n) is not None for n in _WIDTH):
        width, height = data.value(*_WIDTH), data.value(*_HEIGHT)
        size = _size(path, width, height)
    fps = _rate(path, data.data.get("fps"))
    return NamedCamera(name or path.stem, K, distortion, size, fps)


def _coefficients(path: Path, values: Any) -> Float[np.ndarray, " d"]:
    """OpenCV's distortion coefficients, from a list or from its dictionary."""
    if isinstance(values, dict):
        values = fields(path, values, "distortion").value("data")
    found = as_array(path, "distortion", values).ravel()
    # fx fy cx cy and four distortion coefficients.
    if found.size > 8 and not np.any(found[8:]):
        found = found[:8]
    if found.size not in (0, 1, 2, 4, 5, 8):
        raise InputError(
            f"{path}: {found.size} distortion coefficients, expected 4, 5 or 8 of "
            "OpenCV's."
        )
    return found


def _listed(data: Fields, prefix: str) -> Float[np.ndarray, " 5"]:
    """Returns k1 k2 p1 p2 k3 under names of their own."""
    names = [prefix + n for n in ("k1", "k2", "p1", "p2", "k3")]
    return np.array(
        [data.number(n) if data.data.get(n) is not None else 0.0 for n in names]
    )


def _size(path: Path, width: Any, height: Any) -> tuple[int, int]:
    found = [as_number(path, "image size", value, 1, 1e6) for value in (width, height)]
    if any(value % 1 for value in found):
        raise InputError(f"{path}: image size {found}, expected whole pixels.")
    return int(found[0]), int(found[1])


def _rate(path: Path, value: Any) -> float | None:
    return None if value is None else as_number(path, "fps", value, 0.1, 1000)


def _is_ours(name: str) -> bool:
    return name in (*_MATRIX, *_DISTORTION, *_WIDTH, *_HEIGHT, "fps", "fx", "fy") or (
        name in ("cx", "cy", "k1", "k2", "p1", "p2", "k3")
    )


def _of_yaml(data: Fields) -> list[NamedCamera]:
    """ORB-SLAM's settings, OpenCV's FileStorage or ROS's camera_info."""
    path = data.path
    for prefix in ("Camera.", "Camera1."):
        if f"{prefix}fx" not in data:
            continue
        kind = str(data.data.get("Camera.type", "PinHole"))
        if kind.lower() not in ("pinhole", "rectified"):
            raise InputError(
                f"{path}: Camera.type {kind}, expected PinHole: undistort the images "
                "first."
            )
        fx, fy, cx, cy = (data.number(prefix + n) for n in ("fx", "fy", "cx", "cy"))
        K = _matrix(path, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]))
        size = None
        if "Camera.width" in data and "Camera.height" in data:
            size = _size(path, data.value("Camera.width"), data.value("Camera.height"))
        fps = _rate(path, data.data.get("Camera.fps"))
        return [NamedCamera(path.stem, K, _listed(data, prefix), size, fps)]
    return [_of_names(data)]


def _of_toml(path: Path) -> list[NamedCamera]:
    """Pose2Sim's (and aniposelib's): a table with a matrix for each camera."""
    data = read_toml(path, "a calibration (TOML)")
    cameras = []
    for key, table in data.items():
        if not isinstance(table, dict) or "matrix" not in table:
            continue
        held = fields(path, table, key)
        found = _of_names(held, str(table.get("name") or key))
        if table.get("size") is not None:
            size = held.array("size", (2,))
            found = dataclasses.replace(found, size=_size(path, *size.tolist()))
        cameras.append(found)
    if not cameras:
        raise InputError(
            f"{path}: no table with a `matrix` in it, expected one for each camera."
        )
    return cameras


def _of_xml(path: Path) -> list[NamedCamera]:
    """OpenCV's FileStorage or Qualisys' calibration."""
    root = read_xml(path, "a calibration (XML)")
    if root.tag == "opencv_storage":
        data = {child.tag: _opencv_value(path, child) for child in root}
        return [_of_names(fields(path, data))]
    cameras = root.findall("cameras/camera")
    if root.tag != "calibration" or not cameras:
        raise InputError(
            f"{path}: XML of <{root.tag[:40]}>, expected OpenCV's <opencv_storage> or "
            "Qualisys' <calibration> with cameras."
        )
    found = [_qualisys(path, camera, k) for k, camera in enumerate(cameras)]
    active = [c for c, x in zip(found, cameras, strict=True) if x.get("active") != "0"]
    return active or found


def _opencv_value(path: Path, node: ElementTree.Element) -> Any:
    """Returns a value of OpenCV's FileStorage: a matrix, a number or a text."""
    if node.get("type_id") == "opencv-matrix":
        words = (node.findtext("data") or "").split()
        with reading(path, f"numbers in <{node.tag[:40]}>"):
            data = [float(word) for word in words]
            rows, columns = (int(node.findtext(n) or 0) for n in ("rows", "cols"))
        return {"rows": rows, "cols": columns, "data": data}
    text = (node.text or "").strip()
    try:
        return float(text)
    except ValueError:
        return text


def _qualisys(path: Path, camera: ElementTree.Element, k: int) -> NamedCamera:
    """Returns one camera of Qualisys' file: parts of a pixel, of the whole sensor, to
    px."""
    name = camera.get("serial") or str(k)
    turned = camera.get("viewrotation") or "0"
    if turned not in ("0", "0.0"):
        raise InputError(
            f"{path}: the view of camera {name} is turned by {turned[:10]} degrees, "
            "expected 0: give its calibration for the turned images."
        )
    inside = camera.find("intrinsic")
    if inside is None:
        raise InputError(f"{path}: no <intrinsic> of camera {name}.")

    def number(node: ElementTree.Element, attribute: str, other: str = "") -> float:
        text = node.get(attribute) or (node.get(other) if other else None)
        try:
            value = float(text or "")
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            raise InputError(
                f"{path}: `{attribute}` of camera {name} is {text!r:.30}, expected a "
                "number."
            )
        return value

    def window(tag: str) -> np.ndarray | None:
        """Returns left, top, right, bottom: numbers of the first and last pixels."""
        node = camera.find(tag)
        if node is None:
            return None
        sides = ("left", "top", "right", "bottom")
        return np.array([number(node, side) for side in sides])

    low = np.array([number(inside, "sensorMinU"), number(inside, "sensorMinV")])
    high = np.array([number(inside, "sensorMaxU"), number(inside, "sensorMaxV")])
    view = window("fov_video")
    whole = window("fov_video_max")
    whole = view if whole is None else whole
    # Parts per pixel: 64, unless the sensor's pixels are binned.
    parts = np.full(2, 64.0)
    if whole is not None and (whole[2:] > whole[:2]).all():
        parts = (high - low) / (whole[2:] - whole[:2])
    if not (np.all(parts > 0.5) and abs(parts[0] / parts[1] - 1) < 0.02):
        raise InputError(
            f"{path}: the sensor of camera {name} has {parts[0]:.3g} and "
            f"{parts[1]:.3g} units per pixel, expected 64 of both."
        )
    # A last part is not the last pixel's centre in all versions.
    nearest = np.round(parts.mean())
    parts = np.full(
        2, nearest if abs(parts.mean() / nearest - 1) < 0.01 else parts.mean()
    )
    origin = np.zeros(2) if view is None else view[:2]
    last = high / parts if view is None else view[2:]
    width, height = np.round(last - origin).astype(int) + 1
    focal = [number(inside, f"focalLength{a}") / p for a, p in zip("UV", parts)]
    centre = (
        np.array([number(inside, f"centerPoint{a}") for a in "UV"]) / parts - origin
    )
    K = np.array([[focal[0], 0, centre[0]], [0, focal[1], centre[1]], [0, 0, 1.0]])
    radial = [number(inside, f"radialDistortion{i}") for i in (1, 2)]
    tangential = [
        # Spelt without an n in Qualisys' files.
        number(inside, f"tangentalDistortion{i}", f"tangentialDistortion{i}")
        for i in (1, 2)
    ]
    third = float(inside.get("radialDistortion3") or 0.0)
    distortion = np.array([*radial, *tangential, third])
    place = f"camera matrix of {name}"
    return NamedCamera(
        name, _matrix(path, K, place), distortion, (int(width), int(height))
    )
