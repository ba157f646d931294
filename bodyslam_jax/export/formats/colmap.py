"""Writes COLMAP's sparse model, as text and binary, in metres.

COLMAP, `src/colmap/scene/reconstruction_io`: poses are world to camera, quaternions
wxyz; pixel coordinates count from the corner of the image. The folder has the layout
that Gaussian-splatting tools expect: `sparse/0` and, if a video is given, `images`.
"""

import dataclasses
import struct
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from bodyslam_jax.export.formats.scene import (
    PIXEL_CENTRE_OFFSET_PX,
    Observations,
    Scene,
    Views,
    reprojection_errors,
    views_of,
)
from bodyslam_jax.geometry import so3_numpy as so3

_MODEL_IDS = {"PINHOLE": 1, "OPENCV": 4}
"""COLMAP's numbers of camera models."""
_GREY_LEVEL = 128
"""Colour of points, of which none is known: the middle of 0 to 255."""
_MISSING_ERROR_PX = -1.0


@dataclasses.dataclass(frozen=True)
class _Model:
    """A sparse model; cameras, images and points are numbered from 1."""

    views: Views
    size: tuple[int, int]
    q_CW: Float[np.ndarray, "n 4"]
    """Quaternions world to camera, wxyz."""
    t_CW: Float[np.ndarray, "n 3"]
    points: Float[np.ndarray, "l 3"]
    colors: UInt8[np.ndarray, "l 3"]
    errors: Float[np.ndarray, " l"]
    """Mean reprojection error, px; -1 without observations."""
    image: Int[np.ndarray, " m"]
    """Index of the image of each observation, from 0; sorted."""
    index: Int[np.ndarray, " m"]
    """Index of each observation among those of its image."""
    point: Int[np.ndarray, " m"]
    uv: Float[np.ndarray, "m 2"]

    def camera(self, k: int) -> int:
        """Returns the number of image k's camera."""
        return k + 1 if self.views.zooms else 1

    def of_images(self) -> list[np.ndarray]:
        """Returns the indices of the observations of each image."""
        return _grouped(self.image, len(self.views.frames))

    def of_points(self) -> list[np.ndarray]:
        """Returns the indices of the observations of each point."""
        return _grouped(self.point, len(self.points))


def write(path: Path, scene: Scene) -> None:
    """Writes `sparse/0` into a folder, and `images` if the scene has a video.

    Without a video, images are named `frame_000000.jpg`, counted from 0. Without
    observations, points are written that no image refers to.

    **Raises:** `ValueError` if the video is not the one of the result.
    """
    model = _model(scene, views_of(scene, path / "images"))
    folder = path / "sparse" / "0"
    folder.mkdir(parents=True)
    for name, text in (
        ("cameras", _cameras_text),
        ("images", _images_text),
        ("points3D", _points_text),
    ):
        (folder / f"{name}.txt").write_text("\n".join(text(model)) + "\n")
    for name, data in (
        ("cameras", _cameras_binary),
        ("images", _images_binary),
        ("points3D", _points_binary),
    ):
        (folder / f"{name}.bin").write_bytes(data(model))


def _model(scene: Scene, views: Views) -> _Model:
    T_CW = np.linalg.inv(views.T_WC)
    quaternion = so3.quaternion(so3.log(T_CW[:, :3, :3]))[:, [3, 0, 1, 2]]
    points = scene.result.landmarks
    seen = scene.observations
    if seen is None:
        nothing = np.zeros(0, np.int64)
        seen = Observations(nothing, nothing, np.zeros((0, 2)))
    place = np.full(len(scene.result.timestamps), -1)
    place[views.frames] = np.arange(len(views.frames))
    located = np.flatnonzero(place[seen.frame] >= 0)
    order = located[np.argsort(place[seen.frame[located]], kind="stable")]
    seen = Observations(seen.frame[order], seen.landmark[order], seen.uv[order])
    image = place[seen.frame]
    first = np.searchsorted(image, np.arange(len(views.frames)))
    index = np.arange(len(image)) - first[image]
    error = reprojection_errors(scene, seen)
    count = np.bincount(seen.landmark, minlength=len(points))
    total = np.bincount(seen.landmark, error, len(points))
    mean = np.where(count > 0, total / np.maximum(count, 1), _MISSING_ERROR_PX)
    return _Model(
        views=views,
        size=scene.size,
        q_CW=quaternion,
        t_CW=T_CW[:, :3, 3],
        points=points,
        colors=np.full((len(points), 3), _GREY_LEVEL, np.uint8),
        errors=mean,
        image=image,
        index=index,
        point=seen.landmark,
        uv=seen.uv + PIXEL_CENTRE_OFFSET_PX,
    )


