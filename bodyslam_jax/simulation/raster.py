"""Rasterises meshes of small triangles with a z-buffer, in NumPy.

`make_texture` generates images with detail at every scale: stains, tiles, shapes,
letters.

The exposure of each pixel is that of camera and people around the time of a frame.
Between frames all motion is quadratic in time, through three frames. A frame's time is
the middle of the exposure of its middle row, so that neither a long exposure nor a
rolling shutter shifts the image in time on average.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.ndimage import zoom

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.simulation.room import TEXELS_PER_METRE

_BASE_COLOURS = {
    "floor": (105, 125, 150),
    "ceiling": (185, 190, 190),
    "wall": (160, 165, 165),
    "furniture": (90, 120, 160),
}
"""Mean colour, BGR."""


class Hits(NamedTuple):
    """The visible surface at `p` distinct pixels."""

    pixel: Int[np.ndarray, " p"]
    """Flat pixel index, row-major."""
    face: Int[np.ndarray, " p"]
    weights: Float[np.ndarray, "p 3"]
    """Barycentric weights of the face's three corners; they sum to 1."""
    inverse: Float[np.ndarray, " p"]
    """Inverse depth, 1/m."""


def rasterise(
    uv: Float[np.ndarray, "v 2"],
    inverse: Float[np.ndarray, " v"],
    faces: Int[np.ndarray, "f 3"],
    inverse_depth: Float[np.ndarray, "rows cols"],
) -> Hits:
    """Returns the part of a mesh that is in front of a depth buffer.

    Triangles are small, so each tests all pixels of its bounding box; those of equal
    box size are processed together. Back faces are culled. Weights are interpolated
    linearly in the image, which for triangles of a few pixels equals perspective.
    """
    rows, columns = inverse_depth.shape
    a, b, c = (uv[faces[:, k]] for k in range(3))
    edge1, edge2 = b - a, c - a
    area = edge1[:, 0] * edge2[:, 1] - edge1[:, 1] * edge2[:, 0]
    low = np.ceil(np.minimum(np.minimum(a, b), c)).astype(np.int64)
    high = np.floor(np.maximum(np.maximum(a, b), c)).astype(np.int64)
    low, high = np.maximum(low, 0), np.minimum(high, [columns - 1, rows - 1])
    # Faces are counter-clockwise from outside, hence clockwise in an image with y down.
    size = high - low + 1
    visible = (area < -1e-12) & (size[:, 0] > 0) & (size[:, 1] > 0)
    extent = np.maximum(size[:, 0], size[:, 1])
    pixels, owners, depths, shares = [], [], [], []
    side = 1
    while visible.any():
        now = np.flatnonzero(visible & (extent <= side))
        visible[now] = False
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
            shares.append(np.stack([1 - s - t, s, t], axis=1))
        side *= 2
    if not pixels:
        none = np.zeros(0, np.int64)
        return Hits(none, none, np.zeros((0, 3)), np.zeros(0))
    pixel, owner = np.concatenate(pixels), np.concatenate(owners)
    depth, share = np.concatenate(depths), np.concatenate(shares)
    front = np.flatnonzero(depth > inverse_depth.reshape(-1)[pixel])
    order = front[np.lexsort((-depth[front], pixel[front]))]
    order = order[np.flatnonzero(np.diff(pixel[order], prepend=-1))]
    return Hits(pixel[order], owner[order], share[order], depth[order])


