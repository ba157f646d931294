"""Images -> tracks of the scene: overlays and black borders are masked.

Points are tracked once. If some are classified as burnt in, their neighbourhoods are
masked like people and tracking is repeated: text takes a share of the points, and in a
dark scene all of them.
"""

import dataclasses
from collections.abc import Callable, Iterator

import cv2
import numpy as np
from jaxtyping import Bool, UInt8

from bodyslam_jax.config import Tracking
from bodyslam_jax.sfm.burnt_in import (
    burnt_in_warning,
    find_burnt_in,
    masks_of,
    without_burnt_in,
)
from bodyslam_jax.sfm.tracks import CELLS, WINDOW, follow
from bodyslam_jax.types import Sequence, Tracks

_MOST_PASSES = 3
_MANY_STILL = 0.5
"""Share of observations that stay at their pixel from which text may hide a scene that
gives no points beside it."""
_MOST_HIDDEN = 0.6
"""Of the image: if what is still covers more, the camera stands still."""
_LITTLE = 0.3
"""Of the image: if what is still lies in less, it may be text and no scene."""
_BLACK, _FLAT = 24, 8
"""Grey level of a border at most, and how much it may vary."""
_STEP = 12
"""Least difference of grey levels between a border and the scene beside it."""
_LEAST_BORDER = 0.015
"""Of the image's side."""


def track(
    sequence: Sequence,
    config: Tracking = Tracking(),
    progress: Callable[[int, int], None] | None = None,
) -> Tracks:
    """Follows static points of the scene through the images of a sequence.

    Args:
        progress: called with the number of frames done and their total, in each pass.

    **Raises:** `ValueError` if images cannot be read or OpenCV lacks BRISK.
    """
    width, height = sequence.intrinsics.width, sequence.intrinsics.height
    border = _Border(width, height)
    found = follow(sequence, config, look=border.look, progress=progress)
    warnings: tuple[str, ...] = ()
    x, y, w, h = inside = border.inside()
    if bordered := (w, h) != (width, height):
        warnings = (
            f"the image has a border: {w}x{h} px from ({x}, {y}) show the scene; a "
            "guessed focal length is that of the whole image.",
        )
    hidden: list[tuple[np.ndarray, np.ndarray]] = []
    share = 0.0
    for _ in range(_MOST_PASSES):
        wanted, sure, cover = _unwanted(found, sequence)
        if not wanted.any() and not bordered:
            break
        these = wanted[found.landmark]
        trial = [*hidden, (found.frame[these], found.uv[these])]
        masks = _masks(trial, inside, sequence)
        again = follow(sequence, config, hidden=masks, progress=progress)
        bordered = False
        if not sure and wanted.any() and not _confirmed(found, again, wanted, sequence):
            if cover < _LITTLE:
                warnings = (*warnings, _only_here(cover))
            break
        share = max(share, float(these.mean()) if len(these) else 0.0)
        found, hidden = again, trial
    found, left = without_burnt_in(found, sequence.intrinsics, sequence.num_frames)
    if max(share, left) > 0:
        warnings = (*warnings, burnt_in_warning(max(share, left)))
    return dataclasses.replace(found, warnings=warnings)


def _only_here(cover: float) -> str:
    return (
        f"all points that stand still lie in {100 * cover:.0f} % of the image: if that "
        "is text over a scene too dark to see, the camera motion found is wrong."
    )


def _unwanted(
    tracks: Tracks, sequence: Sequence
) -> tuple[Bool[np.ndarray, " l"], bool, float]:
    """Candidates for masking: burnt-in tracks, or all still tracks if most are still;
    whether that is certain; and the share of the image near uncertain candidates."""
    burnt = find_burnt_in(tracks, sequence.intrinsics, sequence.num_frames)
    if burnt.found or not len(tracks.landmark):
        return burnt.of_landmark, True, 0.0
    still = burnt.still[tracks.landmark]
    if still.mean() < _MANY_STILL:
        return burnt.of_landmark, True, 0.0
    size = (sequence.intrinsics.width, sequence.intrinsics.height)
    # Elsewhere in the image a scene may be found once still points are masked.
    near = np.zeros((size[1], size[0]), dtype=np.uint8)
    for x, y in np.unique(np.round(tracks.uv[still] / 8), axis=0) * 8:
        cv2.circle(near, (int(x), int(y)), max(size) // 20, 1, -1)
    cover = float(near.mean())
    return (burnt.still if cover < _MOST_HIDDEN else burnt.of_landmark), False, cover


def _confirmed(
    before: Tracks, after: Tracks, wanted: Bool[np.ndarray, " l"], sequence: Sequence
) -> bool:
    """Whether new points beside the masked ones move against them."""
    these = wanted[before.landmark]
    both = Tracks(
        np.concatenate([before.frame[these], after.frame]),
        np.concatenate([before.landmark[these], after.landmark + len(wanted)]),
        np.concatenate([before.uv[these], after.uv]),
    )
    found = find_burnt_in(both, sequence.intrinsics, sequence.num_frames)
    return bool(found.of_landmark[: len(wanted)][wanted].mean() > 0.5)


def _masks(
    hidden: list[tuple[np.ndarray, np.ndarray]],
    inside: tuple[int, int, int, int],
    sequence: Sequence,
) -> Iterator[UInt8[np.ndarray, "y x"]]:
    size = (sequence.intrinsics.width, sequence.intrinsics.height)
    reach = WINDOW // 2 + 2
    # Points are picked a fifth of a cell apart: between two there is text as well.
    radius = max(reach, round(0.2 * max(size) / CELLS) + 2)
    frame, uv = (np.concatenate([part[i] for part in hidden]) for i in (0, 1))
    x, y, w, h = inside
    outside = np.full((size[1], size[0]), 255, dtype=np.uint8)
    left, top = (x + reach if x else 0), (y + reach if y else 0)
    right = x + w - reach if x + w < size[0] else size[0]
    bottom = y + h - reach if y + h < size[1] else size[1]
    outside[top:bottom, left:right] = 0
    for mask in masks_of(frame, uv, sequence.num_frames, size, radius):
        yield cv2.bitwise_or(mask, outside)


class _Border:
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
