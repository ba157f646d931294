"""Intrinsics from a camera file, or a guess; projection with them."""

import dataclasses
import logging
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.camera import arkit
from bodyslam_jax.io.camera.calibration_files import NamedCamera, read_named_cameras
from bodyslam_jax.io.camera.colmap import FoundCamera, read_cameras
from bodyslam_jax.io.files import read_json_fields
from bodyslam_jax.io.images import exif_focal_35mm
from bodyslam_jax.types import Intrinsics

_log = logging.getLogger(__name__)

_GUESSED_FOCAL_RATIO = 1.2
"""Focal length over the longer side: COLMAP's default, a field of view of 45
degrees."""

MAX_SIDE_PX = 1_000_000
"""Largest width or height of an image, px: more than any format can hold."""
_MAX_PARAMETER_PX = 1e8
"""Largest parameter, px: a focal length of a hundred times the widest image."""
_IN_FOLDERS = ("cameras.bin", "cameras.txt", "transforms.json", "camera.json")
_IN_FOLDERS = (*_IN_FOLDERS, *arkit.CAMERA_FILES, "calib.txt")
"""Names of cameras' files, by which they are found in a folder."""
_NUM_PARAMS = {"PINHOLE": 4, "SIMPLE_RADIAL": 4, "OPENCV": 8, "SIMPLE_PINHOLE": 3}
"""Models of `camera.json` and the number of their parameters."""
_MAX_MISFIT_PX = 0.5
"""Error, px, by which k1 k2 p1 p2 may differ from a richer model within the image."""


def read_camera(
    path: Path, size: tuple[int, int] | None = None, video: str = ""
) -> tuple[Intrinsics, float | None]:
    """Reads intrinsics, and the frame rate (1/s) if the file has one.

    The file is a `camera.json` (parameters in COLMAP's order, pixel centres at whole
    numbers), COLMAP's `cameras.txt` or `cameras.bin`, nerfstudio's `transforms.json`,
    Stray Scanner's `camera_matrix.csv` or Record3D's `metadata.json`, or a calibration
    of `calibration_files`; or a folder with one of these. `FILE:NAME` names one camera
    of a file that holds several.

    Args:
        size: of the video, px; it selects the camera of a file that holds several, and
            is that of a calibration without a size.
        video: name of the video without its suffix, which may be that of a camera.

    **Raises:** `InputError`, naming the file, if something is missing or impossible.
    """
    path, wanted = split_camera_name(path)
    if path.is_dir():
        inside = [p for name in _IN_FOLDERS if (p := path / name).exists()]
        if not inside:
            raise InputError(
                f"{path}: none of {', '.join(_IN_FOLDERS)} in this folder."
            )
        path = inside[0]
    if not path.exists():
        raise InputError(f"{path}: no such file, expected a camera's.")
    if arkit.is_camera(path):
        return _from_cameras(path, [arkit.read_arkit_camera(path, size)], size), None
    named = read_named_cameras(path)
    if named is not None:
        chosen = _choose_camera(path, named, wanted, video)
        size = chosen.size or size
        if size is None:
            raise InputError(f"{path}: of what image size? It needs the video.")
        params = _opencv_params(path, chosen, size)
        model = "PINHOLE" if len(params) == 4 else "OPENCV"
        found = _intrinsics(path, model, np.array(params), *size)
        return found, chosen.fps
    if path.suffix in (".txt", ".bin"):
        return _from_cameras(path, read_cameras(path), size), None
    data = read_json_fields(path, "a camera (JSON)")
    if "model" not in data and ("fl_x" in data or "frames" in data):
        return _from_cameras(path, read_cameras(path), size), None
    missing = [k for k in ("model", "width", "height", "params") if k not in data]
    if missing:
        found = ", ".join(data.names()[:12])
        raise InputError(f"{path}: no {', '.join(missing)}; only {found}.")
    model = data.text("model", among=tuple(_NUM_PARAMS))
    params = data.array("params", (None,))
    width, height = (data.whole(k, 1, MAX_SIDE_PX) for k in ("width", "height"))
    if len(params) != _NUM_PARAMS[model]:
        raise InputError(
            f"{path}: {len(params)} params for {model}, not {_NUM_PARAMS[model]}."
        )
    intrinsics = _intrinsics(path, model, params, width, height)
    fps = data.number("fps", 0.1, 1000) if data.data.get("fps") is not None else None
    return intrinsics, fps


def split_camera_name(path: Path) -> tuple[Path, str | None]:
    """Returns a file, and the name behind its last colon if the file with the colon
    does not exist."""
    if path.exists() or ":" not in path.name:
        return path, None
    file, _, name = path.name.rpartition(":")
    return path.with_name(file) if file else path, name or None


