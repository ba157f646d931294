"""Position of the plan and the side view: in a corner without people, or beside."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8

from bodyslam_jax.body.skeleton import head_ball
from bodyslam_jax.geometry.camera import project
from bodyslam_jax.types import Result
from bodyslam_jax.view.side_view import SideView
from bodyslam_jax.view.style import Image
from bodyslam_jax.view.top_view import Plan

_MARGIN_PX = 10
"""Distance of the insets from the picture's edges, px."""
_GAP_PX = 4
"""Distance between the plan and the side view, px."""
_BODY_RADIUS_M = 0.15
"""Distance of the skin from the joints: half a trunk, a hand beyond its wrist; m."""
_MIN_DEPTH_M = 0.05
"""Joints nearer to the camera's plane than this are not visible, m."""
_COLUMN_COLOR = (28, 28, 28)
"""Colour of the column beside the image, BGR."""


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
    shown = result.present[..., None] & (p_C[..., 2] > _MIN_DEPTH_M)
    uv = (_projected(result, p_C) + 0.5) * zoom - 0.5
    focal = result.intrinsics[:2] * zoom
    reach = reach * focal.max() / np.maximum(p_C[..., 2], _MIN_DEPTH_M)
    low = np.asarray(corner, float)
    away = np.maximum(np.maximum(low - uv, uv - low - size), 0.0)
    return int((shown & (np.linalg.norm(away, axis=-1) < reach)).sum())


def _projected(
    result: Result, p_C: Float[np.ndarray, "h t k 3"]
) -> Float[np.ndarray, "h t k 2"]:
    safe = np.where(p_C[..., 2:] > _MIN_DEPTH_M, p_C, [0.0, 0.0, 1.0])
    cast = lambda x: jnp.asarray(x, jnp.float32)
    return np.asarray(project(cast(result.intrinsics), cast(safe)), np.float64)
