"""Whether keypoints, bodies and camera are of one video, before time is spent on it.

Bodies are projected and compared with the keypoints, frame by frame. Where they do not
meet, what may have been done to one of them is tried out (`_explanations`, `_timing`):

- what explains it beyond doubt is undone, and a warning says what was assumed;
- what contradicts itself is refused, in one line with both sides and the figure;
- what is merely odd is a warning.

Distances are in sizes of a person: the longer side of the box around the keypoints.
Bodies of common regressors lie 0.05 to 0.13 from the keypoints of common detectors.
"""

import dataclasses
import logging
from collections.abc import Callable

import numpy as np

from bodyslam_jax.body import BodyModel
from bodyslam_jax.diagnostics._explanations import (
    Explanation,
    disagreement,
    explanations,
    of_frames,
    some_frames,
)
from bodyslam_jax.diagnostics._identities import settle_identities
from bodyslam_jax.diagnostics._image_points import (
    People,
    compact,
    distances,
    people_of,
    project,
    sizes,
)
from bodyslam_jax.diagnostics._oddities import warn_of_oddities
from bodyslam_jax.diagnostics._postures import shares, trunk_directions
from bodyslam_jax.diagnostics._times import settle_times
from bodyslam_jax.diagnostics._timing import best_timing
from bodyslam_jax.diagnostics._undo import with_bodies_moved, with_keypoints_mapped_back
from bodyslam_jax.sequence import Sequence

_log = logging.getLogger(__name__)

_BELIEVED = 0.2
"""Distance that an explanation has to come down to."""
_BETTER = 0.7
"""What it may leave of the distance without it."""
_GAIN = 0.03
"""Distance that it has to gain."""
_BETTER_TIME, _GAIN_TIME = 0.87, 0.012
"""The same of another timing, which changes less."""
_HINT, _MORE = 0.95, 0.6
"""The same where it is only warned of, and the share of frames that are nearer then."""
_CONTRADICTION, _DOUBT = 0.35, 0.25
"""Distance from which bodies and keypoints are not of the same people; are doubtful."""
_ASIDE = 0.2
"""Distance to which a regressor may place everybody to the same side."""
_SAMPLE = 40
"""Frames that are compared for each explanation."""
_CROWD = 6
"""People of each kind and frame that are compared."""

Warn = Callable[[str], None]


def reconcile(sequence: Sequence, body: BodyModel) -> Sequence:
    """The sequence with its parts in agreement; itself if they are.

    Told from keypoints, bodies and camera alone; images are not looked at. New warnings
    say what was undone, and what is odd.

    Args:
        body: whose joints stand for the bodies' own; any of a person's size will do.

    **Raises:** `ValueError`, one line with both sides and the figure, where they
    contradict each other and nothing says which is right.
    """
    if sequence.keypoints is None and sequence.bodies is None:
        return sequence
    said: list[str] = []
    try:
        settled = _settle(sequence, body, said.append)
    except ValueError as error:
        raise ValueError(f"{sequence.name}: {error}") from None
    if not said:
        return settled
    new = [text for text in said if text not in sequence.warnings]
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
    return warn_of_oddities(sequence, people, warn, sides=not exchanged)


def _made_to_meet(
    sequence: Sequence, body: BodyModel, crowd: People, warn: Warn
) -> tuple[Sequence, bool]:
    """Bodies and keypoints at the same place and time in the image; and whether left
    and right were found to contradict."""
    frames = some_frames(crowd, _SAMPLE)
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
        sequence = _undone(sequence, body, crowd, chosen, given, best, warn)
        return sequence, chosen.kind == "sides"
    if given > _CONTRADICTION:
        raise ValueError(_apart(crowd, given))
    if given > _DOUBT:
        warn(f"bodies lie {given:.2f} of a person's size from the keypoints (median).")
    return sequence, False


def _best_explanation(people: People) -> tuple[float, Explanation | None, float]:
    """Distance as given (NaN: not known), and the explanation that is believed, if any,
    with what it leaves."""
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
    return given, chosen, distance


def _complexity(explanation: Explanation) -> float:
    """Distance that what leaves more free has to gain: a measured factor in place of
    one that there is a reason for, a crop, a crop of any size."""
    measured = {"keypoints": 0.012, "focal": 0.02, "unit": 0.04}
    free = {"crop": 0.03, "copy": 0.04}
    if explanation.kind in free:
        return free[explanation.kind]
    return 0.0 if explanation.reason else measured.get(explanation.kind, 0.0)


def _oddness(explanation: Explanation, people: People) -> float:
    """Of two that turn the image alike, the one after which people stand."""
    upright = lambda uv: shares(trunk_directions(uv))[1]["upright"]
    seen = people.keypoints
    if explanation.kind == "keypoints" and explanation.name:
        righted = explanation.image.inverse(seen)
        return 0.0 if upright(righted) > max(0.5, upright(seen)) else _GAIN
    if explanation.kind == "axes" and explanation.R[2, 2] == 1:
        return 0.0 if upright(seen) > 0.5 else _GAIN
    return 0.0


