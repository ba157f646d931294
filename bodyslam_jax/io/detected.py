"""Detections in the frames of a video -> people of a sequence.

Keypoints and bodies of one person are matched to the same index (`pair`).
"""

import dataclasses

import numpy as np
from scipy.optimize import linear_sum_assignment

from bodyslam_jax.body.skeleton import BODY25
from bodyslam_jax.config import Association
from bodyslam_jax.io.camera.calibration import project_points
from bodyslam_jax.io.keypoints.associate import associate
from bodyslam_jax.io.keypoints.reader import Detections
from bodyslam_jax.types import Bodies, DetectedPeople, Intrinsics, Keypoints, Sequence

_MID_HIP = BODY25["mid_hip"]
_UNMATCHED_COST = 1e6
"""Cost of two people who are never in the same frame."""


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


def pair(
    keypoints: Keypoints, bodies: Bodies, intrinsics: Intrinsics
) -> tuple[Keypoints, Bodies]:
    """Puts keypoints and bodies of the same person at the same index.

    Optimal assignment by the distance in the image of the projected pelvis from the
    middle of the hips, relative to the person's height. People with only one of the two
    are kept, with confidence 0 or not present.
    """
    num_k, num_b = len(keypoints.uv), len(bodies.present)
    cost = np.full((num_k, num_b), _UNMATCHED_COST)
    for j in range(num_b):
        # Of a body of average size: what people have in common does not matter here.
        pelvis = bodies.trans[j] + np.array([0.0, -0.2, 0.0])
        pixel = project_points(intrinsics, pelvis)
        for i in range(num_k):
            both = bodies.present[j] & (keypoints.confidence[i, :, _MID_HIP] > 0)
            if both.any():
                away = np.linalg.norm(
                    keypoints.uv[i, both, _MID_HIP] - pixel[both], axis=-1
                )
                # Missing keypoints lie at 0 and do not count.
                present = keypoints.confidence[i, both] > 0
                v = np.where(present, keypoints.uv[i, both][..., 1], np.nan)
                size = (np.nanmax(v, axis=-1) - np.nanmin(v, axis=-1)).clip(20)
                cost[i, j] = np.median(away / size) - 1e-3 * np.sqrt(both.sum())
    rows, columns = linear_sum_assignment(cost)
    matched = {
        int(j): int(i) for i, j in zip(rows, columns, strict=True) if cost[i, j] < 1
    }
    target = np.empty(num_b, dtype=np.int64)
    extra = num_k
    for j in range(num_b):
        if j in matched:
            target[j] = matched[j]
        else:
            target[j], extra = extra, extra + 1

    def spread(array: np.ndarray, index: np.ndarray) -> np.ndarray:
        out = np.zeros((extra, *array.shape[1:]), dtype=array.dtype)
        out[index] = array
        return out

    return (
        dataclasses.replace(
            keypoints,
            uv=spread(keypoints.uv, np.arange(num_k)),
            confidence=spread(keypoints.confidence, np.arange(num_k)),
        ),
        dataclasses.replace(
            bodies,
            present=spread(bodies.present, target),
            poses=spread(bodies.poses, target),
            shapes=spread(bodies.shapes, target),
            trans=spread(bodies.trans, target),
        ),
    )
