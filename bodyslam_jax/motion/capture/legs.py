"""Leg length of a captured person, for files without a skeleton."""

from pathlib import Path

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.motion.capture.clips import Clip, leg_length, root_matrices

_LEGS = (0.6, 1.1)
"""Plausible leg lengths, m."""
_PELVIS = np.array([0.0, -0.22, 0.03])
"""SMPL's pelvis joint at rest, m: its position where `trans` is zero."""
_UPRIGHT = 0.7
"""Smallest mean cosine between the world's and the body's up axis of who stands."""


class NoLegs(InputError):
    """The motion is valid, but its leg length cannot be determined."""


def leg_from_joints(path: Path, joints: np.ndarray, num_frames: int) -> float:
    """Leg length (m), the median over the frames.

    **Raises:** `InputError`, naming the file, if they are not those of a person.
    """
    if joints.shape != (num_frames, 24, 3):
        raise InputError(
            f"{path}: joints {joints.shape}; expected {(num_frames, 24, 3)}."
        )
    leg = float(np.median(leg_length(joints)))
    if not _LEGS[0] <= leg <= _LEGS[1]:
        raise InputError(
            f"{path}: legs of {leg:.3g} by its joints; expected {_LEGS[0]} to "
            f"{_LEGS[1]} m."
        )
    return leg


def leg_from_height(path: Path, clip: Clip) -> float:
    """Leg length (m) from the usual height of the pelvis above the floor, which is 0.

    AMASS holds no bone length without a licensed body model. The pelvis stands 0.92 to
    0.94 m high in people with legs of 0.80 m (CMU). AMASS's world has z up, that of
    this project y: up is where the root's y axis points, as people stand.

    **Raises:** `NoLegs` if nobody stands, or not on a floor at 0.
    """
    upward = root_matrices(clip)[:, :, 1].mean(0)
    axis = max((1, 2), key=lambda i: upward[i])
    if upward[axis] < _UPRIGHT:
        raise NoLegs(
            f"{path}: no `joints`, and the body's mean up is "
            f"{np.round(upward, 2).tolist()}; expected a person who stands, y or z up."
        )
    height = float(np.percentile(clip.trans[:, axis] + _PELVIS[axis], 75))
    leg = 0.86 * height
    if not _LEGS[0] <= leg <= _LEGS[1]:
        raise NoLegs(
            f"{path}: no `joints`, and the pelvis is {height:.3g} m up in "
            f"{'xyz'[axis]}; expected {_LEGS[0] / 0.86:.1f} to {_LEGS[1] / 0.86:.1f} m "
            "above a floor at 0."
        )
    return leg
