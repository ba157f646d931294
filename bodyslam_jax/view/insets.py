"""Insets of the overlay: camera and people from above (`Plan`) and from the side.

They are in a corner of the image without people, or beside it.
"""

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, UInt8

from bodyslam_jax.body.skeleton import head_ball
from bodyslam_jax.geometry.camera import project
from bodyslam_jax.types import Result, Tracks
from bodyslam_jax.view.style import (
    CAMERA,
    MIN_DEPTH_M,
    POINT,
    SUBPIXELS,
    Color,
    Image,
    blend_inset,
    person_styles,
    polylines,
    write_text,
)

_MARGIN_PX = 10
"""Distance of the insets from the picture's edges, px."""
_GAP_PX = 4
"""Distance between the plan and the side view, px."""
_BODY_RADIUS_M = 0.15
"""Distance of the skin from the joints: half a trunk, a hand beyond its wrist; m."""
_COLUMN_COLOR = (28, 28, 28)
"""Colour of the column beside the image, BGR."""
_MAX_SPAN_M = 8.0
"""Width of the inset in the world, m; where the paths are longer, it moves along with
people."""
_LIMBS = (
    (15, 12, 9, 6, 3, 0),
    (0, 1, 4, 7, 10),
    (0, 2, 5, 8, 11),
    (22, 20, 18, 16, 13, 9, 14, 17, 19, 21, 23),
)


