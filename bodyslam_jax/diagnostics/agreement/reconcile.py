"""Agreement of keypoints, bodies and camera, checked before anything is estimated.

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

_BELIEVED = 0.2
"""Largest distance under an explanation that is accepted."""
_BETTER = 0.7
"""Largest distance under it, relative to that without it."""
_COPY, _MUCH_BETTER = 0.15, 0.5
"""The same for a copy of arbitrary shift and size."""
_GAIN = 0.03
"""Least decrease of the distance."""
_BETTER_TIME, _GAIN_TIME = 0.87, 0.012
"""The same for another timing, which has a smaller effect."""
_HINT, _MORE = 0.95, 0.6
"""The same for a warning only, and the share of frames that must improve."""
_CONTRADICTION, _DOUBT = 0.35, 0.25
"""Distances from which bodies and keypoints contradict each other; are doubtful."""
_SAMPLE = 40
"""Frames that are compared for each explanation."""
_CROWD = 12
"""Largest number of people of each kind and frame that are compared."""

Warn = Callable[[str], None]


def reconcile(sequence: Sequence, body: BodyModel) -> Sequence:
    """The sequence with its parts in agreement; unchanged if they agree already.

    Limbs whose left and right a detector exchanged in some frames have their names
    again, so that all that follows has the same keypoints.

    Uses keypoints, bodies and camera, not the images. New warnings name what was undone
    and what is unusual.

    Args:
        body: the model whose joints are compared; any of a person's size is adequate.

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
        compact(people.keypoints, _CROWD), compact(people.bodies, _CROWD), people.camera
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
    """The sequence with bodies and keypoints at the same place and time, and whether
    their left and right sides contradict each other."""
    pairs = crowd.keypoints.shape[1] * crowd.bodies.shape[1]
    frames = some_frames(crowd, max(_SAMPLE // 3, min(_SAMPLE, 4 * _SAMPLE // pairs)))
    given, chosen, best = _best_explanation(of_frames(crowd, frames, frames))
    as_timed, timing = best_timing(crowd)
    if timing.rate != 1 or abs(timing.shift) > 1:
        gain = as_timed.disagreement - timing.disagreement
        left = timing.disagreement / as_timed.disagreement
        believed = timing.disagreement < _BELIEVED and (
            chosen is None or timing.disagreement < 0.9 * best
        )
        if believed and left < _BETTER_TIME and gain > _GAIN_TIME:
            return settle_times(sequence, as_timed, timing, warn), False
        if believed and chosen is None and left < _HINT and timing.better > _MORE:
            warn(
                f"bodies fit keypoints {abs(timing.shift)} frames "
                f"{'earlier' if timing.shift > 0 else 'later'} a little better than "
                f"those of the same frame (in {100 * timing.better:.0f} % of the "
                "frames)."
            )
    if chosen is not None:
        sequence = undone(sequence, body, crowd, chosen, given, best, warn)
        return sequence, chosen.kind == "sides"
    if given > _CONTRADICTION:
        raise InputError(_apart(crowd, given))
    if given > _DOUBT:
        warn(f"bodies lie {given:.2f} of a person's size from the keypoints (median).")
    return sequence, False


def _best_explanation(people: People) -> tuple[float, Explanation | None, float]:
    """Distance as given (NaN if unknown), the accepted explanation, if any, and the
    distance under it."""
    tried = [
        (disagreement(people.keypoints, e.forecast(people.bodies)), e)
        for e in explanations(people)
    ]
    given = tried[0][0]
    fine = [(d, e) for d, e in tried[1:] if np.isfinite(d)]
    if not np.isfinite(given) or not fine:
        return given, None, np.nan
    best = min(d for d, _ in fine)
    if not (best < min(_BELIEVED, _BETTER * given) and given - best > _GAIN):
        return given, None, best
    distance, chosen = min(
        fine,
        key=lambda pair: pair[0] + _complexity(pair[1]) + _oddness(pair[1], people),
    )
    if chosen.kind == "copy" and distance > min(_COPY, _MUCH_BETTER * given):
        return given, None, distance
    return given, chosen, distance


def _complexity(explanation: Explanation) -> float:
    """Penalty, as a distance, on explanations with more free parameters: a measured
    factor in place of a common one, a crop, a crop of any size."""
    measured = {"keypoints": 0.012, "focal": 0.02, "unit": 0.04}
    free = {"crop": 0.03, "copy": 0.04}
    if explanation.kind in free:
        return free[explanation.kind]
    if explanation.kind == "focal" and explanation.name:
        return measured["focal"] + 0.01
    return 0.0 if explanation.reason else measured.get(explanation.kind, 0.0)


def _oddness(explanation: Explanation, people: People) -> float:
    """Penalty, as a distance, on image rotations after which people are not upright."""
    upright = lambda uv: shares(trunk_directions(uv))[1]["upright"]
    detected = people.keypoints
    if explanation.kind == "keypoints" and explanation.name:
        righted = explanation.image.inverse(detected)
        return 0.0 if upright(righted) > max(0.5, upright(detected)) else _GAIN
    if explanation.kind == "axes" and explanation.R[2, 2] == 1:
        return 0.0 if upright(detected) > 0.5 else _GAIN
    return 0.0


def _apart(crowd: People, given: float) -> str:
    """The message for bodies and keypoints that are not of the same people."""
    posed = project(crowd.camera, crowd.bodies)
    nearest = distances(crowd.keypoints, posed)
    nearest = np.where(np.isfinite(nearest), nearest, np.inf).min(
        (1, 2), initial=np.inf
    )
    nearest = nearest[np.isfinite(nearest)]
    share = 100 * float((nearest > _CONTRADICTION).mean()) if len(nearest) else 100.0
    behind = crowd.bodies[..., 7, 2]
    behind = 100 * float((behind[np.isfinite(behind)] < 0).mean())
    where = f", {behind:.0f} % of them behind the camera" if behind > 5 else ""
    return (
        f"bodies and keypoints do not agree: {given:.1f} of a person's size apart "
        f"(median; in {share:.0f} % of the frames nobody is near){where}; expected "
        "bodies in the frame of the camera, x right, y down, z forward, in m, not in a "
        "world; leave one of the two out if they are of different people."
    )
