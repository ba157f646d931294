"""Keypoints or bodies that were numbered anew, back to the frames that they are of."""

import dataclasses
from collections.abc import Callable

import numpy as np

from bodyslam_jax.diagnostics.person_rows import have_any
from bodyslam_jax.diagnostics.timing import Timing
from bodyslam_jax.diagnostics.undo import retimed
from bodyslam_jax.types import Sequence

_CLEAR = 3
"""Frames of a shift from which it is refused if it cannot be undone."""


def settle_times(
    sequence: Sequence, given: Timing, found: Timing, warn: Callable[[str], None]
) -> Sequence:
    """The sequence with the kind that was numbered anew where it belongs.

    A shift is undone if only one of the two can have it: keypoints or bodies that would
    be moved out of the video by it were not shifted.

    **Raises:** `ValueError` if it is not known which of the two was numbered anew.
    """
    seen, posed = (rows.any(0) for rows in have_any(sequence))
    figures = (
        f"distance {found.disagreement:.2f} of a person's size then, "
        f"{given.disagreement:.2f} as they are (median)"
    )
    n = abs(found.step)
    if n:
        what, there = ("keypoints", seen) if found.step > 0 else ("bodies", posed)
        warn(
            f"{what} of {int(there.sum())} frames fit those of {len(there)} only as of "
            f"every {n}{_ordinal(n)} frame, numbered anew: number k put at frame {n} k "
            f"({figures})."
        )
        bundle = retimed(getattr(sequence, what), lambda k: n * k)
        return dataclasses.replace(sequence, **{what: bundle})
    if found.rate != 1:
        raise ValueError(
            "keypoints and bodies are not of the same frames: frame k of the "
            "keypoints "
            f"fits frame {found.rate:.3g} k of the bodies ({figures}); expected both "
            "of "
            "this video, not of copies at another frame rate."
        )
    return _shifted_back(sequence, seen, posed, found, figures, warn)


def _shifted_back(sequence, seen, posed, found: Timing, figures: str, warn) -> Sequence:
    t = len(seen)
    tries = [_mover(seen, posed, found.shift + near) for near in (0, 1, -1)]
    # Measured to a frame: rather a shift that fills the video to an end.
    known = sorted((m for m in tries if m), key=lambda m: not m[2])
    shift = found.shift
    frames = f"{abs(shift)} frames {'later' if shift > 0 else 'earlier'}"
    if known:
        what, by, _ = known[0]
        warn(
            f"bodies are numbered {frames} than the keypoints that they fit: {what} "
            f"moved by {by:+d} frames ({figures})."
        )
        bundle = retimed(getattr(sequence, what), lambda k: k + by)
        return dataclasses.replace(sequence, **{what: bundle})
    text = (
        f"of {t} frames, bodies are numbered {frames} than the keypoints that they fit "
        f"({figures}); expected both numbered by the frames of the video"
    )
    if abs(shift) >= _CLEAR:
        raise ValueError(f"{text}.")
    warn(f"{text}.")
    return sequence


def _mover(seen, posed, shift: int) -> tuple[str, int, bool] | None:
    """The one kind that `shift` does not move out of the video, by how much, and
    whether it then is there from the first or to the last frame."""
    t, found = len(seen), []
    for what, there, by in (("keypoints", seen, shift), ("bodies", posed, -shift)):
        first, last = np.flatnonzero(there)[[0, -1]] + by
        if first >= 0 and last < t:
            found.append((what, by, bool(first == 0 or last == t - 1)))
    return found[0] if len(found) == 1 else None


def _ordinal(n: int) -> str:
    return {2: "nd", 3: "rd"}.get(n, "th")
