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