def _from_cameras(
    path: Path, cameras: list[FoundCamera], size: tuple[int, int] | None
) -> Intrinsics:
    """Returns the video's camera, by its size (px), among those of a file."""
    fitting = [c for c in cameras if size in (None, (c.width, c.height))]
    chosen = fitting or cameras
    same = {(c.model, c.width, c.height, tuple(c.params)) for c in chosen}
    if len(same) > 1:
        raise InputError(
            f"{path}: {len(same)} different cameras, expected the one of this video."
        )
    found = chosen[0]
    if found.model not in (*_NUM_PARAMS, "RADIAL"):
        raise InputError(
            f"{path}: camera model {found.model}, expected one of "
            f"{', '.join(_NUM_PARAMS)} or RADIAL: undistort the images first."
        )
    params = np.asarray(found.params, float)
    return _intrinsics(path, found.model, params, found.width, found.height)


def _intrinsics(
    path: Path, model: str, params: np.ndarray, width: int, height: int
) -> Intrinsics:
    """Returns checked intrinsics in OpenCV's model.

    **Raises:** `InputError`, naming the file, if no camera has such parameters.
    """
    expected = _NUM_PARAMS.get(model, 5)
    if params.shape != (expected,):
        raise InputError(f"{path}: {params.size} params for {model}, not {expected}.")
    params = _from_colmap(model, params)
    is_camera = np.isfinite(params).all() and (params[:2] > 0).all()
    if not is_camera or np.abs(params).max() > _MAX_PARAMETER_PX:
        raise InputError(f"{path}: params {params.tolist()} are not those of a camera.")
    if not (1 <= width <= MAX_SIDE_PX and 1 <= height <= MAX_SIDE_PX):
        raise InputError(f"{path}: size {width}x{height} px is not that of an image.")
    if not (-width < params[2] < 2 * width and -height < params[3] < 2 * height):
        raise InputError(
            f"{path}: principal point {params[2]:g}, {params[3]:g} far outside the "
            f"image of {width}x{height} px."
        )
    return Intrinsics(params, width, height)


def _choose_camera(
    path: Path,
    cameras: Iterable[NamedCamera],
    wanted: str | None,
    video: str,
) -> NamedCamera:
    """Returns the camera of the video among those of a file.

    Args:
        wanted: its name, or its number from 0, as the user gave it.
        video: name of the video, which may name the camera.

    **Raises:** `InputError`, naming the file and its cameras, if it is not clear.
    """
    cameras = list(cameras)
    names = ", ".join(camera.name[:30] for camera in cameras[:12])
    if wanted is not None:
        found = [c for c in cameras if c.name == wanted]
        if not found and wanted.isdigit() and int(wanted) < len(cameras):
            found = [cameras[int(wanted)]]
        if len(found) != 1:
            raise InputError(f"{path}: no camera {wanted!r}, expected one of {names}.")
        return found[0]
    if len(cameras) == 1:
        return cameras[0]
    named = [c for c in cameras if c.name and c.name.lower() == video.lower()]
    if len(named) == 1:
        return named[0]
    raise InputError(
        f"{path}: {len(cameras)} cameras ({names}), expected the video's: add its "
        f"name or number, as in --camera {path}:{cameras[0].name}."
    )


def _opencv_params(
    path: Path, camera: NamedCamera, size: tuple[int, int]
) -> list[float]:
    """Returns `fx fy cx cy`, and `k1 k2 p1 p2` if the camera is distorted.

    A model with more coefficients is fitted by these within the image of `size`, px.

    **Raises:** `InputError`, naming the file, if that leaves an error of more than half
    a pixel, or the axes of the image are not at right angles.
    """
    K, distortion = camera.K, camera.distortion
    if abs(K[0, 1]) > 1e-3 * abs(K[0, 0]):
        raise InputError(f"{path}: a skew of {K[0, 1]:g} px, expected 0: undistort.")
    params = [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]
    _check_centre(path, camera, size)
    if not np.any(distortion):
        return params
    if len(distortion) > 4 and np.any(distortion[4:]):
        distortion = _fitted(path, K, distortion, size)
    four = np.zeros(4)
    four[: min(len(distortion), 4)] = distortion[:4]
    return [*params, *map(float, four)]


def _check_centre(path: Path, camera: NamedCamera, size: tuple[int, int]) -> None:
    """Refuses a calibration without an image size that is of another than `size`."""
    if camera.size is not None:
        return
    x, y = camera.K[0, 2] / (size[0] - 1), camera.K[1, 2] / (size[1] - 1)
    if x > 0 and y > 0 and abs(x / y - 1) < 0.03 and abs(x - 0.5) > 0.05:
        raise InputError(
            f"{path}: principal point {camera.K[0, 2]:g}, {camera.K[1, 2]:g} is the "
            f"centre of images of about {2 * camera.K[0, 2]:.0f}x"
            f"{2 * camera.K[1, 2]:.0f} px, but the video has {size[0]}x{size[1]}: "
            "scale the calibration to the video."
        )
    if not (0 < x < 1 and 0 < y < 1):
        raise InputError(
            f"{path}: principal point {camera.K[0, 2]:g}, {camera.K[1, 2]:g} outside "
            f"the image of {size[0]}x{size[1]} px: calibrated with images of another "
            "size, or in other units? Scale it to the video's."
        )


