"""Estimates bodies in the camera frame, from a regressor's bodies or from keypoints."""

import dataclasses

import numpy as np
from jaxtyping import Bool

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import PeopleFit
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.people.clean_regressed import prepare_bodies
from bodyslam_jax.people.fit import fit_bodies
from bodyslam_jax.types import Bodies, Sequence


def estimate_bodies(
    sequence: Sequence, body: BodyModel, settings: PeopleFit = PeopleFit()
) -> Bodies:
    """Returns a regressor's bodies, cleaned, and bodies fitted to keypoints for people
    without any; no bodies if there are neither."""
    camera, fps, keypoints = sequence.intrinsics, sequence.fps, sequence.keypoints
    if sequence.bodies is None:
        if keypoints is None:
            return nobody(sequence.num_frames)
        return fit_bodies(keypoints, camera, body, fps, settings)
    found = prepare_bodies(sequence.bodies, keypoints, camera, body, fps, settings)
    (others,) = np.nonzero(without_bodies(sequence))
    if keypoints is None or not len(others):
        return found
    remaining = dataclasses.replace(
        keypoints,
        uv=keypoints.uv[others],
        confidence=keypoints.confidence[others],
    )
    fitted = fit_bodies(remaining, camera, body, fps, settings)
    for name in ("present", "poses", "shapes", "trans"):
        getattr(found, name)[others] = getattr(fitted, name)
    return found


def select_people(sequence: Sequence, people: tuple[int, ...]) -> Sequence:
    """Returns the sequence with these people only, in this order; with all of them for
    `()`.

    **Raises:** `InputError` if the sequence lacks one of them.
    """
    if not people:
        return sequence
    keypoints, bodies = sequence.keypoints, sequence.bodies
    count = 0
    if keypoints is not None:
        count = len(keypoints.uv)
    elif bodies is not None:
        count = len(bodies.present)
    beyond = [h for h in people if h >= count]
    if beyond:
        found = f"people 0 to {count - 1}" if count else "nobody"
        raise InputError(f"person: found {beyond[0]}, but {sequence.name} has {found}.")
    index = list(dict.fromkeys(people))
    if keypoints is not None:
        keypoints = dataclasses.replace(
            keypoints,
            uv=keypoints.uv[index],
            confidence=keypoints.confidence[index],
        )
    if bodies is not None:
        bodies = dataclasses.replace(
            bodies,
            present=bodies.present[index],
            poses=bodies.poses[index],
            shapes=bodies.shapes[index],
            trans=bodies.trans[index],
        )
    text = (
        f"{len(index)} of {count} people are estimated: {', '.join(map(str, index))}."
    )
    return dataclasses.replace(
        sequence,
        keypoints=keypoints,
        bodies=bodies,
        warnings=(*sequence.warnings, text)
        if len(index) < count
        else sequence.warnings,
    )


def without_bodies(sequence: Sequence) -> Bool[np.ndarray, " h"]:
    """Returns the people without regressed bodies, whose bodies are fitted to
    keypoints."""
    if sequence.bodies is not None:
        return np.logical_not(sequence.bodies.present.any(axis=1))
    count = 0 if sequence.keypoints is None else len(sequence.keypoints.uv)
    return np.ones(count, bool)


def nobody(num_frames: int) -> Bodies:
    """Returns bodies (0 people) of a video without people, or whose people are
    ignored."""
    t = num_frames
    return Bodies(
        np.zeros((0, t), bool),
        np.zeros((0, t, 72)),
        np.zeros((0, t, 10)),
        np.zeros((0, t, 3)),
    )
