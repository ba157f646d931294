"""Makes people of the detections in each frame.

`tracking` says who is who where the detector does not. Duplicate tracks of one person,
and tracks of stray points of another person, are removed.
"""

import numpy as np

from bodyslam_jax.body.skeleton import BODY25_MIRRORED
from bodyslam_jax.config import Association
from bodyslam_jax.io.keypoints.reader import Detections
from bodyslam_jax.tracking.duplicates import Track, doubles, is_stray
from bodyslam_jax.tracking.tracker import PointSet, identify
from bodyslam_jax.types import Keypoints

_MIN_CONFIDENCE = 0.05
"""Least confidence of a detected keypoint."""
_BODY25_POINTS = PointSet(_MIN_CONFIDENCE, BODY25_MIRRORED)


def associate(
    detections: Detections,
    config: Association,
    fps: float,
    given: list[np.ndarray] | None = None,
) -> tuple[Keypoints, tuple[str, ...]]:
    """Returns the people in the detections of `t` frames, in the order of their
    presence, and warnings.

    Two at one place at one time are one person. People detected for less than
    `config.min_duration` are dropped, unless everybody is; and so are those with the
    least presence beyond `config.max_people`.

    Args:
        fps: frame rate, 1/s.
        given: for each frame the number of the person that each detection is of, if a
            detector tracks people; they keep the order of their numbers then.
    """
    found = given
    if found is None:
        found = identify(detections, fps, config.max_gap, _BODY25_POINTS)
    least = min(max(1, round(config.min_duration * fps)), len(detections))
    people, twice = _once(_collect(detections, found), least)
    kept = [p for p in people if len(p) >= least] or people
    gap = max(1, round(config.max_gap * fps))
    brief = sum(
        not is_stray(p, kept, gap, _MIN_CONFIDENCE)
        for p in people
        if not any(p is k for k in kept)
    )
    best = sorted(kept, key=_presence, reverse=True)[: config.max_people]
    warnings = [
        f"keypoints of {n + 1} numbers are of one person, at one place at one time: "
        "taken together."
        for n in twice
    ]
    if len(kept) > len(best):
        dropped = len(kept) - len(best)
        warnings.append(f"{dropped} less visible people dropped (max_people).")
    if brief:
        who = "1 person" if brief == 1 else f"{brief} people"
        warnings.append(
            f"{who} detected for less than {config.min_duration:g} s dropped "
            "(min_duration)."
        )
    if given is None:
        warnings += _returns(best)
    else:
        best = [p for p in kept if any(p is b for b in best)]
    uvc = np.zeros((len(best), len(detections), 25, 3))
    for row, person in zip(uvc, best, strict=True):
        row[list(person)] = np.stack(list(person.values()))
    return Keypoints(uvc[..., :2], uvc[..., 2]), tuple(warnings)


def _collect(detections: Detections, found: list[np.ndarray]) -> list[Track]:
    people: dict[int, dict[int, np.ndarray]] = {}
    for frame, (detected, who) in enumerate(zip(detections, found, strict=True)):
        for points, number in zip(detected, who.tolist(), strict=True):
            people.setdefault(number, {})[frame] = points
    return [people[number] for number in sorted(people)]


def _presence(track: Track) -> float:
    """Returns the sum over frames of confidence times size (px); it ranks people."""
    total = 0.0
    for points in track.values():
        uv = points[points[:, 2] > _MIN_CONFIDENCE, :2]
        if len(uv):
            total += float(points[:, 2].sum() * np.ptp(uv, axis=0).max())
    return total


def _once(people: list[Track], least: int) -> tuple[list[Track], list[int]]:
    """Returns every person once, and for each person with several tracks of `least`
    frames or more the number of additional tracks. Detections of the track with the
    higher presence are kept."""
    order = sorted(range(len(people)), key=lambda i: -_presence(people[i]))
    twice = doubles([people[i] for i in order], _MIN_CONFIDENCE)
    found = {order[i]: order[j] for i, j in twice.items()}
    tracks = [dict(person) for person in people]
    for double, person in found.items():
        tracks[person] = {**tracks[double], **tracks[person]}
    kept: list[Track] = [
        {frame: track[frame] for frame in sorted(track)}
        for i, track in enumerate(tracks)
        if i not in found
    ]
    long = [person for i, person in found.items() if len(people[i]) >= least]
    counts = [long.count(person) for person in dict.fromkeys(long)]
    return kept, counts


def _returns(people: list[Track]) -> list[str]:
    """Returns warnings about people who appear after another has left: both may be one
    person."""
    warnings = []
    ends = [max(person) for person in people]
    for j, person in enumerate(people):
        begin = min(person)
        gone = [i for i, end in enumerate(ends) if end < begin]
        if gone:
            i = max(gone, key=lambda i: ends[i])
            warnings.append(
                f"person {j} may be person {i}: the one begins in frame {begin}, the "
                f"other ends in frame {ends[i]}."
            )
    return warnings
