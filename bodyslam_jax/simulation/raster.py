"""Rasterises meshes of small triangles with a z-buffer, in NumPy."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int


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
