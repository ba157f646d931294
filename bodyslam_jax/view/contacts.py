"""Contacts of feet with the ground, for pictures."""

import numpy as np
from jaxtyping import Bool

from bodyslam_jax.body.skeleton import FEET
from bodyslam_jax.geometry.runs import runs
from bodyslam_jax.geometry.stances import standing_feet
from bodyslam_jax.types import Result

_UP = np.array([0.0, 1.0, 0.0])


def feet_on_the_ground(result: Result) -> Bool[np.ndarray, "h t 2"]:
    """Returns, for each frame, whether each person's left and right foot is in contact
    with the ground: the lower foot, while it is slow (`geometry.stances`)."""
    stands = np.zeros((*result.present.shape, 2), bool)
    for h, present in enumerate(result.present):
        for run in runs(present):
            feet = result.joints[h, run][:, list(FEET)]
            slow, lower = standing_feet(feet, _UP, result.fps)
            stands[h, np.arange(run.start, run.stop), lower] = slow
    return stands
