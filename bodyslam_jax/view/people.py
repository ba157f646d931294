"""Bodies on an image, by the painter's algorithm on a decimated mesh.

Triangles are drawn farthest first; those that reach behind the camera are left out.
Bodies are transparent with an outline, so that the person in the image shows beside
the body that misses them. Who is doubtful or not measurable is paler and has a dashed
or dotted outline; limbs that were inferred are pale.
"""

import dataclasses
from collections.abc import Iterator

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from bodyslam_jax.body import BodyModel, vertices
from bodyslam_jax.diagnostics.reported_status import inferred_bones
from bodyslam_jax.geometry.camera import project
from bodyslam_jax.types import Result
from bodyslam_jax.view.style import (
    MIN_DEPTH_M,
    PALE,
    SUBPIXELS,
    Image,
    PersonStyle,
    person_styles,
    polylines,
)

_CELL_M = 0.025
"""Size of the cells in which vertices are merged, m."""
_MAX_STILL_WIDTH_PX = 960
"""Greatest width of a still, px."""
_MIN_CONTOUR_PX = 12
"""Length of the shortest contour that is drawn, px; a shorter one is that of a gap
between triangles."""
_MIN_WIDE_OUTLINE_HEIGHT_PX = 150
"""Height of the smallest person with an outline of 2 px, px: it would cover the arms of
a smaller one."""
_FRAMES_PER_BATCH = 16
"""Frames whose meshes are computed together."""


def draw_frame(image: Image, result: Result, body: BodyModel, frame: int) -> Image:
    """Returns an image with the bodies of its frame, at the image's own size.

    **Raises:** `IndexError` if the result has no such frame.
    """
    num_frames = len(result.timestamps)
    if not 0 <= frame < num_frames:
        raise IndexError(f"frame {frame}, expected 0 to {num_frames - 1}.")
    coarse = coarse_body(body)
    people = next(meshes(result, coarse, slice(frame, frame + 1)))
    styles = person_styles(result)
    return draw_people(image, people, np.asarray(coarse.faces), np.ones(2), styles)


def middle_frame(result: Result) -> int:
    """Returns, of the frames with the most people, the one nearest to the middle."""
    number = result.present.sum(axis=0)
    frames = np.flatnonzero(number == number.max(initial=0))
    return int(frames[np.abs(frames - (len(number) - 1) / 2).argmin()])


def still(image: Image, result: Result, body: BodyModel, frame: int) -> bytes:
    """Returns `draw_frame` as JPEG, at most 960 px wide."""
    drawn = draw_frame(image, result, body, frame)
    height, width = drawn.shape[:2]
    if width > _MAX_STILL_WIDTH_PX:
        size = (_MAX_STILL_WIDTH_PX, round(height * _MAX_STILL_WIDTH_PX / width))
        drawn = cv2.resize(drawn, size, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", drawn, [cv2.IMWRITE_JPEG_QUALITY, 80])[1].tobytes()


def coarse_body(body: BodyModel) -> BodyModel:
    """Returns the body with about a quarter of its vertices.

    Vertices in one cell of a grid over the rest pose are merged into the first of
    them. As the rest is a subset, shape, skinning and joints are unchanged; keypoints
    on the skin move within their cells.
    """
    template = np.asarray(body.template)
    cells = np.floor(template / _CELL_M).astype(np.int64)
    _, kept, cluster = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    # In the body's own order, as runs of vertices are skinned together.
    order = np.argsort(kept)
    kept = kept[order]
    into = np.argsort(order)[cluster.reshape(-1)]
    faces = into[np.asarray(body.faces)]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    arrays = lambda m: (
        [m.template, m.shape_dirs, m.pose_dirs, m.skin_joint] + [m.skin_weight]
    )
    chosen = lambda x: jnp.asarray(np.asarray(x)[kept])
    coarse = eqx.tree_at(arrays, body, [chosen(x) for x in arrays(body)])
    place = lambda vertex: int(np.searchsorted(kept, vertex))
    runs = tuple((place(i), place(j), joints) for i, j, joints in body.blocks)
    regressor = np.zeros((len(kept), 24), body.dtype)
    np.add.at(regressor, into, np.asarray(body.joint_regressor).T)
    return dataclasses.replace(
        coarse,
        blocks=runs,
        joint_regressor=jnp.asarray(regressor.T),
        faces=jnp.asarray(faces, body.faces.dtype),
        picks=jnp.asarray(into[np.asarray(body.picks)], body.picks.dtype),
    )


class Mesh(eqx.Module):
    """One person in one frame."""

    person: int
    p_C: np.ndarray
    """Vertices in the camera frame, m."""
    uv: np.ndarray
    """px"""
    inferred: np.ndarray
    """Vertices of limbs that were hidden, not measured; boolean."""


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


def meshes(result: Result, body: BodyModel, frames: slice) -> Iterator[list[Mesh]]:
    """Yields the people present in each frame, computed for some frames at a time."""
    cast = lambda x: jnp.asarray(x, body.template.dtype)
    bone = np.take_along_axis(
        np.asarray(body.skin_joint),
        np.asarray(body.skin_weight).argmax(axis=1)[:, None],
        axis=1,
    )[:, 0]
    inferred = inferred_bones(result)
    chosen = np.arange(len(result.timestamps))[frames]
    for start in range(0, len(chosen), _FRAMES_PER_BATCH):
        index = chosen[start : start + _FRAMES_PER_BATCH]
        padded = np.pad(index, (0, _FRAMES_PER_BATCH - len(index)), mode="edge")
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
                Mesh(h, p_C[k], uv[k], inferred[h, frame, bone])
                for h, p_C, uv in drawn
                if result.present[h, frame]
            ]


