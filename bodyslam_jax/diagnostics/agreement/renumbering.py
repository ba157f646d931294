"""Undoes renumberings of the frames of keypoints or bodies."""

import dataclasses
from collections.abc import Callable

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.diagnostics.agreement.person_rows import have_any
from bodyslam_jax.diagnostics.agreement.timing import Timing
from bodyslam_jax.diagnostics.agreement.undo import retimed
from bodyslam_jax.types import Sequence

_MIN_REFUSED_SHIFT_FRAMES = 3
"""Shift from which the input is refused if the shift cannot be undone."""


def settle_times(
    sequence: Sequence, given: Timing, found: Timing, warn: Callable[[str], None]
) -> Sequence:
    """Returns the sequence with keypoints or bodies moved to the frames they belong to.

    A shift is undone if only one of the two kinds can be shifted within the video.

    **Raises:** `InputError` if it is ambiguous which of the two was renumbered.
    """
    with_keypoints, with_bodies = (np.any(x, axis=0) for x in have_any(sequence))
    figures = (
        f"distance {found.disagreement:.2f} of a person's size then, "
        f"{given.disagreement:.2f} as they are (median)"
    )
    n = abs(found.step)
    if n:
        what, present = (
            ("keypoints", with_keypoints) if found.step > 0 else ("bodies", with_bodies)
        )
        warn(
            f"{what} of {int(present.sum())} frames fit those of {len(present)} only "
            f"as of every {n}{_ordinal(n)} frame, numbered anew: number k put at frame "
            f"{n} k ({figures})."
        )
        bundle = retimed(getattr(sequence, what), lambda k: n * k)
        return dataclasses.replace(sequence, **{what: bundle})
    if found.rate != 1:
        raise InputError(
            "keypoints and bodies are not of the same frames: frame k of the "
            "keypoints "
            f"fits frame {found.rate:.3g} k of the bodies ({figures}); expected both "
            "of "
            "this video, not of copies at another frame rate."
        )
    return _shifted_back(sequence, with_keypoints, with_bodies, found, figures, warn)


def _shifted_back(
    sequence, with_keypoints, with_bodies, found: Timing, figures: str, warn
) -> Sequence:
    t = len(with_keypoints)
    tries = [
        _mover(with_keypoints, with_bodies, found.shift + near) for near in (0, 1, -1)
    ]
    # The shift is accurate to a frame: prefer one that reaches an end of the video.
    movers = sorted((m for m in tries if m), key=lambda m: not m[2])
    shift = found.shift
    frames = f"{abs(shift)} frames {'later' if shift > 0 else 'earlier'}"
    if movers:
        what, by, _ = movers[0]
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
    if abs(shift) >= _MIN_REFUSED_SHIFT_FRAMES:
        raise InputError(f"{text}.")
    warn(f"{text}.")
    return sequence


def _mover(with_keypoints, with_bodies, shift: int) -> tuple[str, int, bool] | None:
    """Returns the only kind that `shift` keeps within the video, its shift in frames,
    and whether it then reaches the first or the last frame; `None` if that is not
    unique."""
    t, found = len(with_keypoints), []
    for what, present, by in (
        ("keypoints", with_keypoints, shift),
        ("bodies", with_bodies, -shift),
    ):
        first, last = np.flatnonzero(present)[[0, -1]] + by
        if first >= 0 and last < t:
            found.append((what, by, bool(first == 0 or last == t - 1)))
    return found[0] if len(found) == 1 else None


def _ordinal(n: int) -> str:
    return {2: "nd", 3: "rd"}.get(n, "th")
