"""The ground in the image: a metric grid, and marks under standing feet."""

import cv2
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.body.skeleton import FEET
from bodyslam_jax.geometry.arrays import runs
from bodyslam_jax.geometry.camera import project
from bodyslam_jax.ground.stances import standing_feet
from bodyslam_jax.types import Result
from bodyslam_jax.view.style import PEOPLE, SUBPIXELS, Image

_GRID_MARGIN_M = 3.0
"""Grid beyond the outermost positions of cameras and people, m."""
_MAX_GRID_LINES = 60
_LINE_SEGMENTS = 80
"""Straight segments that a line of the grid is drawn as, so that a lens may bend it."""
_MIN_DEPTH_M = 0.3
"""Depth from which lines are drawn, m."""
_WHITE = (255, 255, 255)
_FOOT_MARK_RADIUS_M = 0.14
"""Radius of a mark under a foot, m."""
_UP = np.array([0.0, 1.0, 0.0])


class Ground:
    """The plane y = 0 of a result with people; nothing is drawn without them."""

    def __init__(self, result: Result, zoom: Float[np.ndarray, " 2"]):
        """`zoom` is the size of the pictures relative to that of the images."""
        self.result, self.zoom = result, zoom
        self.lines = _grid(result)
        self.stands = feet_on_the_ground(result)

    def draw(self, image: Image, frame: int) -> Image:
        """Returns the image with the grid, and with a disc under each foot in
        contact."""
        if not len(self.lines):
            return image
        drawn = image.copy()
        curves = []
        uv, before = self._seen(self.lines, frame)
        for line, shown in zip(uv, before, strict=True):
            curves += [_sixteenths(line[run]) for run in runs(shown)]
        cv2.polylines(drawn, curves, False, _WHITE, 1, cv2.LINE_AA, 4)
        drawn = cv2.addWeighted(drawn, 0.4, image, 0.6, 0)
        h, side = np.nonzero(self.stands[:, frame])
        if not len(h):
            return drawn
        marked = drawn.copy()
        feet = self.result.joints[h, frame, np.array(FEET)[side]]
        angle = np.linspace(0, 2 * np.pi, 24)
        circle = _FOOT_MARK_RADIUS_M * np.stack(
            [np.cos(angle), 0 * angle, np.sin(angle)], axis=-1
        )
        uv, before = self._seen(feet[:, None] * [1, 0, 1] + circle, frame)
        for person, mark, shown in zip(h, uv, before, strict=True):
            if shown.all():
                color = PEOPLE[person % len(PEOPLE)]
                cv2.fillPoly(marked, [_sixteenths(mark)], color, cv2.LINE_AA, 4)
        return cv2.addWeighted(marked, 0.75, drawn, 0.25, 0)

    def _seen(self, p_W: Float[np.ndarray, "n m 3"], frame: int):
        """Returns pixels of the picture, and which points are in front of the
        camera."""
        T = self.result.T_WC[frame]
        p_C = (p_W - T[:3, 3]) @ T[:3, :3]
        intrinsics = jnp.asarray(self.result.intrinsics)
        uv = np.asarray(project(intrinsics, jnp.asarray(p_C, intrinsics.dtype)))
        # Pixel centres are whole numbers, so the image's edge is at -1/2.
        return (uv + 0.5) * self.zoom - 0.5, p_C[..., 2] > _MIN_DEPTH_M


def feet_on_the_ground(result: Result) -> Bool[np.ndarray, "h t 2"]:
    """Returns, for each frame, whether each person's left and right foot is in contact
    with the ground: the lower foot, while it is slow (`ground.stances`)."""
    stands = np.zeros((*result.present.shape, 2), bool)
    for h, present in enumerate(result.present):
        for run in runs(present):
            feet = result.joints[h, run][:, list(FEET)]
            slow, lower = standing_feet(feet, _UP, result.fps)
            stands[h, np.arange(run.start, run.stop), lower] = slow
    return stands


def _grid(result: Result) -> Float[np.ndarray, "n m 3"]:
    """Returns lines at whole metres around camera and people, further apart where there
    would be many."""
    if not result.present.any():
        return np.zeros((0, _LINE_SEGMENTS + 1, 3))
    places = np.concatenate(
        [result.T_WC[result.located, :3, 3], result.joints[result.present][:, 0]]
    )[:, [0, 2]]
    low, high = places.min(axis=0) - _GRID_MARGIN_M, places.max(axis=0) + _GRID_MARGIN_M
    step = max(1.0, np.ceil((high - low).sum() / _MAX_GRID_LINES))
    low, high = np.floor(low / step) * step, np.ceil(high / step) * step
    share = np.linspace(0, 1, _LINE_SEGMENTS + 1)[:, None]
    lines = []
    for axis in range(2):
        for place in np.arange(low[axis], high[axis] + step / 2, step):
            ends = np.array([low, high])
            ends[:, axis] = place
            x, z = (ends[0] + share * (ends[1] - ends[0])).T
            lines.append(np.stack([x, 0 * x, z], axis=-1))
    return np.array(lines)


def _sixteenths(uv: Float[np.ndarray, "n 2"]) -> np.ndarray:
    """Returns pixels in sixteenths of a pixel, as OpenCV draws them; points far outside
    the image are clipped, as they would overflow in OpenCV."""
    return np.round(np.clip(uv, -4000, 4000) * SUBPIXELS).astype(np.int32)
