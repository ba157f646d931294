"""Converts between bodies of files (SMPL's trans) and of the graph (pelvis pose)."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.body import BodyModel, rest_joints
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.types import Bodies

DEPTH_JITTER_M = 0.005
"""Standard deviation of the second difference of a pelvis' depth at 30 fps."""
POSITION_JITTER_M = 0.015
"""The same across the line of sight; includes a shaking camera."""


@dataclasses.dataclass(frozen=True)
class PersonState:
    """Pelvis pose in the camera frame, posture, and one shape each, of `h` people in
    `t` frames."""

    present: Bool[np.ndarray, "h t"]
    T_CH: Float[np.ndarray, "h t 4 4"]
    """Pelvis pose; the translation is the pelvis joint in C, m; identity where
    absent."""
    body_pose: Float[np.ndarray, "h t 23 3"]
    """Body pose θ, axis-angle, rad."""
    shape: Float[np.ndarray, "h 10"]
    """Shape β, the median over the frames where present."""


def roots_from_bodies(bodies: Bodies, body: BodyModel) -> PersonState:
    """Converts to the graph's convention: `r_CH = J_0(β) + trans`, with one β per
    person.

    The pelvis position is computed with the frame's own β, which `trans` refers to.
    """
    present = np.asarray(bodies.present, bool)
    pelvis = _pelvis(body, bodies.shapes) + bodies.trans
    T_CH = np.tile(np.eye(4), (*present.shape, 1, 1))
    T_CH[..., :3, :3] = so3.exp(bodies.poses[..., :3])
    T_CH[..., :3, 3] = pelvis
    T_CH[~present] = np.eye(4)
    body_pose = bodies.poses[..., 3:].reshape(*present.shape, 23, 3).astype(float)
    body_pose = np.where(present[..., None, None], body_pose, 0.0)
    shape = np.zeros((len(present), 10))
    for h, frames in enumerate(present):
        if frames.any():
            shape[h] = np.median(bodies.shapes[h, frames].astype(float), axis=0)
    return PersonState(present, T_CH, body_pose, shape)


def bodies_from_roots(roots: PersonState, body: BodyModel) -> Bodies:
    """Inverts `roots_from_bodies`, for bodies with constant β.

    The result is marked as estimated (`shapes_regressed=False`).
    """
    frames = roots.present.shape[1]
    orientation = so3.log(roots.T_CH[..., :3, :3])
    pose = roots.body_pose.reshape(*roots.present.shape, 69)
    shapes = np.repeat(roots.shape[:, None], frames, axis=1)
    trans = roots.T_CH[..., :3, 3] - _pelvis(body, shapes)
    return Bodies(
        roots.present,
        np.concatenate([orientation, pose], axis=-1),
        shapes,
        np.where(roots.present[..., None], trans, 0.0),
        shapes_regressed=False,
    )


def _pelvis(body: BodyModel, shapes: np.ndarray) -> np.ndarray:
    dtype = body.joint_template.dtype
    return np.asarray(rest_joints(body, jnp.asarray(shapes, dtype))[..., 0, :], float)