def vertex_normals(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> Float[np.ndarray, "v 3"]:
    """Returns the unit normals of vertices: the area-weighted mean of the normals of
    adjacent faces."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    u, v = b - a, c - a
    of_face = np.stack(
        [
            u[:, 1] * v[:, 2] - u[:, 2] * v[:, 1],
            u[:, 2] * v[:, 0] - u[:, 0] * v[:, 2],
            u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0],
        ],
        axis=1,
    )
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


def make_texture(
    rng: np.random.Generator, height: int, width: int, kind: str
) -> UInt8[np.ndarray, "{height} {width} 3"]:
    """Returns a texture for a floor, wall, ceiling or furniture.

    BRISK finds corners in it at distances from half a metre to ten, and no part of it
    repeats.
    """
    base = np.array(_BASE_COLOURS[kind], np.float32) * rng.uniform(0.8, 1.15)
    base = base * rng.uniform(0.9, 1.1, 3)
    image = base * (1 + 0.22 * _clouds(rng, height, width))[:, :, None]
    if kind in ("floor", "ceiling"):
        _tile(rng, image, TEXELS_PER_METRE * (0.5 if kind == "floor" else 0.6))
    if kind == "furniture":
        _grain(rng, image)
    area = height * width / TEXELS_PER_METRE**2
    for size, density in ((0.30, 0.8), (0.12, 4.0), (0.05, 16.0), (0.025, 30.0)):
        for _ in range(rng.poisson(density * area)):
            _shape(rng, image, size * TEXELS_PER_METRE * rng.uniform(0.6, 1.5))
    for _ in range(rng.poisson(1.5 * area)):
        _letters(
            rng, image, max(1, round(0.012 * TEXELS_PER_METRE * rng.uniform(0.6, 2.5)))
        )
    return np.clip(image, 0, 255).astype(np.uint8)


def _clouds(
    rng: np.random.Generator, height: int, width: int
) -> Float[np.ndarray, "{height} {width}"]:
    """Returns noise of all sizes from the whole texture down to four texels, about
    ±1."""
    total = np.zeros((height, width), np.float32)
    cell, weight = 128, 1.0
    while cell >= 4:
        shape = (height // cell + 2, width // cell + 2)
        coarse = rng.standard_normal(shape).astype(np.float32)
        total += weight * np.asarray(zoom(coarse, cell, order=1))[:height, :width]
        cell, weight = cell // 4, 0.6 * weight
    return total / 1.6


def _tile(rng: np.random.Generator, image: np.ndarray, size: float) -> None:
    """Draws tiles or boards, each a little brighter or darker, with dark joints."""
    height, width = image.shape[:2]
    rows = np.append(np.arange(0, height, max(size, 4)), height).astype(int)
    columns = np.append(np.arange(0, width, max(size, 4)), width).astype(int)
    for top, bottom in zip(rows[:-1], rows[1:], strict=True):
        for left, right in zip(columns[:-1], columns[1:], strict=True):
            image[top:bottom, left:right] *= rng.uniform(0.85, 1.15)
            image[top : top + 1, left:right] *= 0.6
            image[top:bottom, left : left + 1] *= 0.6


def _grain(rng: np.random.Generator, image: np.ndarray) -> None:
    """Draws streaks along the rows, as of wood."""
    lines = rng.standard_normal((image.shape[0], 1, 1)).astype(np.float32)
    image *= 1 + 0.08 * lines


def _shape(rng: np.random.Generator, image: np.ndarray, size: float) -> None:
    """Draws a disc, a ring, a rectangle or a frame, darker or brighter than the
    background."""
    h, w = np.maximum(2, size * rng.uniform(0.5, 1.0, 2)).astype(int)
    top = int(rng.integers(0, max(1, image.shape[0] - h)))
    left = int(rng.integers(0, max(1, image.shape[1] - w)))
    patch = image[top : top + h, left : left + w]
    y = (np.arange(patch.shape[0])[:, None] + 0.5) / h * 2 - 1
    x = (np.arange(patch.shape[1]) + 0.5) / w * 2 - 1
    radius = np.hypot(x, y) if rng.random() < 0.4 else np.maximum(abs(x), abs(y))
    mask = radius <= 1
    if rng.random() < 0.35:
        mask &= radius > 0.6
    tint = rng.uniform(0.75, 1.25, 3) * rng.choice([0.35, 0.5, 1.5, 1.9])
    np.multiply(patch, tint.astype(np.float32), out=patch, where=mask[:, :, None])


def _letters(rng: np.random.Generator, image: np.ndarray, dot: int) -> None:
    """Draws a word of random letters of 5 by 7 dots."""
    count = int(rng.integers(2, 7))
    dots = rng.random((7, 6 * count)) < 0.5
    dots[:, 5::6] = False
    mask = np.kron(dots, np.ones((dot, dot), bool))
    if rng.random() < 0.2:
        mask = mask.T
    top = int(rng.integers(0, max(1, image.shape[0] - mask.shape[0])))
    left = int(rng.integers(0, max(1, image.shape[1] - mask.shape[1])))
    patch = image[top : top + mask.shape[0], left : left + mask.shape[1]]
    patch[mask[: patch.shape[0], : patch.shape[1]]] *= rng.choice([0.3, 1.7])


@dataclasses.dataclass(frozen=True)
class Shutter:
    """Exposure of each row, and delay between the first and the last row.

    Zeros are an ideal camera with a global shutter.
    """

    exposure: float = 0.0
    """Exposure time of a row, s."""
    readout: float = 0.0
    """Delay between the first and the last row, s."""

    def row_times(self, rows: int) -> Float[np.ndarray, " rows"]:
        """Returns the middle of each row's exposure relative to the frame's time, s."""
        return self.readout * ((np.arange(rows) + 0.5) / rows - 0.5)

    def instants(self, count: int) -> Float[np.ndarray, " {count}"]:
        """Returns evenly spaced times within the exposure, s, whose images are
        averaged."""
        return self.exposure * ((np.arange(count) + 0.5) / count - 0.5)


def around(
    values: Float[np.ndarray, "t n d"], k: int
) -> tuple[
    Float[np.ndarray, "n d"], Float[np.ndarray, "n d"], Float[np.ndarray, "n d"]
]:
    """Returns value, first and second difference (per frame) of a series at frame `k`.

    At the ends the motion is extrapolated with constant velocity.
    """
    value = values[k]
    last, first = len(values) - 1, 0
    before = values[k - 1] if k > first else 2 * value - values[min(k + 1, last)]
    after = values[k + 1] if k < last else 2 * value - before
    return value, (after - before) / 2, after - 2 * value + before


def cameras_at(
    T_WC: Float[np.ndarray, "t 4 4"], k: int, when: Float[np.ndarray, " n"], fps: float
) -> Float[np.ndarray, "n 4 4"]:
    """Returns the camera poses at times `when` (s) relative to frame `k`.

    The rotation is that of frame `k` times the exponential of a quadratic.
    """
    window = T_WC[max(k - 1, 0) : k + 2]
    own = min(k, 1)
    R = window[:, :3, :3]
    turned = so3.log(R[own].T @ R)
    tau = (when * fps)[:, None]
    move = lambda terms: terms[0] + tau * terms[1] + tau**2 / 2 * terms[2]
    out = np.tile(np.eye(4), (len(tau), 1, 1))
    out[:, :3, :3] = R[own] @ so3.exp(move(around(turned[:, None], own)))
    out[:, :3, 3] = move(around(window[:, None, :3, 3], own))
    return out