def _undone(
    sequence: Sequence,
    body: BodyModel,
    crowd: People,
    found: Explanation,
    given: float,
    best: float,
    warn: Warn,
) -> Sequence:
    """The sequence without what was found, or the refusal.

    **Raises:** `ValueError` if it is not known which side is right.
    """
    figures = (
        f"distance {best:.2f} of a person's size then, {given:.2f} as they are (median)"
    )
    if found.kind == "sides":
        warn(
            "left and right of the keypoints contradict the bodies: they fit with "
            "sides "
            f"exchanged ({figures}); either the keypoints' sides are, or the bodies "
            "face "
            "the other way."
        )
        return sequence
    if found.kind == "focal":
        return _refocused(sequence, body, found.factor, figures, warn)
    if found.kind == "unit":
        if not found.reason:
            raise ValueError(
                f"people are {found.factor:.2f} times as large in the keypoints as in "
                f"the bodies, in the same place ({figures}); expected bodies with "
                "`trans` in m."
            )
        warn(
            f"bodies are in another unit: `trans` divided by {found.factor:.4g} "
            f"({figures})."
        )
        return with_bodies_moved(sequence, body, lambda p: p / found.factor)
    if found.kind in ("crop", "copy"):
        return _shifted(sequence, body, crowd, found, figures, warn)
    return _turned_back(sequence, body, crowd, found, figures, warn)


def _refocused(sequence, body, factor: float, figures: str, warn: Warn) -> Sequence:
    focal = float(sequence.intrinsics.params[0])
    warn(
        f"bodies fit the keypoints as of a camera of {factor * focal:.0f} px focal "
        f"length, the camera has {focal:.0f} px: their distances are divided by "
        f"{factor:.3g} ({figures})."
    )
    depth = np.array([1.0, 1.0, factor])
    return with_bodies_moved(sequence, body, lambda p: p / depth)


def _shifted(sequence, body, crowd, found, figures: str, warn: Warn) -> Sequence:
    """A crop cannot be undone, as it is measured to some pixels only; another principal
    point can, if it is the middle of the image, which most tools take."""
    camera = sequence.intrinsics
    fx, fy, cx, cy = camera.params[:4]
    to_middle = np.array([(camera.width - 1) / 2 - cx, (camera.height - 1) / 2 - cy])
    size = float(np.nanmedian(sizes(crowd.keypoints)))
    shift = found.image.b
    if found.kind == "crop" and np.linalg.norm(shift - to_middle) < 0.06 * size:
        warn(
            "bodies fit the keypoints as of a camera whose principal point is the "
            "middle "
            f"of the image, not ({cx:.0f}, {cy:.0f}): moved accordingly ({figures})."
        )
        move = lambda p: p + p[:, 2:] * np.array([*(to_middle / [fx, fy]), 0.0])
        return with_bodies_moved(sequence, body, move)
    if found.kind == "crop" and np.linalg.norm(shift) < _ASIDE * size:
        warn(
            f"keypoints lie ({shift[0]:.0f}, {shift[1]:.0f}) px from the bodies in all "
            f"frames ({figures})."
        )
        return sequence
    resized = f"times {found.factor:.2f} and " if found.kind == "copy" else ""
    raise ValueError(
        f"keypoints are where the bodies are only if those are {resized}moved by "
        f"({shift[0]:.0f}, {shift[1]:.0f}) px in all frames ({figures}); expected "
        "keypoints in pixels of this video, not of a cropped or padded copy, and "
        "bodies "
        "in the frame of its camera."
    )


def _turned_back(
    sequence, body, crowd: People, found: Explanation, figures: str, warn: Warn
) -> Sequence:
    """Turned, mirrored or resized images, and other axes of the camera."""
    upright = shares(trunk_directions(crowd.keypoints))[1]["upright"]
    if found.kind == "axes":
        about_sight = found.R[2, 2] == 1
        if about_sight and upright < 0.5:
            raise ValueError(
                "keypoints and bodies are turned in the image against each other "
                f"(bodies fit if {found.name}: {figures}), and in neither are people "
                "upright; expected both in the video's own orientation."
            )
        warn(
            f"bodies are in another frame than the camera's (x right, y down, z "
            f"forward): {found.name}; turned into it ({figures})."
        )
        return with_bodies_moved(sequence, body, lambda p: p @ found.R.T, found.R)
    width, height = sequence.intrinsics.width, sequence.intrinsics.height
    if found.factor == 1:
        what = f"an image {found.name}"
    else:
        size = f"{found.factor * width:.0f}x{found.factor * height:.0f} px"
        turned = f", {found.name}" if found.name else ""
        what = f"a copy of {size}{turned}"
        if not found.reason:
            raise ValueError(
                f"keypoints are of {what}, {found.factor:.3f} times this video of "
                f"{width}x{height} px, as the bodies have it ({figures}); expected "
                "keypoints in pixels of the video."
            )
    if "mirrored" in found.name:
        raise ValueError(
            f"keypoints fit the bodies only as of {what} ({figures}): one of the two "
            "is "
            "of a mirrored copy; expected both of the video as it is."
        )
    if found.name == "":
        warn(
            f"keypoints fit the bodies as of {what}: divided by {found.factor:.3g} "
            f"({figures})."
        )
        return with_keypoints_mapped_back(sequence, found.image)
    back = with_keypoints_mapped_back(sequence, found.image)
    righted = shares(trunk_directions(people_of(back, body).keypoints))[1]["upright"]
    if not righted > max(0.5, upright):
        raise ValueError(
            f"keypoints fit the bodies only as of {what} ({figures}), but people are "
            f"upright in {100 * upright:.0f} % of the keypoints as they are and in "
            f"{100 * righted:.0f} % then; expected both of the video as it is."
        )
    warn(f"keypoints fit the bodies as of {what}: turned back ({figures}).")
    return back


def _apart(crowd: People, given: float) -> str:
    """Why bodies and keypoints are not of the same people."""
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
