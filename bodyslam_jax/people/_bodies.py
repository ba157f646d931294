"""Bodies in the camera frame, from whatever a sequence tells of its people."""

import numpy as np

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import PeopleFit
from bodyslam_jax.people._fit import fit_bodies
from bodyslam_jax.people._prepare import prepare_bodies
from bodyslam_jax.sequence import Bodies, Sequence


def estimate_bodies(
    sequence: Sequence, body: BodyModel, settings: PeopleFit = PeopleFit()
) -> Bodies:
    """A regressor's bodies, cleaned; else bodies fitted to keypoints; else nobody."""
    camera, fps = sequence.intrinsics, sequence.fps
    if sequence.bodies is not None:
        return prepare_bodies(
            sequence.bodies, sequence.keypoints, camera, body, fps, settings
        )
    if sequence.keypoints is not None:
        return fit_bodies(sequence.keypoints, camera, body, fps, settings)
    return nobody(sequence.num_frames)


def nobody(num_frames: int) -> Bodies:
    """The bodies of a video that shows none, or whose people are left out."""
    t = num_frames
    return Bodies(
        np.zeros((0, t), bool),
        np.zeros((0, t, 72)),
        np.zeros((0, t, 10)),
        np.zeros((0, t, 3)),
    )
