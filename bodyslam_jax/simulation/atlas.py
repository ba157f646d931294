"""All textures of a room, at every resolution, in one image: one look-up a frame."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

LEVELS = 7
"""Resolutions of each texture, each half of the one before."""
_BORDER = 2


def pyramid(texture: UInt8[np.ndarray, "h w 3"]) -> list[np.ndarray]:
    levels = [texture]
    while len(levels) < LEVELS:
        h, w = levels[-1].shape[:2]
        size = (max(w // 2, 1), max(h // 2, 1))
        levels.append(cv2.resize(levels[-1], size, interpolation=cv2.INTER_AREA))
    return levels


def pack(
    pyramids: list[list[np.ndarray]],
) -> tuple[UInt8[np.ndarray, "h w 3"], Float[np.ndarray, "n levels 2"]]:
    """All images packed into one, and the origin (x, y) of each in it, px."""
    padded = [
        (i, k, _bordered(image))
        for i, levels in enumerate(pyramids)
        for k, image in enumerate(levels)
    ]
    padded.sort(key=lambda item: -item[2].shape[0])
    # OpenCV looks up images of up to 32767 rows and columns only: keep it square.
    texels = sum(image.shape[0] * image.shape[1] for _, _, image in padded)
    width = max(*(image.shape[1] for _, _, image in padded), int(texels**0.5))
    places = np.zeros((len(pyramids), LEVELS, 2), np.float32)
    x = y = shelf = 0
    where = []
    for i, k, image in padded:
        h, w = image.shape[:2]
        if x + w > width:
            x, y, shelf = 0, y + shelf, 0
        where.append((x, y))
        places[i, k] = x + _BORDER, y + _BORDER
        x, shelf = x + w, max(shelf, h)
    atlas = np.zeros((y + shelf, width, 3), np.uint8)
    for (x, y), (_, _, image) in zip(where, padded, strict=True):
        atlas[y : y + image.shape[0], x : x + image.shape[1]] = image
    return atlas, places


def _bordered(image: np.ndarray) -> np.ndarray:
    """The image with its edge repeated, so that bilinear look-up has no bleeding."""
    b = _BORDER
    return cv2.copyMakeBorder(image, b, b, b, b, cv2.BORDER_REPLICATE)
