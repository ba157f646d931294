"""Colours and lettering of everything that is drawn."""

import cv2
import numpy as np
from jaxtyping import Int, UInt8

from bodyslam_jax.geometry.arrays import runs

Image = UInt8[np.ndarray, "y x 3"]
Color = tuple[int, int, int]
"""Blue, green, red; 0 to 255."""
CAMERA: Color = (214, 111, 31)
PEOPLE: tuple[Color, ...] = (
    (36, 110, 232),
    (115, 170, 40),
    (200, 90, 150),
    (20, 160, 200),
    (160, 60, 220),
    (170, 160, 20),
    (40, 190, 150),
    (70, 110, 170),
)
"""BGR, as in the report."""


def write_text(
    image: Image, text: str, place: tuple[int, int], size: float = 0.5
) -> None:
    """Writes white text on a dark rim, which is readable on any frame."""
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


def blend_inset(
    image: Image, inset: UInt8[np.ndarray, "rows columns 3"], corner: tuple[int, int]
) -> None:
    """Puts a smaller picture into the image, as far as it fits."""
    x, y = corner
    room = image[max(y, 0) :, max(x, 0) :][: inset.shape[0], : inset.shape[1]]
    inset = inset[: room.shape[0], : room.shape[1]]
    if room.size:
        room[:] = cv2.addWeighted(inset, 0.85, room.copy(), 0.15, 0)


def polylines(
    image: Image,
    curve: Int[np.ndarray, "n 2"],
    color: Color,
    width: int,
    dash: tuple[int, int] | None = None,
) -> None:
    """Draws a curve through points in sixteenths of a pixel, whole or in dashes.

    Args:
        dash: px that are drawn, and px left out.
    """
    parts = [curve] if dash is None else _dashes(curve, dash)
    parts = [part.astype(np.int32) for part in parts]
    cv2.polylines(image, parts, False, color, width, cv2.LINE_AA, 4)


def _dashes(
    curve: Int[np.ndarray, "n 2"], dash: tuple[int, int]
) -> list[Int[np.ndarray, "_ 2"]]:
    """Returns the parts of a curve that are drawn, with a point each pixel."""
    if len(curve) < 2:
        return []
    step = np.linalg.norm(np.diff(curve, axis=0), axis=1) / 16
    along = np.concatenate([[0.0], np.cumsum(step)])
    at = np.arange(0.0, along[-1], 1.0)
    points = np.stack([np.interp(at, along, axis) for axis in curve.T], axis=-1)
    drawn = at % sum(dash) < dash[0]
    return [np.round(points[run]).astype(int) for run in runs(drawn)]