class Insets:
    """Plan and side view of a result, at one place for the whole video.

    That is the first of the corners at the upper right, upper left and lower right in
    which nobody is in any frame (the lower left has the time); if people come into all
    of them, a column at the right of the image.
    """

    def __init__(
        self,
        result: Result,
        size: tuple[int, int],
        zoom: np.ndarray,
        beside: bool | None = None,
    ):
        """The insets are for images of `size` (width and height, px), which are `zoom`
        (x, y) times as large as those of the intrinsics; `beside` chooses the column,
        or excludes it."""
        self.plan = Plan(result, size)
        self.side = SideView(result, self.plan.side)
        width, height = size
        inset = self.plan.side, self.plan.side + _GAP_PX + self.side.height
        right, low = width - _MARGIN_PX - inset[0], height - _MARGIN_PX - inset[1]
        corners = ((right, _MARGIN_PX), (_MARGIN_PX, _MARGIN_PX), (right, low))
        hidden = [_hits(result, zoom, corner, inset) for corner in corners]
        self.beside = min(hidden) > 0 if beside is None else beside
        """Whether they are in a column at the right of the image."""
        self.corner = corners[int(np.argmin(hidden))]
        self.column = 0
        """Width of the column, px; even, as videos need it."""
        if self.beside:
            self.corner = width + _MARGIN_PX, _MARGIN_PX
            self.column = -(-(inset[0] + 2 * _MARGIN_PX) // 2) * 2

    def draw(self, picture: Image, frame: int) -> UInt8[np.ndarray, "y w 3"]:
        """Returns the picture with the insets of a frame; it is wider by `column`."""
        if self.column:
            column = np.empty((picture.shape[0], self.column, 3), np.uint8)
            column[:] = _COLUMN_COLOR
            picture = np.concatenate([picture, column], axis=1)
        x, y = self.corner
        self.plan.draw(picture, frame, (x, y))
        self.side.draw(picture, frame, (x, y + self.plan.side + _GAP_PX))
        return picture


def _hits(
    result: Result, zoom: np.ndarray, corner: tuple[int, int], size: tuple[int, int]
) -> int:
    """Returns how many joints of people, over all frames, are covered by a rectangle,
    or nearer to it than the body's flesh reaches."""
    if not result.present.any():
        return 0
    middle, radius = head_ball(result.joints)
    points = np.concatenate([result.joints, middle[:, :, None]], axis=2)
    reach = np.full(points.shape[:3], _BODY_RADIUS_M)
    reach[..., -1] = radius
    R, eye = result.T_WC[:, :3, :3], result.T_WC[:, None, :3, 3]
    p_C = np.einsum("tji,htkj->htki", R, points - eye)
    shown = result.present[..., None] & (p_C[..., 2] > MIN_DEPTH_M)
    uv = (_projected(result, p_C) + 0.5) * zoom - 0.5
    focal = result.intrinsics[:2] * zoom
    reach = reach * focal.max() / np.maximum(p_C[..., 2], MIN_DEPTH_M)
    low = np.asarray(corner, float)
    away = np.maximum(np.maximum(low - uv, uv - low - size), 0.0)
    return int((shown & (np.linalg.norm(away, axis=-1) < reach)).sum())


def _projected(
    result: Result, p_C: Float[np.ndarray, "h t k 3"]
) -> Float[np.ndarray, "h t k 2"]:
    safe = np.where(p_C[..., 2:] > MIN_DEPTH_M, p_C, [0.0, 0.0, 1.0])
    cast = lambda x: jnp.asarray(x, jnp.float32)
    return np.asarray(project(cast(result.intrinsics), cast(safe)), np.float64)


class SideView:
    """The scene from the side, across the horizontal direction in which paths are
    longest."""

    def __init__(self, result: Result, width: int):
        """The inset is `width` wide, px."""
        self.result, self.width = result, width
        self.styles = person_styles(result)
        places = [result.T_WC[result.located, :3, 3]]
        joints = result.joints[result.present]
        places.append(joints.reshape(-1, 3))
        every = np.concatenate(places)
        level = every[:, [0, 2]] - every[:, [0, 2]].mean(axis=0)
        self.along = np.zeros(3)
        self.along[[0, 2]] = np.linalg.svd(level.T @ level)[0][:, 0]
        # To the right is where the first person, else the camera, goes.
        ways = [*(j[p, 0] for j, p in zip(result.joints, result.present) if p.any())]
        way = (ways or [result.T_WC[:, :3, 3]])[0]
        if (way[-1] - way[0]) @ self.along < 0:
            self.along = -self.along
        way = every @ self.along
        self.centre = (way.min() + way.max()) / 2
        extent = max(1.15 * (way.max() - way.min()), 3.0)
        self.moves = extent > _MAX_SPAN_M
        self.zoom = width / min(extent, _MAX_SPAN_M)
        self.low = min(0.0, float(every[:, 1].min()))
        middle, radius = head_ball(joints)
        top = np.append(every[:, 1], middle[:, 1] + radius).max()
        high = max(2.1, float(top) + 0.05)
        self.height = int(np.clip(self.zoom * (high - self.low) + 8, 24, width))

    def draw(self, image: Image, frame: int, corner: tuple[int, int]) -> None:
        """Puts the inset into the image, its upper left corner at `corner`, px."""
        r = self.result
        there = np.flatnonzero(r.present[:, frame])
        eye = r.T_WC[frame, :3, 3]
        centre = self.centre
        if self.moves:
            centre = float(
                np.mean([eye @ self.along, *(r.joints[there, frame, 0] @ self.along)])
            )
        inset = np.full((self.height, self.width, 3), 28, np.uint8)
        at = lambda points: self._to_inset(points, centre)
        reach = self.width / self.zoom / 2
        for metre in np.arange(np.ceil(centre - reach), centre + reach):
            post = [metre * self.along, metre * self.along + [0, 9.0, 0]]
            cv2.polylines(inset, [at(np.array(post))], False, (52, 52, 52), 1, 8, 4)
        floor = np.array([centre - reach, centre + reach])[:, None] * self.along
        cv2.polylines(inset, [at(floor)], False, (150, 150, 150), 1, 8, 4)
        for h in there:
            limbs = [at(r.joints[h, frame, list(limb)]) for limb in _LIMBS]
            style = self.styles[h]
            for limb in limbs:
                polylines(inset, limb, style.faint, 2, style.dash and (4, 4))
            middle, radius = head_ball(r.joints[h, frame])
            round_head = SUBPIXELS * max(round(float(radius) * self.zoom), 2)
            place = at(middle[None])[0].tolist()
            cv2.circle(inset, place, round_head, style.faint, -1, cv2.LINE_AA, 4)
        if r.located[frame]:
            right, down, ahead = r.T_WC[frame, :3, :3].T
            size = 14 / self.zoom
            tips = eye + size * np.array(
                [0 * ahead, ahead - 0.5 * down, ahead + 0.5 * down]
            )
            cv2.polylines(inset, [at(tips)], True, CAMERA, 2, cv2.LINE_AA, 4)
        blend_inset(image, inset, corner)

    def _to_inset(
        self, p: Float[np.ndarray, "n 3"], centre: float
    ) -> Int[np.ndarray, "n 2"]:
        u = self.width / 2 + self.zoom * (p @ self.along - centre)
        v = self.height - 5 - self.zoom * (p[:, 1] - self.low)
        uv = np.clip(np.stack([u, v], axis=-1), -2000, 4000)
        return np.round(uv * SUBPIXELS).astype(np.int32)


def trails(tracks: Tracks | None, num_frames: int, zoom: np.ndarray) -> list[list]:
    """Returns, for each frame, its points and their positions in the preceding
    frames."""
    found: list[list] = [[] for _ in range(num_frames)]
    if tracks is None:
        return found
    order = np.lexsort((tracks.frame, tracks.landmark))
    frame, landmark = tracks.frame[order], tracks.landmark[order]
    uv = (tracks.uv[order] + 0.5) * zoom - 0.5
    row = np.arange(len(order))
    begins = np.r_[True, np.diff(landmark) != 0]
    first = np.maximum.accumulate(np.where(begins, row, 0))
    oldest = np.maximum(first, row - 6)
    for k in np.flatnonzero(frame < num_frames):
        found[frame[k]].append(uv[oldest[k] : k + 1])
    return found


def draw_trails(image: Image, lines: list[np.ndarray]) -> None:
    curves = [np.round(trail * SUBPIXELS).astype(np.int32) for trail in lines]
    cv2.polylines(image, curves, False, POINT, 1, cv2.LINE_AA, 4)
    for line in curves:
        cv2.circle(image, line[-1].tolist(), 2 * SUBPIXELS, POINT, -1, cv2.LINE_AA, 4)


class Plan:
    """The inset: camera and people from above on a metric grid, up to a frame."""

    def __init__(self, result: Result, size: tuple[int, int]):
        self.side = int(0.34 * min(size))
        self.result = result
        self.styles = person_styles(result)
        places = [result.T_WC[:, [0, 2], 3]]
        for joints, present in zip(result.joints, result.present, strict=True):
            places.append(joints[present, 0][:, [0, 2]])
        every = np.concatenate(places)
        low, high = every.min(0), every.max(0)
        self.centre = (low + high) / 2
        extent = max(float((high - low).max()) * 1.2, 2.0)
        self.zoom = self.side / extent
        steps = (1, 2, 5, 10, 20, 50, 100)
        larger = 10 ** np.ceil(np.log10(extent / 10))
        self.step = next((s for s in steps if extent / s <= 10), larger)
        self.background = self._grid(extent)

    def _to_inset(self, points: Float[np.ndarray, "n 2"]) -> Int[np.ndarray, "n 2"]:
        """Returns positions in the inset, in sixteenths of a pixel: seen from above
        with z up the picture, x runs to the left."""
        uv = self.side / 2 - self.zoom * (points - self.centre)
        return np.round(uv * SUBPIXELS).astype(np.int32)

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
        for path, (b, g, r), dash in self._paths(len(self.result.timestamps)):
            dim = (int(0.45 * b + 16), int(0.45 * g + 16), int(0.45 * r + 16))
            polylines(inset, self._to_inset(path), dim, 1, dash)
        return inset

    def _paths(
        self, end: int
    ) -> list[tuple[np.ndarray, Color, tuple[int, int] | None]]:
        """Returns the paths up to a frame, with their colours and dashes."""
        paths: list[tuple[np.ndarray, Color, tuple[int, int] | None]]
        paths = [(self.result.T_WC[:end, [0, 2], 3], CAMERA, None)]
        for h, present in enumerate(self.result.present):
            visible = np.flatnonzero(present[:end])
            for part in np.split(visible, np.flatnonzero(np.diff(visible) > 1) + 1):
                place = self.result.joints[h, part, 0][:, [0, 2]]
                style = self.styles[h]
                paths.append((place, style.faint, style.dash))
        return paths

    def draw(self, image: Image, frame: int, corner: tuple[int, int]) -> None:
        """Puts the inset into the image, its upper left corner at `corner`, px."""
        inset = self.background.copy()
        for path, color, dash in self._paths(frame + 1):
            if len(path):
                polylines(inset, self._to_inset(path), color, 2, dash)
        for h, present in enumerate(self.result.present):
            if present[frame]:
                place = self.result.joints[h, frame, :1][:, [0, 2]]
                spot = self._to_inset(place)[0].tolist()
                style = self.styles[h]
                fill = -1 if style.dash is None else 2
                cv2.circle(
                    inset, spot, 5 * SUBPIXELS, style.faint, fill, cv2.LINE_AA, 4
                )
        T = self.result.T_WC[frame]
        reach = 0.12 * self.side / self.zoom
        right, ahead = T[[0, 2], 0], T[[0, 2], 2]
        eye = T[[0, 2], 3]
        wedge = np.stack([eye, eye + reach * (ahead - 0.5 * right)])
        wedge = np.concatenate([wedge, [eye + reach * (ahead + 0.5 * right)]])
        cv2.polylines(inset, [self._to_inset(wedge)], True, CAMERA, 2, cv2.LINE_AA, 4)
        write_text(inset, f"grid {self.step:g} m, x left", (6, self.side - 7), 0.4)
        blend_inset(image, inset, corner)
