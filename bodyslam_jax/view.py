"""The overlay video: bodies over the frames, tracked points, a map seen from above.

Bodies are drawn by the painter's algorithm: the triangles of a coarser mesh, farthest
first, without those that reach behind the camera.
"""

import concurrent.futures
import contextlib
import dataclasses
import errno
import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Literal

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from bodyslam_jax.body import BodyModel, vertices
from bodyslam_jax.camera import project
from bodyslam_jax.result import Result
from bodyslam_jax.sequence import Tracks

Image = UInt8[np.ndarray, "y x 3"]
_CAMERA: tuple[int, int, int] = (214, 111, 31)
_PEOPLE = ((36, 110, 232), (115, 170, 40), (200, 90, 150), (20, 160, 200))
"""BGR, as in the report."""
_POINT = (90, 230, 120)
_CELL = 0.025
"""Size of the cells in which vertices are merged, m."""
_NEAR = 0.05
"""Triangles that come nearer to the camera's plane than this are not drawn, m."""
_CHUNK = 16
"""Frames whose meshes are computed together."""


def write_overlay(
    path: Path,
    frames: Iterable[Image] | None,
    result: Result,
    body: BodyModel,
    tracks: Tracks | None = None,
    size: tuple[int, int] | None = None,
    max_width: int = 854,
    codec: Literal["VP8", "VP9"] = "VP8",
) -> None:
    """Writes a `.webm` with one image per frame of the result.

    **Arguments:**

    - `frames`: the video, BGR, one image per frame of the result, of the size that the
        intrinsics are for; if it ends early the rest is drawn on black, as is all
        without it.
    - `tracks`: points to draw; `size`: width and height (px) where there are no frames,
        else twice the principal point.
    - `max_width`: larger frames are drawn smaller, px.
    - `codec`: OpenCV cannot ask its VP9 encoder for speed, and VP8, which plays in the
        same browsers, is three times as fast.

    **Raises:** `ValueError` if this OpenCV has no such encoder; `OSError` if the video
    could not be written whole.
    """
    source = iter(frames) if frames is not None else iter(())
    first = next(source, None)
    if first is not None:
        size = (first.shape[1], first.shape[0])
    elif size is None:
        cx, cy = result.intrinsics[2:4]
        size = (round(2 * cx) + 1, round(2 * cy) + 1)
    width = min(size[0], max_width) // 2 * 2
    height = max(2, round(size[1] * width / size[0] / 2) * 2)
    zoom = np.array([width / size[0], height / size[1]])
    t = result.timestamps
    fps = (len(t) - 1) / (t[-1] - t[0]) if len(t) > 1 else 30.0
    fourcc = cv2.VideoWriter.fourcc(*{"VP8": "VP80", "VP9": "VP90"}[codec])
    with _quiet():
        writer = cv2.VideoWriter(
            str(path), cv2.CAP_FFMPEG, fourcc, float(fps), (width, height)
        )
    if not writer.isOpened():
        raise ValueError(f"{path}: OpenCV cannot write {codec} here.")
    pictures = _pictures(first, source, result, body, tracks, (width, height), zoom)
    # Encoding and drawing each keep one core busy, outside of Python's lock.
    with concurrent.futures.ThreadPoolExecutor(1) as encoder:
        pending = None
        for picture in pictures:
            if pending is not None:
                pending.result()
            pending = encoder.submit(writer.write, picture)
    writer.release()
    _check(path, len(t))


