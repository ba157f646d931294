"""Plays recordings of people who do something else than walk, as they were recorded.

The ten recordings of `assets/other.npz`, one for each named sequence, are of people of
whom neither the posture prior nor the lifting network that ship learnt. World: y up,
floor at y = 0, metres.
"""

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.motion import Clip
from bodyslam_jax.motion.capture.clips import hip_centre, leg_length
from bodyslam_jax.simulation.gait_synthesis import Soles, Walk
from bodyslam_jax.simulation.posing import Person

OTHER = "other"
"""Value of `Simulation.motion` that selects these recordings."""
RECORDINGS = {
    "E1": ("14_32", "sits down on a stepstool"),
    "E2": ("14_traffic", "directs traffic, waves, points"),
    "E3": ("02_06", "bends over, lifts"),
    "M1": ("49_18", "balances on one leg"),
    "M2": ("06_12", "dribbles a basketball"),
    "M3": ("14_33", "climbs a ladder"),
    "M4": ("02_07", "fights with a sword"),
    "D1": ("14_08", "jumps up to grab"),
    "D2": ("02_04", "jumps, balances"),
    "D3": ("14_21", "climbs three steps"),
}
"""CMU trial of each sequence, whose subject is before the underscore, and what it
shows."""
_STANDING_SHARE = 0.05
"""Quantile of the height of the lowest sole that is the floor: everybody stands on it
for longer, and noise is below it."""

_DRIFT_M = 0.1
"""Range of the height of the lowest sole up to which it is an error of the recording,
such as feet that sink where somebody crouches whose leg has other proportions."""


def play(
    person: Person, clip: Clip, num_frames: int, middle: Float[np.ndarray, "2"] | None,
    towards: float = 0.0,
) -> Walk:  # fmt: skip
    """Returns a recording in the size of another person, whose soles stand at height 0.

    It is played forwards and backwards until it is long enough.

    Args:
        middle: place (x, z), m, to which the mean of the pelvis' path is moved; `None`
            leaves it.
        towards: direction, rad from z to x, of the line along which the pelvis moves
            most; used with `middle`.
    """
    there = np.arange(len(clip.poses))
    again = np.resize(np.concatenate([there, there[-2:0:-1]]), num_frames)
    poses = clip.poses[again].astype(float)
    # By the hips: captures and models define the pelvis joint at different heights.
    hips = hip_centre(clip)[again] * float(leg_length(person.rest) / clip.leg_length)
    above = person.rest[0] - (person.rest[1] + person.rest[2]) / 2
    pelvis = hips + so3.exp(poses[:, 0]) @ above
    soles = Soles(person)(poses, pelvis)[..., 1].min(axis=1)
    floor = np.full(num_frames, np.quantile(soles, _STANDING_SHARE))
    if np.ptp(soles) < _DRIFT_M:  # nobody is in the air, or on anything
        floor = gaussian_filter1d(soles, 5.0)
    pelvis = pelvis - np.stack([0 * floor, floor, 0 * floor], axis=1)
    if middle is None:
        return Walk(poses, pelvis)
    pelvis[:, [0, 2]] -= pelvis[:, [0, 2]].mean(axis=0)
    _, _, axes = np.linalg.svd(pelvis[:, [0, 2]], full_matrices=False)
    turn = np.array([0.0, towards - np.arctan2(*axes[0]), 0.0])
    poses[:, 0] = so3.compose(np.tile(turn, (num_frames, 1)), poses[:, 0])
    pelvis = pelvis @ so3.exp(turn).T + [middle[0], 0.0, middle[1]]
    return Walk(poses, pelvis)
