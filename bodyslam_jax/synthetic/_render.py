"""Pictures of the room and the walker, quick enough for films, in NumPy and OpenCV.

Every rectangle is cast against all pixels of its outline's bounding box: inverse depth
and texture coordinates are linear in the pixel there, so hidden surfaces and the near
plane take one comparison. All textures lie, at every resolution, in one image, so that
a frame is looked up at once. The body's small triangles go through a z-buffer.
"""

import os
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from bodyslam_jax.synthetic._posing import Person
from bodyslam_jax.synthetic._room import Room, Surface, texture_size
from bodyslam_jax.synthetic._texture import make_texture

_NEAR = 0.05
_LEVELS = 7
_SHRINK = np.float32(0.5) ** np.arange(_LEVELS, dtype=np.float32)
"""Of texture coordinates, level by level."""
_BORDER = 2
_TEXELS = 130.0
"""Texels a metre: a camera of 525 px sees them one to one from 4 m."""
_LIGHT = np.array([0.35, 0.85, 0.4])
_LIGHT /= np.linalg.norm(_LIGHT)
_SPOT = 9
"""Width of the discs that a shadow is made of, px."""
_NOISE = 1.5
"""Standard deviation of the image noise, grey levels."""


class Renderer:
    """A room and a person in it, ready to be seen from anywhere."""

    def __init__(
        self,
        room: Room,
        person: Person,
        intrinsics: Float[np.ndarray, "4"],
        size: tuple[int, int],
        rng: np.random.Generator,
    ):
        self.person = person
        self.intrinsics = intrinsics
        self.size = size
        self.surfaces = room.faces()
        self.extents = [texture_size(s, _TEXELS) for s in self.surfaces]
        textures = [
            make_texture(rng, int(h), int(w), s.kind, _TEXELS)
            for s, (h, w) in zip(self.surfaces, self.extents, strict=True)
        ]
        lit = [
            _lit(texture, surface)
            for texture, surface in zip(textures, self.surfaces, strict=True)
        ]
        self.atlas, self.places = _pack([_pyramid(t) for t in lit])
        self.colours = clothes(rng, person)
        noise = _NOISE * rng.standard_normal((size[1] + 64, size[0] + 64, 1))
        self.noise = np.repeat(noise, 3, axis=2).round().astype(np.int16)
        self.rng = rng

    def frame(
        self,
        T_WC: Float[np.ndarray, "4 4"],
        vertices: Float[np.ndarray, "v 3"],
    ) -> tuple[UInt8[np.ndarray, "rows cols 3"], Bool[np.ndarray, "rows cols"]]:
        """The image (BGR) from camera `T_WC`, and where the person is in it."""
        inverse_depth, image, floor = self._room(T_WC)
        self._shadow(image, floor, T_WC, vertices)
        mask = self._body(image, inverse_depth, T_WC, vertices)
        y, x = self.rng.integers(0, 64, 2)
        width, height = self.size
        noisy = image + self.noise[y : y + height, x : x + width]
        return np.clip(noisy, 0, 255).astype(np.uint8), mask

    def _room(self, T_WC):
        """Inverse depth, colours and which pixels are floor."""
        width, height = self.size
        best = np.full((height, width), 1e-3, np.float32)
        map_x = np.zeros((height, width), np.float32)
        map_y = np.zeros((height, width), np.float32)
        floor = np.zeros((height, width), bool)
        fx, fy, cx, cy = self.intrinsics
        K_inv = np.array([[1 / fx, 0, -cx / fx], [0, 1 / fy, -cy / fy], [0, 0, 1]])
        R, eye = T_WC[:3, :3], T_WC[:3, 3]
        for i, surface in enumerate(self.surfaces):
            distance = (eye - surface.origin) @ surface.normal
            if distance <= 1e-6:
                continue
            box = self._outline(surface, R, eye)
            if box is None:
                continue
            left, top, right, bottom = box
            # Ray d meets the plane at depth z: 1/z = -n.d / distance, and texture
            # coordinate u = (eye - origin).eu + z d.eu, so u/z is linear in d too.
            h, w = self.extents[i]
            rays = R @ K_inv
            c = -(surface.normal @ rays) / distance
            axis_u = surface.edge_u * (w / (surface.edge_u @ surface.edge_u))
            axis_v = surface.edge_v * (h / (surface.edge_v @ surface.edge_v))
            off = eye - surface.origin
            a = axis_u @ rays + (off @ axis_u) * c
            b = axis_v @ rays + (off @ axis_v) * c
            x = np.arange(left, right, dtype=np.float32)
            y = np.arange(top, bottom, dtype=np.float32)[:, None]
            linear = lambda k: (
                np.float32(k[0]) * x + (np.float32(k[1]) * y + np.float32(k[2]))
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
            # A pixel has `texels z^3` of them; a level further down has a quarter.
            texels = abs(np.linalg.det(np.stack([a, b, c])))
            level = np.zeros(len(z), np.intp)
            for k in range(1, _LEVELS):
                level += z > (4.0 ** (k - 1) / texels) ** (1 / 3)
            shrink = _SHRINK.take(level)
            place_x, place_y = self.places[i].T
            row, column = np.divmod(within, right - left)
            pixel = (row + top) * width + (column + left)
            best.reshape(-1)[pixel] = inverse.take(within)
            map_x.reshape(-1)[pixel] = u * shrink - 0.5 + place_x.take(level)
            map_y.reshape(-1)[pixel] = v * shrink - 0.5 + place_y.take(level)
            floor.reshape(-1)[pixel] = surface.kind == "floor"
        image = cv2.remap(self.atlas, map_x, map_y, cv2.INTER_LINEAR)
        return best, image.astype(np.float32), floor

    def _outline(self, surface: Surface, R, eye):
        """Bounding box, px, of what is in front of the near plane; or `None`."""
        corners = [surface.origin + a * surface.edge_u + b * surface.edge_v
                   for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]  # fmt: skip
        p = (np.array(corners) - eye) @ R
        kept = []
        for start, end in zip(p, np.roll(p, -1, axis=0), strict=True):
            if start[2] > _NEAR:
                kept.append(start)
            if (start[2] > _NEAR) != (end[2] > _NEAR):
                kept.append(
                    start + (end - start) * ((_NEAR - start[2]) / (end[2] - start[2]))
                )
        if not kept:
            return None
        p = np.array(kept)
        uv = p[:, :2] / p[:, 2:] * self.intrinsics[:2] + self.intrinsics[2:]
        low = np.clip(np.floor(uv.min(axis=0)), 0, self.size).astype(int)
        high = np.clip(np.ceil(uv.max(axis=0)) + 1, 0, self.size).astype(int)
        return None if (high <= low).any() else (*low, *high)

    def _shadow(self, image, floor, T_WC, vertices) -> None:
        """Darkens the floor where the light that comes from above does not reach."""
        where = vertices - _LIGHT * (vertices[:, 1:2] / _LIGHT[1])
        p = (where[::7] - T_WC[:3, 3]) @ T_WC[:3, :3]
        if p[:, 2].min() < 0.2:
            return
        uv = p[:, :2] / p[:, 2:] * self.intrinsics[:2] + self.intrinsics[2:]
        pixel = uv.round().astype(int) + _SPOT
        width, height = self.size
        dark = np.zeros((height + 2 * _SPOT, width + 2 * _SPOT), np.uint8)
        inside = (pixel >= 0) & (pixel < dark.shape[::-1])
        column, row = pixel[inside.all(axis=1)].T
        dark[row, column] = 255
        centre = (_SPOT // 2, _SPOT // 2)
        disc = np.zeros((_SPOT, _SPOT), np.uint8)
        cv2.circle(disc, centre, _SPOT // 2, 1, -1)
        dark = cv2.dilate(dark, disc)[_SPOT:-_SPOT, _SPOT:-_SPOT]
        soft = cv2.GaussianBlur(dark, (0, 0), 3.0)
        x, y, w, h = cv2.boundingRect(soft)
        part = np.s_[y : y + h, x : x + w]
        share = soft[part].astype(np.float32) * floor[part]
        image[part] *= (1 - (0.45 / 255) * share)[:, :, None]

    def _body(self, image, inverse_depth, T_WC, vertices) -> Bool[np.ndarray, "r c"]:
        """Draws the mesh with smooth shading; the pixels that are the person's."""
        p = (vertices - T_WC[:3, 3]) @ T_WC[:3, :3]
        mask = np.zeros(inverse_depth.shape, bool)
        if p[:, 2].min() < _NEAR:
            return mask
        uv = p[:, :2] / p[:, 2:] * self.intrinsics[:2] + self.intrinsics[2:]
        faces = self.person.faces
        normal = vertex_normals(vertices, faces)
        light = 0.45 + 0.65 * np.clip(normal @ _LIGHT, 0, 1) + 0.08 * normal[:, 1]
        colour = self.colours * light[:, None]
        pixel, face = rasterise(uv, 1 / p[:, 2], faces, inverse_depth)
        a, b, c = (colour[faces[face, k]] for k in range(3))
        image.reshape(-1, 3)[pixel] = (a + b + c) / 3
        mask.reshape(-1)[pixel] = True
        # A camera has no hard edges: soften the outline by one pixel.
        grown = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8))
        inner = cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8))
        rim = grown != inner
        rows, columns = np.nonzero(grown)
        if len(rows):
            part = np.s_[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
            soft = cv2.GaussianBlur(image[part], (3, 3), 0.7)
            image[part][rim[part]] = soft[rim[part]]
        return mask


def rasterise(
    uv: Float[np.ndarray, "v 2"],
    inverse: Float[np.ndarray, " v"],
    faces: Int[np.ndarray, "f 3"],
    inverse_depth: Float[np.ndarray, "rows cols"],
) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
    """Flat pixel numbers and the face that is seen there, in front of what there is.

    Triangles are small, so each tries all pixels of its bounding box; those of equal
    box size go together.
    """
    rows, columns = inverse_depth.shape
    a, b, c = (uv[faces[:, k]] for k in range(3))
    edge1, edge2 = b - a, c - a
    area = edge1[:, 0] * edge2[:, 1] - edge1[:, 1] * edge2[:, 0]
    low = np.ceil(np.minimum(np.minimum(a, b), c)).astype(np.int64)
    high = np.floor(np.maximum(np.maximum(a, b), c)).astype(np.int64)
    low, high = np.maximum(low, 0), np.minimum(high, [columns - 1, rows - 1])
    # Counter-clockwise seen from outside, which an image with y down turns round.
    size = high - low + 1
    seen = (area < -1e-12) & (size[:, 0] > 0) & (size[:, 1] > 0)
    extent = np.maximum(size[:, 0], size[:, 1])
    pixels, owners, depths = [], [], []
    side = 1
    while seen.any():
        now = np.flatnonzero(seen & (extent <= side))
        seen[now] = False
        if len(now):
            step = np.arange(side)
            x = (low[now, 0, None, None] + step).astype(float)
            y = (low[now, 1, None, None] + step[:, None]).astype(float)
            x, y = np.broadcast_arrays(x, y)
            dx = x - a[now, 0, None, None]
            dy = y - a[now, 1, None, None]
            e1, e2 = edge1[now, :, None, None], edge2[now, :, None, None]
            scale = 1 / area[now, None, None]
            s = (dx * e2[:, 1] - dy * e2[:, 0]) * scale
            t = (dy * e1[:, 0] - dx * e1[:, 1]) * scale
            hit = (s >= 0) & (t >= 0) & (s + t <= 1) & (x < columns) & (y < rows)
            which, i, j = np.nonzero(hit)
            first, second, third = inverse[faces[now[which]]].T
            s, t = s[which, i, j], t[which, i, j]
            pixels.append((low[now[which], 1] + i) * columns + low[now[which], 0] + j)
            owners.append(now[which])
            depths.append(first + s * (second - first) + t * (third - first))
        side *= 2
    if not pixels:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    pixel, owner = np.concatenate(pixels), np.concatenate(owners)
    depth = np.concatenate(depths)
    front = depth > inverse_depth.reshape(-1)[pixel]
    pixel, owner, depth = pixel[front], owner[front], depth[front]
    order = np.lexsort((-depth, pixel))
    pixel, owner = pixel[order], owner[order]
    first = np.flatnonzero(np.diff(pixel, prepend=-1))
    return pixel[first], owner[first]


def vertex_normals(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "v 3"]:
    """Unit normals, the area-weighted mean of those of the faces around."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    of_face = np.cross(b - a, c - a)
    normal = np.stack(
        [
            sum(
                np.bincount(faces[:, k], of_face[:, i], len(vertices)) for k in range(3)
            )
            for i in range(3)
        ],
        axis=1,
    )
    return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)


def clothes(rng: np.random.Generator, person: Person) -> Float[np.ndarray, "v 3"]:
    """Colours (BGR) of a shirt, trousers, shoes, skin and hair, by nearest joint."""
    joint = person.weights.argmax(axis=1)
    skin = np.array([110, 140, 190.0]) * rng.uniform(0.5, 1.15)
    shirt = rng.uniform(60, 190) + rng.uniform(-45, 45, 3)
    trousers = rng.uniform(35, 110) + rng.uniform(-20, 20, 3)
    shoes = rng.uniform(25, 80) + rng.uniform(-10, 10, 3)
    hair = rng.uniform(15, 70) * np.array([0.7, 0.85, 1.0])
    colour = np.tile(skin, (len(joint), 1))
    colour[np.isin(joint, (3, 6, 9, 13, 14, 16, 17))] = shirt
    colour[np.isin(joint, (0, 1, 2, 4, 5))] = trousers
    colour[np.isin(joint, (7, 8, 10, 11))] = shoes
    top = person.rest[15] + [0, 0.02, 0]
    on_head = (joint == 15) & (
        (person.skin[:, 1] > top[1] + 0.11) | (person.skin[:, 2] < top[2] - 0.03)
    )
    colour[on_head] = hair
    stripes = np.isin(joint, (3, 6, 9)) & (np.floor(person.skin[:, 1] / 0.05) % 2 > 0)
    colour[stripes] *= rng.uniform(0.6, 0.9)
    return colour


def _lit(texture: UInt8[np.ndarray, "h w 3"], surface: Surface) -> np.ndarray:
    """The texture under a lamp: sides differ in brightness."""
    light = {"floor": 1.0, "ceiling": 0.85}.get(surface.kind)
    if light is None:
        light = 0.8 + 0.25 * float(surface.normal @ _LIGHT)
    return np.clip(texture * np.float32(light), 0, 255).astype(np.uint8)


def _pyramid(texture: UInt8[np.ndarray, "h w 3"]) -> list[np.ndarray]:
    levels = [texture]
    while len(levels) < _LEVELS:
        h, w = levels[-1].shape[:2]
        size = (max(w // 2, 1), max(h // 2, 1))
        levels.append(cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA))
    return levels


def _pack(
    pyramids: list[list[np.ndarray]],
) -> tuple[UInt8[np.ndarray, "h w 3"], Float[np.ndarray, "n levels 2"]]:
    """All images in one, on shelves, and where the origin of each is in it (x, y)."""
    padded = [
        (i, k, _bordered(image))
        for i, levels in enumerate(pyramids)
        for k, image in enumerate(levels)
    ]
    padded.sort(key=lambda item: -item[2].shape[0])
    # OpenCV looks up images of up to 32767 rows and columns only: keep it square.
    texels = sum(image.shape[0] * image.shape[1] for _, _, image in padded)
    width = max(*(image.shape[1] for _, _, image in padded), int(texels**0.5))
    places = np.zeros((len(pyramids), _LEVELS, 2), np.float32)
    x = y = shelf = 0
    where = []
    for i, k, image in padded:
        h, w = image.shape[:2]
        if x + w > width:
            x, y, shelf = 0, y + shelf, 0
        where.append((x, y))
        places[i, k] = x + _BORDER, y + _BORDER
        x, shelf = x + w, max(shelf, h)
    atlas = np.zeros((y + shelf, width, 3), np.uint8)
    for (x, y), (_, _, image) in zip(where, padded, strict=True):
        atlas[y : y + image.shape[0], x : x + image.shape[1]] = image
    return atlas, places


def _bordered(image: np.ndarray) -> np.ndarray:
    """With its edge repeated, so that bilinear look-up never sees a neighbour."""
    b = _BORDER
    return cv2.copyMakeBorder(image, b, b, b, b, cv2.BORDER_REPLICATE)


def write_video(
    path: Path,
    frames: Iterable[UInt8[np.ndarray, "rows cols 3"]],
    fps: float,
    size: tuple[int, int],
) -> None:
    """Writes frames (BGR) to an .mp4, whole or not at all.

    **Raises:** `ValueError` if OpenCV cannot write one.
    """
    partial = path.with_name(f"partial-{path.name}")
    writer = cv2.VideoWriter(str(partial), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
    if not writer.isOpened():
        raise ValueError(f"{path}: OpenCV cannot write MPEG-4 video there.")
    try:
        for frame in frames:
            writer.write(frame)
    finally:
        writer.release()
    os.replace(partial, path)
