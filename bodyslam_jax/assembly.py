"""The optimum as a result in metres, in an upright world."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import body as body_
from bodyslam_jax.compilation import jit_once
from bodyslam_jax.config import Config
from bodyslam_jax.outcome import Cameras, Joint
from bodyslam_jax.result import Result
from bodyslam_jax.rotation import log
from bodyslam_jax.sequence import Sequence
from bodyslam_jax.smoothing import low_pass, low_pass_rotations
from bodyslam_jax.summary import summarise

FEET = (10, 11)
"""SMPL's foot joints."""


def assemble(
    sequence: Sequence,
    config: Config,
    body: body_.BodyModel,
    cameras: Cameras,
    joint: Joint,
    seconds: dict[str, float],
) -> Result:
    """The optimum in a metric world whose y axis is the people's up."""
    T_WC = joint.cameras.copy()
    T_WC[:, :3, 3] *= joint.scale
    turn = upright(T_WC, T_WC @ joint.roots, joint.present)
    T_WC = turn @ T_WC
    T_WH = T_WC @ joint.roots
    landmarks = joint.scale * joint.landmarks @ turn[:3, :3].T + turn[:3, 3]
    root = np.asarray(log(jnp.asarray(T_WH[..., :3, :3])))
    poses = np.concatenate([root, joint.poses.reshape(*root.shape[:2], 69)], axis=-1)
    poses, pelvis = _smoothed(sequence, config, joint.present, poses, T_WH[..., :3, 3])
    rest = np.asarray(body_.rest_joints(body, jnp.asarray(joint.shapes)))
    trans = pelvis - rest[:, None, 0]
    shapes = jnp.asarray(joint.shapes)[:, None]
    joints = np.array(_joints(body, jnp.asarray(poses), shapes, jnp.asarray(trans)))
    if joint.present.any():
        # The floor is where feet are lowest, but for a few frames.
        floor = np.quantile(joints[joint.present][:, FEET, 1].min(axis=1), 0.05)
        for points in (T_WC[:, :3, 3], trans, joints, landmarks):
            points[..., 1] -= floor
    result = Result(
        timestamps=sequence.timestamps,
        T_WC=T_WC,
        scale=joint.scale,
        intrinsics=joint.intrinsics,
        landmarks=landmarks if cameras.kind == "moving" else np.zeros((0, 3)),
        poses=poses,
        trans=trans,
        betas=joint.shapes,
        joints=np.asarray(joints),
        present=joint.present,
    )
    summary = summarise(sequence, config, body, cameras, joint, result, seconds)
    return dataclasses.replace(result, summary=summary)


_joints = jit_once(body_.joints)


def _smoothed(sequence, config, present, poses, pelvis):
    """People's rotations and paths in the world without what is too fast for them."""
    if config.smoothing_hz is None:
        return poses, pelvis
    how = (sequence.fps, config.smoothing_hz)
    poses, pelvis = poses.copy(), pelvis.copy()
    for h, there in enumerate(present):
        joints = poses[h].reshape(-1, 24, 3)
        poses[h] = low_pass_rotations(joints, there, *how).reshape(-1, 72)
        pelvis[h] = low_pass(pelvis[h], there, *how)
    return poses, pelvis


def upright(
    T_WC: Float[np.ndarray, "t 4 4"],
    T_WH: Float[np.ndarray, "h t 4 4"],
    present: Bool[np.ndarray, "h t"],
) -> Float[np.ndarray, "4 4"]:
    """The rigid motion to a world with y up, z ahead of the first camera, which is its
    origin.

    Nothing measures gravity: up is where people's trunks point on average, or, without
    people, where the first camera's top does.
    """
    up = T_WH[present][:, :3, 1].sum(axis=0) if present.any() else -T_WC[0, :3, 1]
    y = up / np.linalg.norm(up)
    ahead = T_WC[0, :3, 2] - y * (y @ T_WC[0, :3, 2])
    if np.linalg.norm(ahead) < 1e-3:  # The camera looks straight up or down.
        ahead = T_WC[0, :3, 1] - y * (y @ T_WC[0, :3, 1])
    z = ahead / np.linalg.norm(ahead)
    turn = np.eye(4)
    turn[:3, :3] = np.stack([np.cross(y, z), y, z])
    turn[:3, 3] = -turn[:3, :3] @ T_WC[0, :3, 3]
    return turn
