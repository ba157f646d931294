"""Colours and lettering of everything that is drawn."""

import cv2
import numpy as np
from jaxtyping import UInt8

Image = UInt8[np.ndarray, "y x 3"]
CAMERA: tuple[int, int, int] = (214, 111, 31)
PEOPLE = ((36, 110, 232), (115, 170, 40), (200, 90, 150), (20, 160, 200))
"""BGR, as in the report."""


def write_text(
    image: Image, text: str, place: tuple[int, int], size: float = 0.5
) -> None:
    """White on a dark rim: readable on any frame."""
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
