"""Tracked points on an image, and the inset: camera and people from above."""

import cv2
import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.types import Result, Tracks
from bodyslam_jax.view.person_style import person_styles
from bodyslam_jax.view.style import (
    CAMERA,
    Color,
    Image,
    blend_inset,
    polylines,
    write_text,
)

_POINT_COLOR = (90, 230, 120)


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
    curves = [np.round(trail * 16).astype(np.int32) for trail in lines]
    cv2.polylines(image, curves, False, _POINT_COLOR, 1, cv2.LINE_AA, 4)
    for line in curves:
        cv2.circle(image, line[-1].tolist(), 2 * 16, _POINT_COLOR, -1, cv2.LINE_AA, 4)


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
                cv2.circle(inset, spot, 5 * 16, style.faint, fill, cv2.LINE_AA, 4)
        T = self.result.T_WC[frame]
        reach = 0.12 * self.side / self.zoom
        right, ahead = T[[0, 2], 0], T[[0, 2], 2]
        eye = T[[0, 2], 3]
        wedge = np.stack([eye, eye + reach * (ahead - 0.5 * right)])
        wedge = np.concatenate([wedge, [eye + reach * (ahead + 0.5 * right)]])
        cv2.polylines(inset, [self._to_inset(wedge)], True, CAMERA, 2, cv2.LINE_AA, 4)
        write_text(inset, f"grid {self.step:g} m, x left", (6, self.side - 7), 0.4)
        blend_inset(image, inset, corner)
