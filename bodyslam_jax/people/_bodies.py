"""Bodies in the camera frame, from whatever a sequence tells of its people."""

import numpy as np
from jaxtyping import Bool

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import PeopleFit
from bodyslam_jax.people._fit import fit_bodies
from bodyslam_jax.people._prepare import prepare_bodies
from bodyslam_jax.people._sides import unexchanged
from bodyslam_jax.sequence import Bodies, Keypoints, Sequence


def estimate_bodies(
    sequence: Sequence, body: BodyModel, settings: PeopleFit = PeopleFit()
) -> Bodies:
    """A regressor's bodies, cleaned; of people without any, bodies fitted to their
    keypoints; else nobody."""
    camera, fps, keypoints = sequence.intrinsics, sequence.fps, sequence.keypoints
    if keypoints is not None:
        keypoints, _ = unexchanged(keypoints, fps)
    if sequence.bodies is None:
        if keypoints is None:
            return nobody(sequence.num_frames)
        return fit_bodies(keypoints, camera, body, fps, settings)
    found = prepare_bodies(sequence.bodies, keypoints, camera, body, fps, settings)
    (others,) = np.nonzero(without_bodies(sequence))
    if keypoints is None or not len(others):
        return found
    seen = Keypoints(keypoints.uv[others], keypoints.confidence[others])
    fitted = fit_bodies(seen, camera, body, fps, settings)
    for name in ("present", "poses", "shapes", "trans"):
        getattr(found, name)[others] = getattr(fitted, name)
    return found


def without_bodies(sequence: Sequence) -> Bool[np.ndarray, " h"]:
    """People of whom no regressor said anything, so that their bodies are fitted."""
    if sequence.bodies is not None:
        return np.logical_not(sequence.bodies.present.any(axis=1))
    count = 0 if sequence.keypoints is None else len(sequence.keypoints.uv)
    return np.ones(count, bool)


def nobody(num_frames: int) -> Bodies:
    """The bodies of a video that shows none, or whose people are left out."""
    t = num_frames
    return Bodies(
        np.zeros((0, t), bool),
        np.zeros((0, t, 72)),
        np.zeros((0, t, 10)),
        np.zeros((0, t, 3)),
    )
