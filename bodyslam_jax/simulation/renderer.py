"""Renders rooms and people, fast enough for video, in NumPy and OpenCV.

Every rectangle is cast against all pixels of its outline's bounding box: inverse depth
and texture coordinates are linear along each row there, so hidden surfaces and the near
plane take one comparison, and each row may have a camera of its own (rolling shutter).
All textures are stored, at every resolution, in one image (atlas), so that one look-up
draws a frame. The bodies' small triangles are drawn with a z-buffer.
"""

import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic
from bodyslam_jax.motion import FPS
from bodyslam_jax.simulation.figure import Figure, dress
from bodyslam_jax.simulation.raster import (
    Shutter,
    around,
    cameras_at,
    make_texture,
    rasterise,
    vertex_normals,
)
from bodyslam_jax.simulation.room import Room, Surface, texture_size
from bodyslam_jax.simulation.sequences import SimulatedSequence

_NEAR_PLANE_M = 0.05
_MIPMAP_LEVELS = 7
"""Number of resolutions of each texture, each half of the previous one."""
_BORDER_TEXELS = 2
_LEVEL_SCALES = np.float32(0.5) ** np.arange(_MIPMAP_LEVELS, dtype=np.float32)
"""Factor on texture coordinates for each level."""
_NOISE_GREY_LEVELS = 1.5
"""Standard deviation of the image noise at medium grey."""
_MAX_BLUR_IMAGES = 6
"""Number of images that are averaged for motion blur at most."""
_BLUR_STEP_PX = 2.0
"""Motion between two averaged images that is not visible as a step."""

Moving = tuple[
    Float[np.ndarray, "_ 3"], Float[np.ndarray, "_ 3"], Float[np.ndarray, "_ 3"]
]
"""Vertices at a frame, and their first and second difference (`shutter.around`), m."""


def render(simulated: SimulatedSequence) -> Iterator[UInt8[np.ndarray, "rows cols 3"]]:
    """Yields the images (BGR) of a simulated sequence, frame by frame."""
    for image, _ in render_people(simulated):
        yield image


def render_people(
    simulated: SimulatedSequence,
) -> Iterator[tuple[UInt8[np.ndarray, "rows cols 3"], Int[np.ndarray, "rows cols"]]]:
    """Yields the images (BGR), and the person at each pixel: 0 for none, h + 1 for
    person h."""
    rng = np.random.default_rng([simulated.seed, 1])
    actors = simulated.actors
    figures = [
        dress(a.person, one)
        for a, one in zip(actors, rng.spawn(len(actors)), strict=True)
    ]
    renderer = Renderer(
        simulated.room, figures, simulated.intrinsics, simulated.size, rng,
        Shutter(simulated.settings.exposure, simulated.settings.readout),
    )  # fmt: skip
    posed = [
        f.person.joints(a.walk.poses, a.walk.pelvis)
        for f, a in zip(figures, actors, strict=True)
    ]
    last = simulated.num_frames - 1

    @functools.lru_cache(maxsize=4)
    def skins(k: int) -> list[Float[np.ndarray, "v 3"]]:
        return [
            f.person.vertices(G[k], x[k])
            for f, (G, x) in zip(figures, posed, strict=True)
        ]

    for k in range(last + 1):
        window = [skins(i) for i in range(max(k - 1, 0), min(k + 1, last) + 1)]
        moving = [around(np.stack(one), min(k, 1)) for one in zip(*window, strict=True)]
        yield renderer.frame(simulated.T_WC, k, moving)


