"""Checks that keypoints, bodies and camera agree, before anything is estimated.

Bodies are projected and compared with the keypoints, frame by frame. If they disagree,
hypotheses of what was done to one of them are tested (`explanations`):

- bodies of another focal length or principal point, and people whose rows are
  distributed over several numbers, are mended, with a warning;
- any other contradiction is refused, in one line with both sides and the figure;
- anything else that is unusual is a warning.

Distances are relative to the size of a person, the longer side of the box around the
keypoints. Bodies of common regressors are 0.05 to 0.13 from keypoints of common
detectors.
"""

import dataclasses
import logging
from collections.abc import Callable

import numpy as np

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.diagnostics.agreement.explanations import (
    Explanation,
    disagreement,
    explanations,
)
from bodyslam_jax.diagnostics.agreement.identities import settle_identities
from bodyslam_jax.diagnostics.agreement.image_points import (
    People,
    compact,
    distances,
    people_of,
    project,
)
from bodyslam_jax.diagnostics.agreement.oddities import warn_of_oddities
from bodyslam_jax.diagnostics.agreement.person_rows import have_any
from bodyslam_jax.diagnostics.agreement.resolution import resolved
from bodyslam_jax.people import correct_left_right
from bodyslam_jax.types import Sequence

_log = logging.getLogger(__name__)

_MAX_EXPLAINED_DISTANCE = 0.2
"""Distance, in sizes of a person, up to which an explanation is accepted, and beyond
which frames that are left out are numbered anew: half as much again as a regressor's
largest, 0.13."""
_MAX_DISTANCE_RATIO = 0.7
"""Ratio of the distance with an explanation to that without, up to which it is
accepted."""
_MIN_GAIN = 0.03
"""Decrease of the distance from which an explanation is accepted."""
_COMPLEXITY = {"copy": 0.012, "focal": 0.02, "crop": 0.03, "unit": 0.04}
"""Penalty, as a distance, on explanations with a measured parameter, the more the more
of a disagreement it takes up whatever the reason. A usual factor has none."""
_CONTRADICTION_DISTANCE, _DOUBT_DISTANCE = 0.35, 0.25
"""Distances, in sizes of a person, from which bodies and keypoints contradict each
other, and from which a warning is given."""
_SAMPLE_FRAMES = 40
"""Number of frames that are compared for each explanation, of one person; of more,
fewer, as every pair is compared."""
_MAX_PEOPLE = 12
"""Number of people of each kind and frame that are compared at most."""
_FRAME_STEPS = (2, 3, 4, 5, 6, 10)
"""Values of n of which every n-th frame is processed."""
_WHOLE_SHARE = 0.8
"""Share of frames with people from which they are in nearly all frames."""

Warn = Callable[[str], None]


def reconcile(sequence: Sequence, body: BodyModel) -> Sequence:
    """Returns the sequence with its parts in agreement; unchanged if they agree
    already.

    Left and right are corrected in frames in which a detector exchanged the limbs, so
    that all later stages use the same keypoints. Keypoints, bodies and camera are used,
    not the images. New warnings name what was corrected and what is unusual.

    Args:
        body: model whose joints are compared; any model of human size is adequate.

    **Raises:** `InputError`, one line with both sides and the figure, where they
    contradict each other and it is ambiguous which is right.
    """
    if sequence.keypoints is None and sequence.bodies is None:
        return sequence
    new_warnings: list[str] = []
    try:
        settled = _settle(sequence, body, new_warnings.append)
    except ValueError as error:
        raise InputError(f"{sequence.name}: {error}") from None
    if settled.keypoints is not None:
        keypoints, exchanged = correct_left_right(settled.keypoints, settled.fps)
        if exchanged.any():
            settled = dataclasses.replace(settled, keypoints=keypoints)
    if not new_warnings:
        return settled
    new = [text for text in new_warnings if text not in sequence.warnings]
    for text in new:
        _log.warning("%s: %s", sequence.name, text)
    return dataclasses.replace(settled, warnings=(*sequence.warnings, *new))


def _settle(sequence: Sequence, body: BodyModel, warn: Warn) -> Sequence:
    people = people_of(sequence, body)
    crowd = People(
        compact(people.keypoints, _MAX_PEOPLE),
        compact(people.bodies, _MAX_PEOPLE),
        people.camera,
    )
    if crowd.keypoints.shape[1] and crowd.bodies.shape[1]:
        sequence = _made_to_meet(sequence, body, crowd, warn)
    sequence = settle_identities(sequence, body, warn)
    return warn_of_oddities(sequence, people_of(sequence, body), warn)


