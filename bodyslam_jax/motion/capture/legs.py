"""Determines the leg length of a captured person in files without a skeleton."""

from pathlib import Path

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.motion.capture.clips import Clip, leg_length, root_matrices

_LEG_RANGE_M = (0.6, 1.1)
"""Range of plausible leg lengths, m."""
_REST_PELVIS_M = np.array([0.0, -0.22, 0.03])
"""Position of SMPL's pelvis joint for `trans` of zero, m."""
_MIN_UP_COSINE = 0.7
"""Least mean cosine between the up axes of world and body for a standing person."""


class NoLegs(InputError):
    """The motion is valid, but its leg length cannot be determined."""


def leg_from_joints(path: Path, joints: np.ndarray, num_frames: int) -> float:
    """Returns the leg length (m), as the median over frames.

    **Raises:** `InputError`, naming the file, if shape or leg length are not those of a
    person.
    """
    if joints.shape != (num_frames, 24, 3):
        raise InputError(
            f"{path}: joints {joints.shape}; expected {(num_frames, 24, 3)}."
        )
    leg = float(np.median(leg_length(joints)))
    if not _LEG_RANGE_M[0] <= leg <= _LEG_RANGE_M[1]:
        raise InputError(
            f"{path}: legs of {leg:.3g} by its joints; expected {_LEG_RANGE_M[0]} to "
            f"{_LEG_RANGE_M[1]} m."
        )
    return leg


def leg_from_height(path: Path, clip: Clip) -> float:
    """Estimates the leg length (m) from the typical height of the pelvis above the
    floor at 0.

    AMASS contains no bone lengths without a licensed body model. The pelvis is 0.92 to
    0.94 m high in people with legs of 0.80 m (CMU). The world of AMASS has z up, that
    of this project y: up is the axis to which the root's y axis of standing people
    points.

    **Raises:** `NoLegs` if nobody stands, or not on a floor at 0.
    """
    upward = root_matrices(clip)[:, :, 1].mean(0)
    axis = max((1, 2), key=lambda i: upward[i])
    if upward[axis] < _MIN_UP_COSINE:
        raise NoLegs(
            f"{path}: no `joints`, and the body's mean up is "
            f"{np.round(upward, 2).tolist()}; expected a person who stands, y or z up."
        )
    height = float(np.percentile(clip.trans[:, axis] + _REST_PELVIS_M[axis], 75))
    leg = 0.86 * height
    if not _LEG_RANGE_M[0] <= leg <= _LEG_RANGE_M[1]:
        raise NoLegs(
            f"{path}: no `joints`, and the pelvis is {height:.3g} m up in "
            f"{'xyz'[axis]}; expected {_LEG_RANGE_M[0] / 0.86:.1f} to "
            f"{_LEG_RANGE_M[1] / 0.86:.1f} m above a floor at 0."
        )
    return leg
