"""How a person is drawn by status: colour, opacity, dashes, name; and the legend."""

import dataclasses

import numpy as np
from jaxtyping import Int

from bodyslam_jax.diagnostics.reported_status import inferred_bones, reported_status
from bodyslam_jax.types import Result
from bodyslam_jax.view.style import PEOPLE, Color, Image, polylines, write_text

PALE = 0.8
"""Share of white in the colour of a limb that was inferred, not measured."""
_LINE_HEIGHT_PX, _SAMPLE_LENGTH_PX = 17, 26
"""Height of a line of the legend, and length of its sample of a line, px."""


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
                polylines(image, 16 * ends, (0, 0, 0), 4, dash)
                polylines(image, 16 * ends, (255, 255, 255), 2, dash)
                left += _SAMPLE_LENGTH_PX + 7
            write_text(image, text, (left, y), 0.45)
            y -= _LINE_HEIGHT_PX


def write_names(
    image: Image, names: list[tuple[str, tuple[float, float]]], size: float = 0.45
) -> None:
    """Writes names above their positions (px), moved up where they would cover each
    other."""
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