def can_write(path: Path, codec: str) -> bool:
    """Whether this OpenCV has the encoder of a four-letter code for such a file."""
    with _quiet():
        fourcc = cv2.VideoWriter.fourcc(*codec)
        writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, fourcc, 30.0, (64, 64))
        found = writer.isOpened()
        writer.release()
    return found


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Standard error closed: OpenCV prints about every `.webm` that all is as it should
    be, and nothing but the file descriptor turns that off."""
    sys.stderr.flush()
    kept, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)


def _check(path: Path, num_frames: int) -> None:
    """OpenCV does not say when a disk is full, but the video is then cut short."""
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    found = 0
    while found < num_frames and capture.grab():
        found += 1
    capture.release()
    if found < num_frames:
        raise OSError(
            errno.ENOSPC, f"{found} of {num_frames} frames written; disk full?", path
        )


def draw_frame(image: Image, result: Result, body: BodyModel, frame: int) -> Image:
    """One frame's bodies over its image, at the image's own size."""
    coarse, faces = coarse_body(body)
    meshes = next(_meshes(result, coarse, slice(frame, frame + 1)))
    return _draw_people(image, meshes, faces, np.ones(2))


def coarse_body(body: BodyModel) -> tuple[BodyModel, Int[np.ndarray, "f 3"]]:
    """The same body with about a quarter of its vertices, and the faces of those.

    Vertices in one cell of a grid over the rest pose are merged into the first of them:
    a subset, so that shape and skinning stay those of the whole body.
    """
    template = np.asarray(body.template)
    cells = np.floor(template / _CELL).astype(np.int64)
    _, kept, cluster = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    # In the body's own order, as runs of vertices are skinned together.
    order = np.argsort(kept)
    kept = kept[order]
    faces = np.argsort(order)[cluster.reshape(-1)][np.asarray(body.faces)]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    arrays = lambda m: (
        [m.template, m.shape_dirs, m.pose_dirs, m.skin_joint] + [m.skin_weight]
    )
    coarse = eqx.tree_at(arrays, body, [x[kept] for x in arrays(body)])
    place = lambda vertex: int(np.searchsorted(kept, vertex))
    runs = tuple((place(i), place(j), joints) for i, j, joints in body.blocks)
    regressor = coarse.joint_regressor[:, kept]
    return dataclasses.replace(coarse, blocks=runs, joint_regressor=regressor), faces


def _pictures(
    first: Image | None,
    source: Iterator[Image],
    result: Result,
    body: BodyModel,
    tracks: Tracks | None,
    size: tuple[int, int],
    zoom: np.ndarray,
) -> Iterator[Image]:
    coarse, faces = coarse_body(body)
    trails = _trails(tracks, len(result.timestamps), zoom)
    plan = _Plan(result, size)
    black = np.zeros((size[1], size[0], 3), np.uint8)
    meshes = _meshes(result, coarse, slice(0, len(result.timestamps)))
    image = first
    for frame, people in enumerate(meshes):
        if image is None:
            picture = black.copy()
        elif image.shape[:2] != (size[1], size[0]):
            picture = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        else:
            picture = image.copy()
        picture = _draw_people(picture, people, faces, zoom)
        _draw_trails(picture, trails[frame])
        plan.draw(picture, frame)
        text = f"frame {frame + 1}/{len(result.timestamps)}"
        text += f"  {result.timestamps[frame]:.2f} s"
        _write(picture, text, (10, size[1] - 12))
        yield picture
        image = next(source, None)


class _Mesh(eqx.Module):
    """One person in one frame."""

    person: int
    p_C: np.ndarray
    """Vertices in the camera frame, m."""
    uv: np.ndarray
    """px"""


@eqx.filter_jit
def _pose(
    body: BodyModel,
    poses: Float[Array, "t 72"],
    betas: Float[Array, " 10"],
    trans: Float[Array, "t 3"],
    T_WC: Float[Array, "t 4 4"],
    intrinsics: Float[Array, " i"],
) -> tuple[Float[Array, "t v 3"], Float[Array, "t v 2"]]:
    p_W = vertices(body, poses, betas, trans)
    p_C = jnp.einsum("tji,tvj->tvi", T_WC[:, :3, :3], p_W - T_WC[:, None, :3, 3])
    return p_C, project(intrinsics, p_C)


def _meshes(result: Result, body: BodyModel, frames: slice) -> Iterator[list[_Mesh]]:
    """The people present in each frame, computed for some frames at a time."""
    cast = lambda x: jnp.asarray(x, body.template.dtype)
    chosen = np.arange(len(result.timestamps))[frames]
    for start in range(0, len(chosen), _CHUNK):
        index = chosen[start : start + _CHUNK]
        padded = np.pad(index, (0, _CHUNK - len(index)), mode="edge")
        drawn = []
        for h in range(len(result.poses)):
            if not result.present[h, index].any():
                continue
            p_C, uv = _pose(
                body,
                cast(result.poses[h, padded]),
                cast(result.betas[h]),
                cast(result.trans[h, padded]),
                cast(result.T_WC[padded]),
                cast(result.intrinsics),
            )
            drawn.append((h, np.asarray(p_C), np.asarray(uv)))
        for k, frame in enumerate(index):
            yield [
                _Mesh(h, p_C[k], uv[k])
                for h, p_C, uv in drawn
                if result.present[h, frame]
            ]


def _draw_people(
    image: Image,
    people: list[_Mesh],
    faces: Int[np.ndarray, "f 3"],
    zoom: np.ndarray,
) -> Image:
    """Shaded bodies, those behind first, blended into the image."""
    height, width = image.shape[:2]
    depth, corners, colors = [], [], []
    for mesh in people:
        # Pixel centres are whole numbers, so the image's edge is at -1/2.
        uv = (mesh.uv + 0.5) * zoom - 0.5
        a, b, c = (mesh.p_C[faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        faces_camera = np.sum(normal * a, 1) < 0
        before = np.minimum(np.minimum(a[:, 2], b[:, 2]), c[:, 2]) > _NEAR
        triangle = uv[faces]
        inside = np.all(triangle.max(1) >= -0.5, 1) & np.all(
            triangle.min(1) <= [width - 0.5, height - 0.5], 1
        )
        shown = faces_camera & before & inside
        light = _lit(normal, faces, len(uv))[shown]
        base = np.array(_PEOPLE[mesh.person % len(_PEOPLE)]) * 0.6 + 255 * 0.4
        depth.append((a + b + c)[shown, 2])
        corners.append(triangle[shown])
        colors.append(light[:, None] * base)
    if not depth or not sum(map(len, depth)):
        return image
    order = np.argsort(-np.concatenate(depth))
    triangles = np.concatenate(corners)[order]
    # Sixteenths of a pixel; far-off corners must not overflow in OpenCV.
    triangles = np.round(np.clip(triangles, -4000, 4000) * 16).astype(np.int32)
    shades = np.concatenate(colors)[order].astype(int).tolist()
    drawn = image.copy()
    for triangle, shade in zip(triangles, shades, strict=True):
        cv2.fillConvexPoly(drawn, triangle, shade, cv2.LINE_8, 4)
    return cv2.addWeighted(drawn, 0.8, image, 0.2, 0)


_LIGHT = np.array([-0.5, -0.62, -0.6])
"""Towards the light, from above and behind the camera, in its frame."""


def _lit(
    normal: Float[np.ndarray, "f 3"], faces: Int[np.ndarray, "f 3"], num_vertices: int
) -> Float[np.ndarray, " f"]:
    """Brightness of each face, smooth: of the mean normal around its corners."""
    around = np.zeros((num_vertices, 3))
    for axis in range(3):
        weight = np.repeat(normal[:, axis], 3)
        around[:, axis] = np.bincount(faces.ravel(), weight, num_vertices)
    smooth = around[faces].sum(1)
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12)
    return 0.3 + 0.7 * np.clip(smooth @ _LIGHT, 0, 1)


def _trails(tracks: Tracks | None, num_frames: int, zoom: np.ndarray) -> list[list]:
    """Of each frame, where its points are and were in the frames before."""
    trails: list[list] = [[] for _ in range(num_frames)]
    if tracks is None:
        return trails
    order = np.lexsort((tracks.frame, tracks.landmark))
    frame, landmark = tracks.frame[order], tracks.landmark[order]
    uv = (tracks.uv[order] + 0.5) * zoom - 0.5
    row = np.arange(len(order))
    begins = np.r_[True, np.diff(landmark) != 0]
    first = np.maximum.accumulate(np.where(begins, row, 0))
    oldest = np.maximum(first, row - 6)
    for k in np.flatnonzero(frame < num_frames):
        trails[frame[k]].append(uv[oldest[k] : k + 1])
    return trails


def _draw_trails(image: Image, trails: list[np.ndarray]) -> None:
    lines = [np.round(trail * 16).astype(np.int32) for trail in trails]
    cv2.polylines(image, lines, False, _POINT, 1, cv2.LINE_AA, 4)
    for line in lines:
        cv2.circle(image, line[-1].tolist(), 2 * 16, _POINT, -1, cv2.LINE_AA, 4)


class _Plan:
    """The inset: camera and people from above on a metric grid, up to a frame."""

    def __init__(self, result: Result, size: tuple[int, int]):
        self.side = int(0.34 * min(size))
        self.result = result
        places = [result.T_WC[:, [0, 2], 3]]
        for joints, here in zip(result.joints, result.present, strict=True):
            places.append(joints[here, 0][:, [0, 2]])
        every = np.concatenate(places)
        low, high = every.min(0), every.max(0)
        self.centre = (low + high) / 2
        extent = max(float((high - low).max()) * 1.2, 2.0)
        self.zoom = self.side / extent
        self.step = next(s for s in (1, 2, 5, 10, 20, 50, 100, 1e6) if extent / s <= 10)
        self.background = self._grid(extent)

    def _to_inset(self, points: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "n 2"]:
        """Seen from above with z up the picture, x runs to the left; in sixteenths."""
        uv = self.side / 2 - self.zoom * (points - self.centre)
        return np.round(uv * 16).astype(np.int32)

    def _grid(self, extent: float) -> Image:
        inset = np.full((self.side, self.side, 3), 28, np.uint8)
        for axis in range(2):
            start = np.ceil((self.centre[axis] - extent / 2) / self.step) * self.step
            lines = np.arange(start, self.centre[axis] + extent / 2, self.step)
            ends = np.tile(self.centre, (len(lines), 2, 1))
            ends[:, :, axis] = lines[:, None]
            ends[:, 0, 1 - axis] -= extent
            ends[:, 1, 1 - axis] += extent
            for a, b in ends:
                a, b = self._to_inset(np.stack([a, b])).tolist()
                cv2.line(inset, a, b, (62, 62, 62), 1, cv2.LINE_AA, 4)
        for path, color in self._paths(len(self.result.timestamps)):
            dim = tuple(int(0.45 * c + 16) for c in color)
            cv2.polylines(inset, [self._to_inset(path)], False, dim, 1, cv2.LINE_AA, 4)
        return inset

    def _paths(self, end: int) -> list[tuple[np.ndarray, tuple[int, int, int]]]:
        paths: list[tuple[np.ndarray, tuple[int, int, int]]]
        paths = [(self.result.T_WC[:end, [0, 2], 3], _CAMERA)]
        for h, here in enumerate(self.result.present):
            seen = np.flatnonzero(here[:end])
            for part in np.split(seen, np.flatnonzero(np.diff(seen) > 1) + 1):
                place = self.result.joints[h, part, 0][:, [0, 2]]
                paths.append((place, _PEOPLE[h % len(_PEOPLE)]))
        return paths

    def draw(self, image: Image, frame: int) -> None:
        """Puts the inset into the upper right corner."""
        inset = self.background.copy()
        for path, color in self._paths(frame + 1):
            if len(path):
                line = self._to_inset(path)
                cv2.polylines(inset, [line], False, color, 2, cv2.LINE_AA, 4)
        for h, here in enumerate(self.result.present):
            if here[frame]:
                place = self.result.joints[h, frame, :1][:, [0, 2]]
                spot = self._to_inset(place)[0].tolist()
                cv2.circle(inset, spot, 5 * 16, _PEOPLE[h % 4], -1, cv2.LINE_AA, 4)
        T = self.result.T_WC[frame]
        reach = 0.12 * self.side / self.zoom
        right, ahead = T[[0, 2], 0], T[[0, 2], 2]
        eye = T[[0, 2], 3]
        wedge = np.stack([eye, eye + reach * (ahead - 0.5 * right)])
        wedge = np.concatenate([wedge, [eye + reach * (ahead + 0.5 * right)]])
        cv2.polylines(inset, [self._to_inset(wedge)], True, _CAMERA, 2, cv2.LINE_AA, 4)
        _write(inset, f"grid {self.step:g} m", (6, self.side - 7), 0.4)
        margin = 10
        corner = image[margin : margin + self.side, -margin - self.side : -margin]
        corner[:] = cv2.addWeighted(inset, 0.85, corner, 0.15, 0)


def _write(image: Image, text: str, place: tuple[int, int], size: float = 0.5) -> None:
    """White on a dark rim: readable on any frame."""
    for color, width in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(
            image,
            text,
            place,
            cv2.FONT_HERSHEY_SIMPLEX,
            size,
            color,
            width,
            cv2.LINE_AA,
        )