def _fitted(
    path: Path,
    K: Float[np.ndarray, "3 3"],
    distortion: Float[np.ndarray, " d"],
    size: tuple[int, int],
) -> Float[np.ndarray, " 4"]:
    """Returns k1 k2 p1 p2 that are nearest to a richer model within the image."""
    u, v = np.meshgrid(np.linspace(0, size[0] - 1, 25), np.linspace(0, size[1] - 1, 25))
    uv = np.stack([u.ravel(), v.ravel()], axis=1)[:, None]
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-8)
    xy = cv2.undistortPointsIter(uv, K, distortion, np.eye(3), np.eye(3), stop)[:, 0]
    x, y = xy.T
    r2 = (xy**2).sum(1)
    zero = np.zeros(3)
    rays = np.column_stack([xy, np.ones(len(xy))])
    full = cv2.projectPoints(rays, zero, zero, np.eye(3), distortion)[0][:, 0] - xy
    columns = [
        (x * r2, y * r2),
        (x * r2**2, y * r2**2),
        (2 * x * y, r2 + 2 * y**2),
        (r2 + 2 * x**2, 2 * x * y),
    ]
    A = np.stack([np.concatenate(c) for c in columns], axis=1)
    found = np.linalg.lstsq(A, np.concatenate(full.T), rcond=None)[0]
    misfit = (A @ found - np.concatenate(full.T)).reshape(2, -1) * K[
        [0, 1], [0, 1], None
    ]
    worst = float(np.linalg.norm(misfit, axis=0).max())
    if not worst < _MAX_MISFIT_PX:
        raise InputError(
            f"{path}: distortion {distortion.tolist()} differs by {worst:.1f} px from "
            "any with k1 k2 p1 p2, expected one of these: undistort the images first."
        )
    return found


def guess_camera(
    width: int, height: int, image: Path | None = None, pixel_aspect: float = 1.0
) -> Intrinsics:
    """Returns intrinsics of an unknown camera: from the EXIF data of `image`, else
    typical.

    Args:
        pixel_aspect: width of a pixel over its height.
    """
    longer = max(width * pixel_aspect, height)
    focal = _focal_from_exif(image, longer) if image else None
    focal = focal or _GUESSED_FOCAL_RATIO * longer
    centre = (width - 1) / 2, (height - 1) / 2
    params = np.array([focal / pixel_aspect, focal, *centre])
    return Intrinsics(params, width, height, is_guess=True)


def with_focal(intrinsics: Intrinsics, focal: float, sigma: float) -> Intrinsics:
    """Returns the camera with the focal length fx given by the user (px, standard
    deviation `sigma`); fy keeps its ratio to fx."""
    params = intrinsics.params.copy()
    params[:2] *= focal / params[0]
    return dataclasses.replace(
        intrinsics, params=params, is_guess=False, focal_sigma=sigma
    )


def project_points(intrinsics: Intrinsics, p_C: np.ndarray) -> np.ndarray:
    """Returns pixels (m, 2) of points (m, 3) in the camera frame, m; points behind the
    camera are projected far outside the image."""
    front = p_C[:, 2] > 0.05
    safe = np.where(front[:, None], p_C, [0.0, 0.0, 1.0])
    K, distortion = as_opencv(intrinsics.params)
    uv = cv2.projectPoints(safe, np.zeros(3), np.zeros(3), K, distortion)[0][:, 0]
    return np.where(front[:, None], uv, 1e5)


def rays(
    uv: np.ndarray, K: np.ndarray, distortion: np.ndarray
) -> Float[np.ndarray, "m 2"]:
    """Returns x/z and y/z of pixels (m, 2), with the distortion undone.

    With up to 100 iterations: OpenCV's default of five leaves errors of up to 25 px at
    the edge of a wide lens.
    """
    if not len(uv):
        return np.zeros((0, 2))
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-7)
    uv = np.asarray(uv, float)[:, None]
    rotation, projection = np.eye(3), np.eye(3)  # none: rays, not pixels
    return cv2.undistortPointsIter(uv, K, distortion, rotation, projection, stop)[:, 0]


def as_opencv(params: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns camera matrix and distortion coefficients as cv2 expects them."""
    fx, fy, cx, cy = params[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    # PINHOLE has no distortion coefficients, OPENCV has four.
    return K, params[4:] if len(params) == 8 else np.zeros(4)


def _from_colmap(model: str, params: np.ndarray) -> np.ndarray:
    if model == "SIMPLE_PINHOLE":
        f, cx, cy = params
        return np.array([f, f, cx, cy])
    if model == "SIMPLE_RADIAL":
        f, cx, cy, k = params
        return np.array([f, f, cx, cy, k, 0.0, 0.0, 0.0])
    if model == "RADIAL":
        f, cx, cy, k1, k2 = params
        return np.array([f, f, cx, cy, k1, k2, 0.0, 0.0])
    return params


def _focal_from_exif(image: Path, longer_side: float) -> float | None:
    """Returns the focal length, px, from the 35 mm equivalent in EXIF data; `None`
    without it."""
    equivalent = exif_focal_35mm(image)
    if equivalent is None:
        return None
    _log.info("%s: focal length %g mm (35 mm equivalent).", image.name, equivalent)
    # Film of 35 mm has frames 36 mm wide.
    return equivalent / 36.0 * longer_side
