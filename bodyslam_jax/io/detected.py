"""Detections in the frames of a video -> people of a sequence."""

import dataclasses

import numpy as np

from bodyslam_jax.config import Association
from bodyslam_jax.io.keypoints.associate import associate
from bodyslam_jax.io.keypoints.reader import Detections
from bodyslam_jax.io.match_people import pair
from bodyslam_jax.types import Bodies, DetectedPeople, Keypoints, Sequence


def with_detections(
    sequence: Sequence,
    detections: Detections,
    config: Association = Association(),
    *,
    person: list[np.ndarray] | None = None,
    detected: DetectedPeople | None = None,
    definition: str = "unknown",
) -> Sequence:
    """Returns the sequence with people made of the detections in each of its frames.

    If bodies are given, only the people with a body are estimated. Everybody else who
    was detected is only kept out of the map.

    Args:
        person: for each frame the number of the person that each detection is of, if
            the detector tracks people.
        detected: everybody who is kept out of the map; by default all `detections`.
        definition: the detector's, a name in `body.KEYPOINT_DEFINITIONS`.
    """
    detected = detected or detected_people(detections)
    sequence = dataclasses.replace(sequence, detected=detected)
    if not any(len(found) for found in detections):
        text = "nobody was found in the images"
        if sequence.bodies is None:
            text += ": cameras and map only, and these without a unit"
        return _warned(sequence, (f"{text}.",))
    people, warnings = associate(detections, config, sequence.fps, person)
    people = dataclasses.replace(people, definition=definition)
    bodies = sequence.bodies
    if bodies is not None:
        given = len(bodies.present)
        people, bodies = pair(people, bodies, sequence.intrinsics)
        people, bodies, without = _with_body(people, bodies)
        if without:
            warnings += (
                f"{without} more people were found than the {given} whose bodies are "
                "given: not estimated.",
            )
    sequence = dataclasses.replace(sequence, keypoints=people, bodies=bodies)
    return _warned(sequence, warnings)


def detected_people(detections: Detections) -> DetectedPeople:
    """Returns the detections of all frames in one table."""
    counts = [len(found) for found in detections]
    keypoints = np.concatenate([np.zeros((0, 25, 3)), *detections])
    return DetectedPeople(np.repeat(np.arange(len(counts)), counts), keypoints)


def _warned(sequence: Sequence, warnings: tuple[str, ...]) -> Sequence:
    return dataclasses.replace(sequence, warnings=(*sequence.warnings, *warnings))


def _with_body(people: Keypoints, bodies: Bodies) -> tuple[Keypoints, Bodies, int]:
    """Returns the people who have a body in any frame, and how many have none."""
    kept = bodies.present.any(axis=1)
    if not kept.any():
        return people, bodies, 0
    arrays = {n: getattr(bodies, n) for n in ("present", "poses", "shapes", "trans")}
    bodies = dataclasses.replace(bodies, **{n: a[kept] for n, a in arrays.items()})
    uv, confidence = people.uv[kept], people.confidence[kept]
    people = dataclasses.replace(people, uv=uv, confidence=confidence)
    return people, bodies, int((~kept).sum())
