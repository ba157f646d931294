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
from bodyslam_jax.sfm.image_border import ImageBorder
from bodyslam_jax.sfm.tracks import CELLS, WINDOW, follow
from bodyslam_jax.types import Sequence, Tracks

_MOST_PASSES = 3
_MANY_STILL = 0.5
"""If more than this share of observations stays at the same pixel, all tracked points
may lie on an overlay, and the scene may have points only once these are masked."""
_MOST_HIDDEN = 0.6
"""If points that do not move cover more than this share of the image, the camera does
not move."""
_LITTLE = 0.3
"""If points that do not move cover less than this share of the image, they may be an
overlay instead of the scene."""


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
    border = ImageBorder(width, height)
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
    """Whether masked tracks are an overlay: whether points tracked after masking move
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