def _grouped(key: np.ndarray, num: int) -> list[np.ndarray]:
    """Returns the indices of the rows with each key from 0 to num - 1."""
    order = np.argsort(key, kind="stable")
    return np.split(order, np.searchsorted(key[order], np.arange(1, num)))[:num]


def _cameras_text(model: _Model) -> list[str]:
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for k, params in enumerate(model.views.intrinsics):
        lines.append(
            f"{k + 1} {model.views.model} {_words(model.size)} {_words(params)}"
        )
    return lines


def _images_text(model: _Model) -> list[str]:
    lines = [
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "# POINTS2D[] as (X, Y, POINT3D_ID)",
    ]
    for k, rows in enumerate(model.of_images()):
        pose = _words(np.concatenate([model.q_CW[k], model.t_CW[k]]))
        lines.append(f"{k + 1} {pose} {model.camera(k)} {model.views.names[k]}")
        points = (f"{_words(model.uv[m])} {model.point[m] + 1}" for m in rows)
        lines.append(" ".join(points))
    return lines


def _points_text(model: _Model) -> list[str]:
    lines = [
        "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"
    ]
    for k, rows in enumerate(model.of_points()):
        track = " ".join(f"{model.image[m] + 1} {model.index[m]}" for m in rows)
        words = (_words(model.points[k]), _words(model.colors[k]))
        lines.append(
            f"{k + 1} {' '.join(words)} {model.errors[k]:.9g} {track}".rstrip()
        )
    return lines


def _words(numbers) -> str:
    return " ".join(f"{x:.12g}" for x in numbers)


def _cameras_binary(model: _Model) -> bytes:
    views = model.views
    data = bytearray(struct.pack("<Q", len(views.intrinsics)))
    for k, params in enumerate(views.intrinsics):
        data += struct.pack("<iiQQ", k + 1, _MODEL_IDS[views.model], *model.size)
        data += params.astype("<f8").tobytes()
    return bytes(data)


def _images_binary(model: _Model) -> bytes:
    data = bytearray(struct.pack("<Q", len(model.views.frames)))
    for k, rows in enumerate(model.of_images()):
        pose = (*model.q_CW[k], *model.t_CW[k])
        data += struct.pack("<i7di", k + 1, *pose, model.camera(k))
        data += model.views.names[k].encode() + b"\0"
        points = np.zeros(len(rows), [("uv", "<f8", 2), ("point", "<i8")])
        points["uv"], points["point"] = model.uv[rows], model.point[rows] + 1
        data += struct.pack("<Q", len(rows)) + points.tobytes()
    return bytes(data)


def _points_binary(model: _Model) -> bytes:
    data = bytearray(struct.pack("<Q", len(model.points)))
    for k, rows in enumerate(model.of_points()):
        data += struct.pack("<Q3d", k + 1, *model.points[k])
        data += model.colors[k].tobytes() + struct.pack("<d", model.errors[k])
        track = np.stack([model.image[rows] + 1, model.index[rows]], axis=1)
        data += struct.pack("<Q", len(rows)) + track.astype("<i4").tobytes()
    return bytes(data)
