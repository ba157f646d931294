"""Frames that only repeat the one before: conversions of the frame rate, and freezes.

A film of 24 frames/s in a file of 30, or of 30 in one of 60, holds frames twice; to a
motion model people then stop and start many times a second. A frame is a repeat if it
hardly differs from the one before while neighbouring frames differ much more. Videos of
a still scene, and videos whose encoder drops small changes, therefore have no repeats.
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from bodyslam_jax.geometry.arrays import runs

_NUM_SAMPLES = 320
"""Number of samples along the longer side of the images that are compared."""
_BLOCK_SAMPLES = 16
"""Number of samples along a side of the blocks whose mean change is taken."""
_MIN_MOTION = 2.0
"""Least mean change of the blocks that change most that counts as motion, grey
levels."""
_MAX_REPEAT_RATIO = 0.15
"""Largest change of a repeated frame relative to that of its neighbours."""
_NUM_NEIGHBOURS = 10
"""Number of neighbours on each side."""
_MAX_CONVERSION_REPEATS = 4
"""Largest number of consecutive repeats that a conversion makes; more are a freeze, or
people who stand still."""
_MIN_REPEATS = 2
"""Least number of repeats in a video; a single one may be chance."""
_MAX_CLOCK_DEVIATION = 0.8
"""Largest deviation of a regular conversion from an even clock, frames."""


class Repeats:
    """Collects the change from each image to the next, of a video read once."""

    def __init__(self) -> None:
        self.last: np.ndarray | None = None
        self.most: list[float] = []
        self.typical: list[float] = []

    def look(self, image: UInt8[np.ndarray, "y x *c"] | None) -> None:
        """Adds the next image, or `None` for one that cannot be decoded."""
        now = None
        if image is not None:
            step = max(1, max(image.shape[:2]) // _NUM_SAMPLES)
            plane = (
                image[::step, ::step, 1] if image.ndim == 3 else image[::step, ::step]
            )
            now = np.ascontiguousarray(plane)
        if self.most or self.last is not None:
            most, typical = _change(self.last, now)
            self.most.append(most)
            self.typical.append(typical)
        elif now is None:
            self.most.append(np.inf)
            self.typical.append(np.inf)
        self.last = now

    def repeated(self) -> Bool[np.ndarray, " t"]:
        """Returns which frames repeat the one before."""
        return repeated(np.asarray(self.most), np.asarray(self.typical))


def repeated(
    most: Float[np.ndarray, " n"], typical: Float[np.ndarray, " n"]
) -> Bool[np.ndarray, " t"]:
    """Returns which of n + 1 frames repeat the one before.

    Args:
        most: change (grey levels) from each frame to the next where most changes: of a
            person, if the camera stands.
        typical: change of the median block: not small only if the camera moves.
    """
    found = np.zeros(len(most) + 1, dtype=bool)
    for k, change in enumerate(most):
        near = most[max(0, k - _NUM_NEIGHBOURS) : k + _NUM_NEIGHBOURS + 1]
        near = np.sort(near[np.isfinite(near)])
        usual = np.median(near[len(near) // 2 :]) if len(near) else 0.0
        found[k + 1] = usual >= _MIN_MOTION and change < _MAX_REPEAT_RATIO * usual
    for run in runs(found):
        first, last = run.start, run.stop - 1
        # What moves goes on just before and after; people stop little by little.
        sides = [first - 2, last]  # changes into the frame before, and after the last
        sides = [k for k in sides if 0 <= k < len(most)]
        moves = typical if last - first + 1 > _MAX_CONVERSION_REPEATS else most
        if not sides or min(moves[k] for k in sides) < _MIN_MOTION:
            found[first : last + 1] = False
    if found.sum() < _MIN_REPEATS:
        found[:] = False
    return found


def without_repeats(
    times: Float[np.ndarray, " t"], found: Bool[np.ndarray, " t"]
) -> tuple[Float[np.ndarray, " k"], Int[np.ndarray, " k"]]:
    """Returns times (s) and indices of the frames that are new.

    Where new frames come as regularly as a conversion gives them, they were taken at
    equal times; otherwise each keeps the time at which it was shown first.
    """
    picks = np.flatnonzero(~found)
    kept = times[picks]
    if len(picks) < 3:
        return kept, picks
    even = np.linspace(picks[0], picks[-1], len(picks))
    if np.abs(even - picks).max() <= _MAX_CLOCK_DEVIATION:
        kept = np.linspace(kept[0], kept[-1], len(kept))
    return kept, picks


def repeats_warning(name: str, found: Bool[np.ndarray, " t"], fps: float) -> str:
    return (
        f"{name}: {found.sum()} of {len(found)} frames only repeat the one before, as "
        f"after a conversion of the frame rate: left out, {fps:.4g} frames/s remain."
    )


def _change(a: np.ndarray | None, b: np.ndarray | None) -> tuple[float, float]:
    if a is None or b is None or a.shape != b.shape:
        return np.inf, np.inf
    size = max(1, a.shape[1] // _BLOCK_SAMPLES), max(1, a.shape[0] // _BLOCK_SAMPLES)
    blocks = cv2.resize(
        cv2.absdiff(a, b).astype(np.float32), size, interpolation=cv2.INTER_AREA
    )
    return float(np.quantile(blocks, 0.98)), float(np.median(blocks))