def _made_to_meet(
    sequence: Sequence, body: BodyModel, crowd: People, warn: Warn
) -> Sequence:
    """Returns the sequence with bodies and keypoints at the same place."""
    pairs = crowd.keypoints.shape[1] * crowd.bodies.shape[1]
    most = max(_SAMPLE_FRAMES // 3, min(_SAMPLE_FRAMES, 4 * _SAMPLE_FRAMES // pairs))
    (frames,) = np.nonzero(crowd.both)
    if len(frames) > most:
        frames = frames[np.linspace(0, len(frames) - 1, most).round().astype(int)]
    some = People(crowd.keypoints[frames], crowd.bodies[frames], crowd.camera)
    given, chosen, best = _best_explanation(some)
    left_out = _frames_left_out(sequence)
    if given > _MAX_EXPLAINED_DISTANCE and left_out:
        raise InputError(
            f"{left_out}, and bodies and keypoints of the same number are "
            f"{given:.2f} of a person's size apart (median); expected both numbered by "
            "the frames of the video."
        )
    if chosen is not None:
        return resolved(sequence, body, crowd, chosen, given, best, warn)
    if given > _CONTRADICTION_DISTANCE:
        raise InputError(_apart(crowd, given))
    if given > _DOUBT_DISTANCE:
        warn(f"bodies lie {given:.2f} of a person's size from the keypoints (median).")
    return sequence


def _frames_left_out(sequence: Sequence) -> str | None:
    """Returns a text about keypoints or bodies whose last frame suggests that only
    every n-th frame was processed and numbered anew; `None` if neither's does."""
    for what, present in zip(("keypoints", "bodies"), have_any(sequence), strict=True):
        there = np.any(present, axis=0)
        if not there.any():
            continue
        t, count = len(there), int(np.flatnonzero(there)[-1]) + 1
        for n in _FRAME_STEPS:
            if count == -(-t // n) and there[:count].mean() > _WHOLE_SHARE:
                return (
                    f"{what} only in frames 0 to {count - 1} of {t}, one frame in {n}"
                )
    return None


def _best_explanation(people: People) -> tuple[float, Explanation | None, float]:
    """Returns the distance as given (NaN if unknown), the accepted explanation, if any,
    and the distance under it."""
    tried = [
        (disagreement(people.keypoints, e.forecast(people.bodies)), e)
        for e in explanations(people)
    ]
    given = tried[0][0]
    fine = [(d, e) for d, e in tried[1:] if np.isfinite(d)]
    if not np.isfinite(given) or not fine:
        return given, None, np.nan
    best = min(d for d, _ in fine)
    if not (
        best < min(_MAX_EXPLAINED_DISTANCE, _MAX_DISTANCE_RATIO * given)
        and given - best > _MIN_GAIN
    ):
        return given, None, best
    penalty = lambda e: 0.0 if e.usual else _COMPLEXITY[e.kind]
    distance, chosen = min(fine, key=lambda pair: pair[0] + penalty(pair[1]))
    return given, chosen, distance


def _apart(crowd: People, given: float) -> str:
    """Returns the error message for bodies and keypoints that show different people."""
    posed = project(crowd.camera, crowd.bodies)
    nearest = distances(crowd.keypoints, posed)
    nearest = np.where(np.isfinite(nearest), nearest, np.inf).min(
        (1, 2), initial=np.inf
    )
    nearest = nearest[np.isfinite(nearest)]
    share = (
        100 * float((nearest > _CONTRADICTION_DISTANCE).mean())
        if len(nearest)
        else 100.0
    )
    behind = crowd.bodies[..., 7, 2]
    behind = 100 * float((behind[np.isfinite(behind)] < 0).mean())
    where = f", {behind:.0f} % of them behind the camera" if behind > 5 else ""
    return (
        f"bodies and keypoints do not agree: {given:.1f} of a person's size apart "
        f"(median; in {share:.0f} % of the frames nobody is near){where}; expected "
        "keypoints in pixels and frames of this video, and bodies in the frame of its "
        "camera, x right, y down, z forward, in m, not in a world; leave one of the "
        "two out if they are of different people."
    )
