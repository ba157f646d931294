"""Tracks points of the scene through images, with overlays and black borders masked.

Points are tracked once. If some are classified as burnt in (text or a logo drawn over
the video), their neighbourhoods are masked like people and tracking is repeated:
otherwise a share of all points would lie on the overlay, and in a dark scene all.
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
from bodyslam_jax.sfm.tracks import KLT_WINDOW_PX, NUM_CELLS, follow
from bodyslam_jax.types import Sequence, Tracks

_MAX_PASSES = 3
"""Largest number of passes over the video with masked overlays."""
_MAX_STILL_SHARE = 0.5
"""If more than this share of observations stays at the same pixel, all tracked points
may lie on an overlay, and the scene may have points only once these are masked."""
_MAX_HIDDEN_SHARE = 0.6
"""If points that do not move cover more than this share of the image, the camera does
not move."""
_MAX_OVERLAY_SHARE = 0.3
"""If points that do not move cover less than this share of the image, they may be an
overlay instead of the scene."""
_MAX_BORDER_LEVEL, _MAX_BORDER_RANGE = 24, 8
"""Largest grey level of a border, and its largest variation."""
_MIN_BORDER_STEP = 12
"""Least difference of grey levels between a border and the scene beside it."""
_MIN_BORDER_SHARE = 0.015
"""Least width of a border, as a share of the image's side."""


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
    border = _ImageBorder(width, height)
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
    for _ in range(_MAX_PASSES):
        wanted, sure, cover = _unwanted(found, sequence)
        if not wanted.any() and not bordered:
            break
        these = wanted[found.landmark]
        trial = [*hidden, (found.frame[these], found.uv[these])]
        masks = _masks(trial, inside, sequence)
        again = follow(sequence, config, hidden=masks, progress=progress)
        bordered = False
        if not sure and wanted.any() and not _confirmed(found, again, wanted, sequence):
            if cover < _MAX_OVERLAY_SHARE:
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
    """Returns candidates for masking, which are burnt-in tracks, or all still tracks if
    most are still; whether that is certain; and the share of the image near uncertain
    candidates."""
    burnt = find_burnt_in(tracks, sequence.intrinsics, sequence.num_frames)
    if burnt.found or not len(tracks.landmark):
        return burnt.of_landmark, True, 0.0
    still = burnt.still[tracks.landmark]
    if still.mean() < _MAX_STILL_SHARE:
        return burnt.of_landmark, True, 0.0
    size = (sequence.intrinsics.width, sequence.intrinsics.height)
    # Elsewhere in the image a scene may be found once still points are masked.
    near = np.zeros((size[1], size[0]), dtype=np.uint8)
    for x, y in np.unique(np.round(tracks.uv[still] / 8), axis=0) * 8:
        cv2.circle(near, (int(x), int(y)), max(size) // 20, 1, -1)
    cover = float(near.mean())
    return (
        (burnt.still if cover < _MAX_HIDDEN_SHARE else burnt.of_landmark),
        False,
        cover,
    )


def _confirmed(
    before: Tracks, after: Tracks, wanted: Bool[np.ndarray, " l"], sequence: Sequence
) -> bool:
    """Returns True if masked tracks are an overlay: points tracked after masking move
    relative to them.

    Args:
        before: tracks before masking.
        after: tracks found with the neighbourhoods of the masked tracks masked.
        wanted: which landmarks of `before` were masked.
    """
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
    reach = KLT_WINDOW_PX // 2 + 2
    # Points are picked a fifth of a cell apart: text between two is masked as well.
    radius = max(reach, round(0.2 * max(size) / NUM_CELLS) + 2)
    frame, uv = (np.concatenate([part[i] for part in hidden]) for i in (0, 1))
    x, y, w, h = inside
    outside = np.full((size[1], size[0]), 255, dtype=np.uint8)
    left, top = (x + reach if x else 0), (y + reach if y else 0)
    right = x + w - reach if x + w < size[0] else size[0]
    bottom = y + h - reach if y + h < size[1] else size[1]
    outside[top:bottom, left:right] = 0
    for mask in masks_of(frame, uv, sequence.num_frames, size, radius):
        yield cv2.bitwise_or(mask, outside)


class _ImageBorder:
    """Black bars above and below, or beside the scene, as in a letterboxed video.

    They are rows or columns that are black in all images. As text may stand in them,
    the darker half of each row or column decides.
    """

    def __init__(self, width: int, height: int):
        self.size = (width, height)
        self.darkest = [np.full(n, 255) for n in self.size]
        self.brightest = [np.zeros(n, np.int64) for n in self.size]

    def look(self, image: UInt8[np.ndarray, "y x"]) -> None:
        """Adds an image to the statistics."""
        for axis, lines in enumerate((image[::4].T, image[:, ::4])):
            if lines.shape[0] != len(self.darkest[axis]):
                return  # a wrong image size is refused by the reader
            ranks = lines.shape[1] // 8, lines.shape[1] // 2
            part = np.partition(lines, ranks, axis=1)
            self.darkest[axis] = np.minimum(self.darkest[axis], part[:, ranks[0]])
            self.brightest[axis] = np.maximum(self.brightest[axis], part[:, ranks[1]])

    def inside(self) -> tuple[int, int, int, int]:
        """Returns x, y, width and height (px) of the image without its border."""
        (x, right), (y, bottom) = (
            _inside(low, high)
            for low, high in zip(self.darkest, self.brightest, strict=True)
        )
        return x, y, right - x, bottom - y


def _inside(low: np.ndarray, high: np.ndarray) -> tuple[int, int]:
    """Returns the first line inside the border, and the first beyond it."""
    edge = (high <= _MAX_BORDER_LEVEL) & (high - low <= _MAX_BORDER_RANGE)
    count = len(edge)
    if edge.all():
        return 0, count
    before, after = int(np.argmin(edge)), int(np.argmin(edge[::-1]))
    # Bars come in pairs and have sharp edges, unlike dark scenes, as at night.
    alike = abs(before - after) <= max(2, 0.1 * before)
    if min(before, after) < max(2, _MIN_BORDER_SHARE * count) or not alike:
        return 0, count
    steps = high[before + 1] - high[before - 1], high[-after - 2] - high[-after]
    if min(steps) < _MIN_BORDER_STEP:
        return 0, count
    return before, count - after