def draw_people(
    image: Image,
    people: list[Mesh],
    faces: Int[np.ndarray, "f 3"],
    zoom: np.ndarray,
    styles: list[PersonStyle],
) -> Image:
    """Returns the image with shaded bodies blended into it, the farthest first.

    Args:
        styles: of all people of the result.
    """
    height, width = image.shape[:2]
    depth, corners, colors, owners = [], [], [], []
    for mesh in people:
        # Pixel centres are whole numbers, so the image's edge is at -1/2.
        uv = (mesh.uv + 0.5) * zoom - 0.5
        a, b, c = (mesh.p_C[faces[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        faces_camera = np.sum(normal * a, 1) < 0
        before = np.minimum(np.minimum(a[:, 2], b[:, 2]), c[:, 2]) > MIN_DEPTH_M
        triangle = uv[faces]
        inside = np.all(triangle.max(1) >= -0.5, 1) & np.all(
            triangle.min(1) <= [width - 0.5, height - 0.5], 1
        )
        shown = faces_camera & before & inside
        light = _lit(normal, faces, len(uv))[shown]
        style = styles[mesh.person]
        pale = mesh.inferred[faces[shown]].any(axis=1)
        white = np.where(pale, PALE, style.white)[:, None]
        base = np.array(style.color) * (1 - white) + 255 * white
        depth.append((a + b + c)[shown, 2])
        corners.append(triangle[shown])
        colors.append(light[:, None] * base)
        owners.append(np.full(len(light), mesh.person))
    if not depth or not sum(map(len, depth)):
        return image
    order = np.argsort(-np.concatenate(depth))
    triangles = np.concatenate(corners)[order]
    # Sixteenths of a pixel; far-off corners must not overflow in OpenCV.
    triangles = np.round(np.clip(triangles, -4000, 4000) * SUBPIXELS).astype(np.int32)
    shades = np.concatenate(colors)[order].astype(int).tolist()
    here = sorted({mesh.person for mesh in people})[:255]
    number = {h: k + 1 for k, h in enumerate(here)}
    owner = [number.get(int(h), 0) for h in np.concatenate(owners)[order]]
    # The fourth channel has who is in front.
    drawn = cv2.merge([image, np.zeros((height, width), np.uint8)])
    for triangle, shade, k in zip(triangles, shades, owner, strict=True):
        cv2.fillConvexPoly(drawn, triangle, (*shade, k), cv2.LINE_8, 4)
    front = np.asarray(drawn[..., 3], np.uint8)
    opacities = np.array([0.0, *(styles[h].opacity for h in here)], np.float32)
    share = opacities[front][..., None]
    blended = np.round(share * drawn[..., :3] + (1 - share) * image).astype(np.uint8)
    # Who is in front has a whole outline.
    for mesh in sorted(people, key=lambda mesh: -float(mesh.p_C[:, 2].mean())):
        if (k := number.get(mesh.person)) is not None:
            _outline(blended, (front == k).astype(np.uint8), styles[mesh.person])
    return blended


def _outline(image: Image, mask: UInt8[np.ndarray, "y x"], style: PersonStyle) -> None:
    """Draws a line around a person, dashed if the status is not `ok`."""
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    for contour in contours:
        if len(contour) < _MIN_CONTOUR_PX:
            continue
        curve = SUBPIXELS * np.concatenate([contour, contour[:1]])[:, 0].astype(int)
        width = 2 if np.ptp(contour[..., 1]) >= _MIN_WIDE_OUTLINE_HEIGHT_PX else 1
        polylines(image, curve, (20, 20, 20), width + 1, style.dash)
        polylines(image, curve, style.color, width, style.dash)


_LIGHT_DIRECTION = np.array([-0.5, -0.62, -0.6])
"""Direction towards the light, from above and behind the camera, in its frame."""


def _lit(
    normal: Float[np.ndarray, "f 3"], faces: Int[np.ndarray, "f 3"], num_vertices: int
) -> Float[np.ndarray, " f"]:
    """Returns the brightness of each face, smooth: by the mean normal around its
    corners."""
    around = np.zeros((num_vertices, 3))
    for axis in range(3):
        weight = np.repeat(normal[:, axis], 3)
        around[:, axis] = np.bincount(faces.ravel(), weight, num_vertices)
    smooth = around[faces].sum(1)
    smooth /= np.maximum(np.linalg.norm(smooth, axis=1, keepdims=True), 1e-12)
    return 0.3 + 0.7 * np.clip(smooth @ _LIGHT_DIRECTION, 0, 1)
