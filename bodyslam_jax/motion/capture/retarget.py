"""Retargets motion capture to the body model: a fitted shape and a scaled path.

A network is trained on the skeleton that it is used with. The root's path must match
the legs; otherwise feet slide and the true displacements are wrong.
"""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from bodyslam_jax.body import PARENTS, BodyModel, rest_joints
from bodyslam_jax.motion.capture.clips import (
    Clip,
    hip_centre,
    leg_length,
    root_matrices,
)

_FITTED_JOINTS = (1, 2, 4, 5, 7, 8, 16, 17, 18, 19, 20, 21)
"""Bones, by their lower joint, whose lengths determine the shape."""
_BONE_SIGMA_M = np.where(np.isin(_FITTED_JOINTS, (4, 5, 7, 8)), 0.01, 0.03)
"""Standard deviations of the lengths of these bones, m: small for legs; captures place
hips and shoulders at the markers."""


@dataclasses.dataclass(frozen=True)
class Trial:
    """A clip retargeted to the body model."""

    clip: Clip
    shape: Float[np.ndarray, " 10"]
    """SMPL β of the subject."""
    trans: Float[np.ndarray, "t 3"]
    """Pelvis joint of the body, m: the path of the hips is scaled by leg length."""


def fit_shape(
    body: BodyModel, offsets: Float[np.ndarray, "24 3"]
) -> Float[np.ndarray, " 10"]:
    """Returns SMPL β of the body whose limbs are as long as a subject's bones (m).

    It minimises squared differences of lengths (sigma 1 cm for legs, 3 cm for others)
    with a standard normal prior on β. Lengths do not depend on the rest pose, in which
    captures and models differ.
    """
    zero = np.zeros(10)
    one = np.concatenate([zero[None], np.eye(10)])
    rest = np.asarray(rest_joints(body, jnp.asarray(one, body.template.dtype)), float)
    base, directions = rest[0], rest[1:] - rest[0]
    parents = np.array(PARENTS)[list(_FITTED_JOINTS)]
    wanted = np.linalg.norm(offsets, axis=-1)[list(_FITTED_JOINTS)]

    def residual(shape):
        joints = base + np.tensordot(shape, directions, 1)
        bones = joints[list(_FITTED_JOINTS)] - joints[parents]
        lengths = np.linalg.norm(bones, axis=-1)
        return np.concatenate([(lengths - wanted) / _BONE_SIGMA_M, shape])

    return least_squares(residual, zero).x


def place(body: BodyModel, clips: Sequence[Clip]) -> tuple[Trial, ...]:
    """Retargets clips to the body model, each subject with its own fitted shape.

    A subject with unknown bones gets the mean shape.
    """
    shapes: dict[bytes, np.ndarray] = {}
    trials = []
    for clip in clips:
        key = b"" if clip.offsets is None else clip.offsets.tobytes()
        if key not in shapes:
            offsets = clip.offsets
            shapes[key] = np.zeros(10) if offsets is None else fit_shape(body, offsets)
        shape = shapes[key]
        rest = np.asarray(rest_joints(body, jnp.asarray(shape, body.template.dtype)))
        ratio = float(leg_length(rest)) / clip.leg_length
        below = (rest[1] + rest[2]) / 2 - rest[0]
        trans = ratio * hip_centre(clip) - root_matrices(clip) @ below
        trials.append(Trial(clip, shape, trans))
    return tuple(trials)
