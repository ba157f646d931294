"""Black bars above and below or beside the scene, such as of a letterboxed video."""

import numpy as np
from jaxtyping import UInt8

_BLACK, _FLAT = 24, 8
"""Grey level of a border at most, and how much it may vary."""
_STEP = 12
"""Least difference of grey levels between a border and the scene beside it."""
_LEAST_BORDER = 0.015
"""Of the image's side."""


class ImageBorder:
    """Rows above and below, or columns on both sides, that are black in all images.

    Text may stand in them: the darker half of each row or column decides.
    """

    def __init__(self, width: int, height: int):
        self.size = (width, height)
        self.darkest = [np.full(n, 255) for n in self.size]
        self.brightest = [np.zeros(n, np.int64) for n in self.size]

    def look(self, image: UInt8[np.ndarray, "y x"]) -> None:
        """Takes another image into account."""
        for axis, lines in enumerate((image[::4].T, image[:, ::4])):
            if lines.shape[0] != len(self.darkest[axis]):
                return  # a wrong image size is refused by the reader
            ranks = lines.shape[1] // 8, lines.shape[1] // 2
            part = np.partition(lines, ranks, axis=1)
            self.darkest[axis] = np.minimum(self.darkest[axis], part[:, ranks[0]])
            self.brightest[axis] = np.maximum(self.brightest[axis], part[:, ranks[1]])

    def inside(self) -> tuple[int, int, int, int]:
        """x, y, width and height (px) of the image without its border."""
        (x, right), (y, bottom) = (
            _inside(low, high)
            for low, high in zip(self.darkest, self.brightest, strict=True)
        )
        return x, y, right - x, bottom - y


def _inside(low: np.ndarray, high: np.ndarray) -> tuple[int, int]:
    """First line within the border, and first beyond."""
    edge = (high <= _BLACK) & (high - low <= _FLAT)
    count = len(edge)
    if edge.all():
        return 0, count
    before, after = int(np.argmin(edge)), int(np.argmin(edge[::-1]))
    # Bars come in pairs and end at once: what is dark by itself, as at night, does not.
    alike = abs(before - after) <= max(2, 0.1 * before)
    if min(before, after) < max(2, _LEAST_BORDER * count) or not alike:
        return 0, count
    steps = high[before + 1] - high[before - 1], high[-after - 2] - high[-after]
    if min(steps) < _STEP:
        return 0, count
    return before, count - after
