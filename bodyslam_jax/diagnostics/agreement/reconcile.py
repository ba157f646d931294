"""Checks that keypoints, bodies and camera agree, before anything is estimated.

Bodies are projected and compared with the keypoints, frame by frame. If they disagree,
hypotheses of what was done to one of them are tested (`explanations`, `timing`):

- the effect of a clearly best hypothesis is undone, with a warning;
- a contradiction is refused, in one line with both sides and the figure;
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
from bodyslam_jax.diagnostics.agreement.exchanges import put_back_exchanges
from bodyslam_jax.diagnostics.agreement.explanations import (
    Explanation,
    disagreement,
    explanations,
    of_frames,
    some_frames,
)
from bodyslam_jax.diagnostics.agreement.facing import shares, trunk_directions
from bodyslam_jax.diagnostics.agreement.identities import settle_identities
from bodyslam_jax.diagnostics.agreement.image_points import (
    People,
    compact,
    distances,
    people_of,
    project,
)
from bodyslam_jax.diagnostics.agreement.oddities import warn_of_oddities
from bodyslam_jax.diagnostics.agreement.renumbering import settle_times
from bodyslam_jax.diagnostics.agreement.resolution import undone
from bodyslam_jax.diagnostics.agreement.timing import best_timing
from bodyslam_jax.people import correct_left_right
from bodyslam_jax.types import Sequence

_log = logging.getLogger(__name__)

_MAX_EXPLAINED_DISTANCE = 0.2
"""Distance, in sizes of a person, up to which an explanation is accepted."""
_MAX_DISTANCE_RATIO = 0.7
"""Ratio of the distance with an explanation to that without, up to which it is
accepted."""
_MAX_COPY_DISTANCE, _MAX_COPY_DISTANCE_RATIO = 0.15, 0.5
"""The same two limits for a copy of arbitrary shift and size."""
_MIN_GAIN = 0.03
"""Decrease of the distance from which an explanation is accepted."""
_MAX_TIMING_RATIO, _MIN_TIMING_GAIN = 0.87, 0.012
"""Limits of ratio and gain for another timing, which has a smaller effect."""
_MAX_HINT_RATIO, _MIN_HINT_FRAMES_SHARE = 0.95, 0.6
"""Limit of the ratio for a mere warning, and the share of frames that must improve."""
_CONTRADICTION_DISTANCE, _DOUBT_DISTANCE = 0.35, 0.25
"""Distances, in sizes of a person, from which bodies and keypoints contradict each
other, and from which a warning is given."""
_SAMPLE_FRAMES = 40
"""Number of frames that are compared for each explanation."""
_MAX_PEOPLE = 12
"""Number of people of each kind and frame that are compared at most."""

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
    exchanged = False
    if crowd.keypoints.shape[1] and crowd.bodies.shape[1]:
        sequence, exchanged = _made_to_meet(sequence, body, crowd, warn)
    sequence = settle_identities(sequence, body, warn)
    people = people_of(sequence, body)
    put_back = put_back_exchanges(sequence, people, warn)
    if put_back is not sequence:
        sequence, people = put_back, people_of(put_back, body)
    return warn_of_oddities(sequence, people, warn, sides=not exchanged)


def _made_to_meet(
    sequence: Sequence, body: BodyModel, crowd: People, warn: Warn
) -> tuple[Sequence, bool]:
    """Returns the sequence with bodies and keypoints at the same place and time, and
    whether their left and right sides contradict each other."""
    pairs = crowd.keypoints.shape[1] * crowd.bodies.shape[1]
    frames = some_frames(
        crowd,
        max(_SAMPLE_FRAMES // 3, min(_SAMPLE_FRAMES, 4 * _SAMPLE_FRAMES // pairs)),
    )
    given, chosen, best = _best_explanation(of_frames(crowd, frames, frames))
    as_timed, timing = best_timing(crowd)
    if timing.rate != 1 or abs(timing.shift) > 1:
        gain = as_timed.disagreement - timing.disagreement
        left = timing.disagreement / as_timed.disagreement
        believed = timing.disagreement < _MAX_EXPLAINED_DISTANCE and (
            chosen is None or timing.disagreement < 0.9 * best
        )
        if believed and left < _MAX_TIMING_RATIO and gain > _MIN_TIMING_GAIN:
            return settle_times(sequence, as_timed, timing, warn), False
        if (
            believed
            and chosen is None
            and left < _MAX_HINT_RATIO
            and timing.better > _MIN_HINT_FRAMES_SHARE
        ):
            warn(
                f"bodies fit keypoints {abs(timing.shift)} frames "
                f"{'earlier' if timing.shift > 0 else 'later'} a little better than "
                f"those of the same frame (in {100 * timing.better:.0f} % of the "
                "frames)."
            )
    if chosen is not None:
        sequence = undone(sequence, body, crowd, chosen, given, best, warn)
        return sequence, chosen.kind == "sides"
    if given > _CONTRADICTION_DISTANCE:
        raise InputError(_apart(crowd, given))
    if given > _DOUBT_DISTANCE:
        warn(f"bodies lie {given:.2f} of a person's size from the keypoints (median).")
    return sequence, False


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
    distance, chosen = min(
        fine,
        key=lambda pair: pair[0] + _complexity(pair[1]) + _oddness(pair[1], people),
    )
    if chosen.kind == "copy" and distance > min(
        _MAX_COPY_DISTANCE, _MAX_COPY_DISTANCE_RATIO * given
    ):
        return given, None, distance
    return given, chosen, distance


def _complexity(explanation: Explanation) -> float:
    """Returns a penalty, as a distance, on explanations with more free parameters: a
    measured instead of a common factor, a crop, or a resized crop."""
    measured = {"keypoints": 0.012, "focal": 0.02, "unit": 0.04}
    free = {"crop": 0.03, "copy": 0.04}
    if explanation.kind in free:
        return free[explanation.kind]
    if explanation.kind == "focal" and explanation.name:
        return measured["focal"] + 0.01
    return 0.0 if explanation.reason else measured.get(explanation.kind, 0.0)


def _oddness(explanation: Explanation, people: People) -> float:
    """Returns a penalty, as a distance, on image rotations that do not make people
    upright."""
    upright = lambda uv: shares(trunk_directions(uv))[1]["upright"]
    detected = people.keypoints
    if explanation.kind == "keypoints" and explanation.name:
        righted = explanation.image.inverse(detected)
        return 0.0 if upright(righted) > max(0.5, upright(detected)) else _MIN_GAIN
    if explanation.kind == "axes" and explanation.R[2, 2] == 1:
        return 0.0 if upright(detected) > 0.5 else _MIN_GAIN
    return 0.0


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
        "bodies in the frame of the camera, x right, y down, z forward, in m, not in a "
        "world; leave one of the two out if they are of different people."
    )