class Renderer:
    """Renders a room with people from any camera."""

    def __init__(
        self,
        room: Room,
        figures: Sequence[Figure],
        intrinsics: Float[np.ndarray, "4"],
        size: tuple[int, int],
        rng: np.random.Generator,
        shutter: Shutter = Shutter(),
    ):
        self.figures = figures
        self.intrinsics = intrinsics
        self.size = size
        self.shutter = shutter
        self.surfaces = room.faces()
        self.extents = [texture_size(s) for s in self.surfaces]
        textures = [
            make_texture(rng, int(h), int(w), s.kind)
            for s, (h, w) in zip(self.surfaces, self.extents, strict=True)
        ]
        azimuth, height = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(45, 75))
        self.light = np.array(
            [
                np.cos(height) * np.cos(azimuth),
                np.sin(height),
                np.cos(height) * np.sin(azimuth),
            ]
        )
        """Unit vector to the lamp."""
        self.ambient = rng.uniform(0.4, 0.6)
        self.gain = rng.uniform(0.9, 1.1) * rng.uniform(0.95, 1.05, 3)
        lit = [
            _lit(texture, surface, self.light)
            for texture, surface in zip(textures, self.surfaces, strict=True)
        ]
        self.atlas, self.places = _pack([_pyramid(t) for t in lit])
        noise = _NOISE_GREY_LEVELS * rng.standard_normal(
            (size[1] + 64, size[0] + 64, 1)
        )
        noise = noise + 0.4 * _NOISE_GREY_LEVELS * rng.standard_normal(
            (*noise.shape[:2], 3)
        )
        self.noise = noise.astype(np.float32)
        self.rng = rng

    def frame(
        self, T_WC: Float[np.ndarray, "t 4 4"], k: int, people: Sequence[Moving]
    ) -> tuple[UInt8[np.ndarray, "rows cols 3"], Int[np.ndarray, "rows cols"]]:
        """Returns image `k` (BGR) of a camera's path, and the visible person at each
        pixel.

        The second array is 0 for nobody and h + 1 for person h, in the middle of the
        exposure.
        """
        count = self._instants(T_WC, k, people)
        rows = self.shutter.row_times(self.size[1])
        times = self.shutter.instants(count)
        image = np.zeros((self.size[1], self.size[0], 3), np.float32)
        who = np.zeros(image.shape[:2], int)
        normals = [
            vertex_normals(moving[0], figure.person.faces)
            for moving, figure in zip(people, self.figures, strict=True)
        ]
        for i, offset in enumerate(times):
            when = rows + offset if self.shutter.readout else np.array([offset])
            seen, mask = self._instant(
                cameras_at(T_WC, k, when, FPS), when, people, normals
            )
            image += seen
            if i == count // 2:
                who = mask
        image *= (self.gain / count).astype(np.float32)
        y, x = self.rng.integers(0, 64, 2)
        width, height = self.size
        noise = self.noise[y : y + height, x : x + width]
        # Shot noise: its standard deviation grows with the root of the intensity.
        image += noise * np.sqrt(np.maximum(image + 20, 0) / 148)
        return np.clip(image, 0, 255).astype(np.uint8), who

    def _instants(self, T_WC, k: int, people: Sequence[Moving]) -> int:
        """Returns the number of images to average for this exposure."""
        span = self.shutter.exposure
        if span == 0:
            return 1
        ends = np.array([-span / 2, span / 2])
        cameras = cameras_at(T_WC, k, ends, FPS)
        turn = (np.trace(cameras[0, :3, :3].T @ cameras[1, :3, :3]) - 1) / 2
        moved = [np.arccos(np.clip(turn, -1, 1)) * self.intrinsics[0]]
        for moving in people:
            sample = _each(moving, lambda term: term[::97])
            uv = [
                self._project(cameras[i : i + 1], ends[i : i + 1], sample)
                for i in range(2)
            ]
            near = (uv[0][:, 2] > _NEAR_PLANE_M) & (uv[1][:, 2] > _NEAR_PLANE_M)
            way = np.linalg.norm(uv[1][near, :2] - uv[0][near, :2], axis=1)
            moved.append(np.percentile(way, 90) if len(way) else 0.0)
        return int(np.clip(np.ceil(max(moved) / _BLUR_STEP_PX), 1, _MAX_BLUR_IMAGES))

    def _instant(self, T, when, people, normals):
        """Returns a noise-free image and the person at each pixel; `T` has one camera
        per row, or one for all rows."""
        inverse_depth, image, floor = self.render_room(T)
        for moving in people:
            self._shadow(image, floor, T, when, moving)
        who = np.zeros(inverse_depth.shape, int)
        for h, moving in enumerate(people):
            self._body(image, inverse_depth, who, T, when, h, moving, normals[h])
        for h in range(len(people)):
            _soften(image, who == h + 1)
        return image, who

    def _project(
        self,
        T: Float[np.ndarray, "n 4 4"],
        when: Float[np.ndarray, " n"],
        moving: Moving,
    ) -> Float[np.ndarray, "v 3"]:
        """Returns pixel and depth of moving points, each at the exposure time of its
        own row."""
        position, first, second = moving
        at = lambda tau: position + tau * first + tau**2 / 2 * second
        focal, centre = self.intrinsics[:2], self.intrinsics[2:]
        depth = lambda p: np.where(abs(p[:, 2:]) < 1e-6, 1e-6, p[:, 2:])
        middle = len(T) // 2
        R, eye = T[middle, :3, :3], T[middle, :3, 3]
        p = (at(FPS * when[middle]) - eye) @ R
        uv = p[:, :2] / depth(p) * focal + centre
        for _ in range(2 if len(T) > 1 else 0):  # The motion during a row is small.
            row = np.clip(uv[:, 1], 0, len(T) - 1)
            low = np.minimum(row.astype(int), len(T) - 2)
            share = (row - low)[:, None]
            blend = lambda x: (
                x[low] + share.reshape(-1, *[1] * (x.ndim - 1)) * (x[low + 1] - x[low])
            )
            off = at(FPS * blend(when)[:, None]) - blend(T[:, :3, 3])
            p = np.einsum("va,vab->vb", off, blend(T[:, :3, :3]))
            uv = p[:, :2] / depth(p) * focal + centre
        return np.concatenate([uv, p[:, 2:]], axis=1)

    def render_room(self, T):
        """Returns inverse depth (1/m), colours, and a mask of the floor."""
        width, height = self.size
        best = np.full((height, width), 1e-3, np.float32)
        map_x = np.zeros((height, width), np.float32)
        map_y = np.zeros((height, width), np.float32)
        floor = np.zeros((height, width), bool)
        fx, fy, cx, cy = self.intrinsics
        K_inv = np.array([[1 / fx, 0, -cx / fx], [0, 1 / fy, -cy / fy], [0, 0, 1]])
        R, eye = T[:, :3, :3], T[:, :3, 3]
        for i, surface in enumerate(self.surfaces):
            distance = (eye - surface.origin) @ surface.normal
            if distance.min() <= 1e-6:
                continue
            box = self._outline(surface, T)
            if box is None:
                continue
            left, top, right, bottom = box
            # Ray d meets the plane at depth z: 1/z = -n.d / distance, and texture
            # coordinate u = (eye - origin).eu + z d.eu, so u/z is linear in d too.
            h, w = self.extents[i]
            rays = R @ K_inv
            c = -(surface.normal @ rays) / distance[:, None]
            axis_u = surface.edge_u * (w / (surface.edge_u @ surface.edge_u))
            axis_v = surface.edge_v * (h / (surface.edge_v @ surface.edge_v))
            off = eye - surface.origin
            a = axis_u @ rays + (off @ axis_u)[:, None] * c
            b = axis_v @ rays + (off @ axis_v)[:, None] * c
            x = np.arange(left, right, dtype=np.float32)
            y = np.arange(top, bottom)[:, None]
            own = np.s_[top:bottom] if len(T) > 1 else np.s_[:]
            linear = lambda k: (
                k[own, :1].astype(np.float32) * x
                + (k[own, 1:2] * y + k[own, 2:]).astype(np.float32)
            )
            inverse = linear(c)
            z = 1 / np.maximum(inverse, np.float32(1e-3))
            u, v = linear(a) * z, linear(b) * z
            view = best[top:bottom, left:right]
            hit = (inverse > view) & (u >= 0) & (v >= 0) & (u < w) & (v < h)
            if not hit.any():
                continue
            within = np.flatnonzero(hit)
            z, u, v = (part.take(within) for part in (z, u, v))
            # A pixel covers `texels z^3` texels, a quarter of that on each next level.
            middle = len(T) // 2
            texels = abs(np.linalg.det(np.stack([a, b, c])[:, middle]))
            level = np.zeros(len(z), np.intp)
            for k in range(1, _MIPMAP_LEVELS):
                level += z > (4.0 ** (k - 1) / texels) ** (1 / 3)
            shrink = _LEVEL_SCALES.take(level)
            place_x, place_y = self.places[i].T
            row, column = np.divmod(within, right - left)
            pixel = (row + top) * width + (column + left)
            best.reshape(-1)[pixel] = inverse.take(within)
            map_x.reshape(-1)[pixel] = u * shrink - 0.5 + place_x.take(level)
            map_y.reshape(-1)[pixel] = v * shrink - 0.5 + place_y.take(level)
            floor.reshape(-1)[pixel] = surface.kind == "floor"
        image = cv2.remap(self.atlas, map_x, map_y, cv2.INTER_LINEAR)
        return best, image.astype(np.float32), floor

    def _outline(self, surface: Surface, T):
        """Returns the bounding box, px, of the part in front of the near plane, or
        `None`.

        With a camera per row it covers the boxes of several of them, with a margin.
        """
        corners = np.array(
            [surface.origin + a * surface.edge_u + b * surface.edge_v
             for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
        )  # fmt: skip
        kept = []
        for camera in T[:: max(1, (len(T) - 1) // 2)]:
            p = (corners - camera[:3, 3]) @ camera[:3, :3]
            for start, end in zip(p, np.roll(p, -1, axis=0), strict=True):
                if start[2] > _NEAR_PLANE_M:
                    kept.append(start)
                if (start[2] > _NEAR_PLANE_M) != (end[2] > _NEAR_PLANE_M):
                    cut = (_NEAR_PLANE_M - start[2]) / (end[2] - start[2])
                    kept.append(start + (end - start) * cut)
        if not kept:
            return None
        p = np.array(kept)
        margin = 0 if len(T) == 1 else 8
        uv = p[:, :2] / p[:, 2:] * self.intrinsics[:2] + self.intrinsics[2:]
        low = np.clip(np.floor(uv.min(axis=0)) - margin, 0, self.size).astype(int)
        high = np.clip(np.ceil(uv.max(axis=0)) + 1 + margin, 0, self.size).astype(int)
        return None if (high <= low).any() else (*low, *high)

    def _shadow(self, image, floor, T, when, moving: Moving) -> None:
        """Darkens the floor where a person blocks the lamp."""
        flat = np.eye(3) - np.outer([0, 1, 0], self.light / self.light[1])
        uv = self._project(T, when, _each(moving, lambda term: term[::7] @ flat))
        if uv[:, 2].min() < 0.2:
            return
        # The shadow consists of overlapping discs, about 7 cm wide on the floor.
        spot = int(np.clip(0.07 * self.intrinsics[0] / np.median(uv[:, 2]), 3, 41)) | 1
        pixel = uv[:, :2].round().astype(int) + spot
        width, height = self.size
        dark = np.zeros((height + 2 * spot, width + 2 * spot), np.uint8)
        inside = (pixel >= 0) & (pixel < dark.shape[::-1])
        column, row = pixel[inside.all(axis=1)].T
        dark[row, column] = 255
        disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (spot, spot))
        x, y, w, h = cv2.boundingRect(dark)
        x, y = max(x - 2 * spot, 0), max(y - 2 * spot, 0)
        part = np.s_[y : y + h + 4 * spot, x : x + w + 4 * spot]
        dark[part] = cv2.GaussianBlur(cv2.dilate(dark[part], disc), (0, 0), spot / 3)
        dark = dark[spot:-spot, spot:-spot]
        x, y, w, h = cv2.boundingRect(dark)
        part = np.s_[y : y + h, x : x + w]
        share = dark[part].astype(np.float32) * floor[part]
        image[part] *= (1 - (0.55 / 255) * share)[:, :, None]

    def _body(self, image, inverse_depth, who, T, when, h, moving, normal) -> None:
        """Draws a person with smooth shading, using the depth buffer."""
        figure = self.figures[h]
        uv = self._project(T, when, moving)
        if uv[:, 2].min() < _NEAR_PLANE_M:
            return
        hits = rasterise(uv[:, :2], 1 / uv[:, 2], figure.person.faces, inverse_depth)
        if not len(hits.pixel):
            return
        lamp = np.clip(normal @ self.light, 0, 1)
        bright = self.ambient + (1.15 - self.ambient) * lamp + 0.1 * normal[:, 1]
        corners = bright[figure.person.faces[hits.face]]
        light = (corners * hits.weights).sum(axis=1, keepdims=True)
        size = 1 / hits.inverse / self.intrinsics[0]
        image.reshape(-1, 3)[hits.pixel] = light * figure.albedo(hits, size)
        inverse_depth.reshape(-1)[hits.pixel] = hits.inverse
        who.reshape(-1)[hits.pixel] = h + 1


def _pyramid(texture: UInt8[np.ndarray, "h w 3"]) -> list[np.ndarray]:
    levels = [texture]
    while len(levels) < _MIPMAP_LEVELS:
        h, w = levels[-1].shape[:2]
        size = (max(w // 2, 1), max(h // 2, 1))
        levels.append(cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA))
    return levels


def _pack(
    pyramids: list[list[np.ndarray]],
) -> tuple[UInt8[np.ndarray, "h w 3"], Float[np.ndarray, "n levels 2"]]:
    """Packs all images into one; returns it, and the origin (x, y) of each in it,
    px."""
    padded = [
        (i, k, _bordered(image))
        for i, levels in enumerate(pyramids)
        for k, image in enumerate(levels)
    ]
    padded.sort(key=lambda item: -item[2].shape[0])
    # The image is kept square: OpenCV remaps images of up to 32767 rows and columns.
    texels = sum(image.shape[0] * image.shape[1] for _, _, image in padded)
    width = max(*(image.shape[1] for _, _, image in padded), int(texels**0.5))
    places = np.zeros((len(pyramids), _MIPMAP_LEVELS, 2), np.float32)
    x = y = shelf = 0
    where = []
    for i, k, image in padded:
        h, w = image.shape[:2]
        if x + w > width:
            x, y, shelf = 0, y + shelf, 0
        where.append((x, y))
        places[i, k] = x + _BORDER_TEXELS, y + _BORDER_TEXELS
        x, shelf = x + w, max(shelf, h)
    atlas = np.zeros((y + shelf, width, 3), np.uint8)
    for (x, y), (_, _, image) in zip(where, padded, strict=True):
        atlas[y : y + image.shape[0], x : x + image.shape[1]] = image
    return atlas, places


def _bordered(image: np.ndarray) -> np.ndarray:
    """Returns the image with its edge repeated, so that bilinear look-up does not
    bleed."""
    b = _BORDER_TEXELS
    return cv2.copyMakeBorder(image, b, b, b, b, cv2.BORDER_REPLICATE)


def _each(moving: Moving, change: Callable[[np.ndarray], np.ndarray]) -> Moving:
    """Applies a linear `change` to the vertices and to their differences."""
    position, first, second = moving
    return change(position), change(first), change(second)


def _soften(image: Float[np.ndarray, "r c 3"], mask: Bool[np.ndarray, "r c"]) -> None:
    """Softens an outline by one pixel, in place, as a lens does."""
    x, y, w, h = cv2.boundingRect(mask.astype(np.uint8))
    if not w:
        return
    x, y, w, h = max(x - 2, 0), max(y - 2, 0), w + 4, h + 4
    part, small = (
        image[y : y + h, x : x + w],
        mask[y : y + h, x : x + w].astype(np.uint8),
    )
    square = np.ones((3, 3), np.uint8)
    rim = cv2.dilate(small, square) != cv2.erode(small, square)
    soft = cv2.GaussianBlur(part, (3, 3), 0.7)
    part[rim] = soft[rim]


def _lit(
    texture: UInt8[np.ndarray, "h w 3"], surface: Surface, to_light: np.ndarray
) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the texture under a lamp: faces differ in brightness."""
    light = {"floor": 1.0, "ceiling": 0.85}.get(surface.kind)
    if light is None:
        light = 0.8 + 0.25 * float(surface.normal @ to_light)
    return np.clip(texture * np.float32(light), 0, 255).astype(np.uint8)


def write_video(
    path: Path,
    frames: Iterable[UInt8[np.ndarray, "rows cols 3"]],
    fps: float,
    size: tuple[int, int],
) -> None:
    """Writes frames (BGR) to an .mp4 file, atomically.

    **Raises:** `InputError` if OpenCV cannot write one.
    """
    code = cv2.VideoWriter.fourcc(*"mp4v")
    with atomic.replacing(path) as partial:
        writer = cv2.VideoWriter(str(partial), code, fps, size)
        if not writer.isOpened():
            raise InputError(f"{path}: OpenCV cannot write MPEG-4 video there.")
        try:
            for frame in frames:
                writer.write(frame)
        finally:
            writer.release()
