"""Colours and lettering of everything that is drawn, and the legend.

A person is drawn by status: in a colour, with an opacity, dashes and a name.
"""

import dataclasses

import cv2
import numpy as np
from jaxtyping import Int, UInt8

from bodyslam_jax.diagnostics.reported_status import inferred_bones, reported_status
from bodyslam_jax.geometry.arrays import runs
from bodyslam_jax.types import Result

Image = UInt8[np.ndarray, "y x 3"]
Color = tuple[int, int, int]
"""Blue, green, red; 0 to 255."""
SUBPIXELS = 16
"""OpenCV draws at coordinates with four binary places (`shift`)."""
CAMERA: Color = (214, 111, 31)
POINT: Color = (90, 230, 120)
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
"""Of camera, tracked points and people, as in the report."""
MIN_DEPTH_M = 0.05
"""Depth from which points of bodies are drawn, m."""
PALE = 0.8
"""Share of white in the colour of a limb that was inferred, not measured."""
_LINE_HEIGHT_PX, _SAMPLE_LENGTH_PX = 17, 26
"""Height of a line of the legend, and length of its sample of a line, px."""


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
    step = np.linalg.norm(np.diff(curve, axis=0), axis=1) / SUBPIXELS
    along = np.concatenate([[0.0], np.cumsum(step)])
    at = np.arange(0.0, along[-1], 1.0)
    points = np.stack([np.interp(at, along, axis) for axis in curve.T], axis=-1)
    drawn = at % sum(dash) < dash[0]
    return [np.round(points[run]).astype(int) for run in runs(drawn)]


@dataclasses.dataclass(frozen=True)
class PersonStyle:
    """How one person is drawn on images."""

    name: str
    """Name of the person, with the status if it is not `ok`."""
    words: str
    """The status in words; empty if it is `ok`."""
    color: Color
    """Colour of lines, BGR."""
    white: float
    """Share of white in the colour of the body."""
    opacity: float
    """Opacity of the body over the image: a misfit is visible only if the person shows
    through."""
    dash: tuple[int, int] | None
    """Lengths that are drawn and left out of the outline and of paths, px; `None` for a
    whole line."""

    @property
    def faint(self) -> Color:
        """Returns the colour on the dark insets, where no body is drawn."""
        share = 1.0 if self.dash is None else 0.8 if self.opacity > 0.3 else 0.55
        b, g, r = (int(share * c + (1 - share) * 60) for c in self.color)
        return b, g, r


_BY_STATUS = {
    "ok": (0.25, 0.5, None),
    "doubtful": (0.6, 0.4, (9, 6)),
    "not_measurable": (0.75, 0.2, (2, 5)),
}


def person_styles(result: Result) -> list[PersonStyle]:
    """Returns the style of each person of a result, by the status in its summary."""
    found = []
    for h in range(len(result.poses)):
        reported = reported_status(result.summary, h)
        look = _BY_STATUS.get(reported.status, _BY_STATUS["ok"])
        color = PEOPLE[h % len(PEOPLE)]
        found.append(PersonStyle(reported.named(h), reported.words, color, *look))
    return found


class Legend:
    """The meaning of the dashes, dots and pale limbs that a result has."""

    def __init__(self, result: Result, styles: list[PersonStyle]):
        shown = [style for style, p in zip(styles, result.present) if p.any()]
        self.entries: dict[str, tuple[int, int] | None]
        self.entries = {s.words: s.dash for s in shown if s.dash is not None}
        if inferred_bones(result).any():
            self.entries["pale: hidden, inferred"] = None

    def draw(self, image: Image, corner: tuple[int, int]) -> None:
        """Writes the lines, the lowest at `corner` (its lower left), px."""
        x, y = corner
        for text, dash in reversed(self.entries.items()):
            left = x
            if dash is not None:
                ends: Int[np.ndarray, "2 2"] = np.array(
                    [[x, y - 4], [x + _SAMPLE_LENGTH_PX, y - 4]]
                )
                polylines(image, SUBPIXELS * ends, (0, 0, 0), 4, dash)
                polylines(image, SUBPIXELS * ends, (255, 255, 255), 2, dash)
                left += _SAMPLE_LENGTH_PX + 7
            write_text(image, text, (left, y), 0.45)
            y -= _LINE_HEIGHT_PX


def write_names(image: Image, names: list[tuple[str, tuple[float, float]]]) -> None:
    """Writes names above their positions (px), moved up where they would cover each
    other."""
    size = 0.45
    high, wide = 15.0, 17.0 * size
    taken: list[tuple[float, float, float]] = []
    for text, (u, v) in sorted(names, key=lambda item: item[1]):
        half = wide * len(text) / 2
        u = float(np.clip(u, half, max(image.shape[1] - half, half)))
        for a, b, y in sorted(taken, key=lambda t: -t[2]):
            if u - half < b and u + half > a and abs(v - y) < high:
                v = y - high
        taken.append((u - half, u + half, v))
        write_text(image, text, (round(u - half), round(max(v, high))), size)
