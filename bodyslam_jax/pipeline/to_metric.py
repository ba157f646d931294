"""The joint estimate as a result in metres, in a world whose y axis is up."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import body as body_
from bodyslam_jax import people
from bodyslam_jax.body.skeleton import FEET
from bodyslam_jax.config import Config
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.gravity import Upright, find_upright
from bodyslam_jax.geometry.lengths import lengthened, padded_length
from bodyslam_jax.geometry.stances import find_stances
from bodyslam_jax.geometry.vertical_edges import Edges, find_vertical
from bodyslam_jax.geometry.whittaker import low_pass, low_pass_rotations
from bodyslam_jax.types import JointEstimate, Result, Sequence, SfmResult

_STANDS = 0.7
"""Probability above which a toe is taken to stand, for gravity and the floor."""


def to_metric(
    sequence: Sequence,
    config: Config,
    body: body_.BodyModel,
    cameras: SfmResult,
    joint: JointEstimate,
    edges: Edges | None = None,
) -> tuple[Result, Upright]:
    """The optimum in a metric world whose y axis is up, and how up was found.

    Standing feet are at y = 0. `edges` are straight edges in the world of `joint`.
    """
    T_WC = joint.cameras.copy()
    T_WC[:, :3, 3] *= joint.scale
    joints = _placed(sequence, config, body, joint, T_WC)[2]
    landmarks = joint.scale * joint.landmarks
    standing = toes_standing(joint.contacts)
    turn, up = level(
        T_WC,
        T_WC @ joint.roots,
        joints[:, :, list(FEET)],
        joint.present,
        landmarks if cameras.kind == "moving" else landmarks[:0],
        sequence.fps,
        people.without_bodies(sequence),
        config.gravity,
        standing,
        edges,
    )
    T_WC = turn @ T_WC
    landmarks = landmarks @ turn[:3, :3].T + turn[:3, 3]
    poses, trans, joints = _placed(sequence, config, body, joint, T_WC)
    if joint.present.any():
        floor = floor_height(
            body, joint.shapes, joints, joint.present, sequence.fps, standing
        )
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
        joints=joints,
        present=joint.present,
    )
    return result, up


_joints = eqx.filter_jit(body_.joints)


def _placed(
    sequence: Sequence,
    config: Config,
    body: body_.BodyModel,
    joint: JointEstimate,
    T_WC: Float[np.ndarray, "t 4 4"],
) -> tuple[
    Float[np.ndarray, "h t 72"],
    Float[np.ndarray, "h t 3"],
    Float[np.ndarray, "h t 24 3"],
]:
    """Poses, `trans` and joints of people in the world of these cameras, low-passed."""
    T_WH = T_WC @ joint.roots
    root = so3.log(np.asarray(T_WH[..., :3, :3]))
    poses = np.concatenate([root, joint.poses.reshape(*root.shape[:2], 69)], axis=-1)
    poses, pelvis = _smoothed(sequence, config, joint.present, poses, T_WH[..., :3, 3])
    shapes = jnp.asarray(joint.shapes)
    trans = pelvis - np.asarray(body_.rest_joints(body, shapes))[:, None, 0]
    frames = len(T_WC)
    longer = lengthened((poses, trans), padded_length(frames), axis=1)
    joints = _joints(body, longer[0], shapes[:, None], longer[1])
    return poses, trans, np.array(joints)[:, :frames]


def floor_height(
    body: body_.BodyModel,
    shapes: Float[np.ndarray, "h 10"],
    joints: Float[np.ndarray, "h t 24 3"],
    present: Bool[np.ndarray, "h t"],
    fps: float,
    standing: Bool[np.ndarray, "h t 2"] | None = None,
) -> float:
    """Height of the floor under standing feet, m; if none stand, under the lowest.

    `joints` are in a world whose y axis is up, m.
    """
    sole = np.median([sole_height(body, shape) for shape in shapes])
    stances = find_stances(joints[:, :, list(FEET)], present, fps, standing)
    heights = np.concatenate([places[:, 1] for places in stances])
    if len(heights):
        return float(np.median(heights) - sole)
    lowest = joints[present][:, list(FEET), 1].min(axis=1)
    return float(np.quantile(lowest, 0.05) - sole)


def toes_standing(
    contacts: Float[np.ndarray, "h t 4"] | None,
) -> Bool[np.ndarray, "h t 2"] | None:
    """Left and right toes that stand, by the contact network's probabilities."""
    return None if contacts is None else contacts[..., ::2] > _STANDS


def sole_height(body: body_.BodyModel, shape: Float[np.ndarray, " 10"]) -> float:
    """Height of the toe joints above the sole of a standing body, m."""
    template = np.asarray(body.template, np.float64)[:, 1]
    skin = template + np.asarray(body.shape_dirs, np.float64)[:, 1] @ shape
    rest = np.asarray(body_.rest_joints(body, jnp.asarray(shape)))
    return float(rest[list(FEET), 1].mean() - skin.min())


def _smoothed(sequence, config, present, poses, pelvis):
    """People's rotations and paths in the world, low-passed at `smoothing_hz`."""
    if config.smoothing_hz is None:
        return poses, pelvis
    how = (sequence.fps, config.smoothing_hz)
    poses, pelvis = poses.copy(), pelvis.copy()
    for h, frames in enumerate(present):
        joints = poses[h].reshape(-1, 24, 3)
        poses[h] = low_pass_rotations(joints, frames, *how).reshape(-1, 72)
        pelvis[h] = low_pass(pelvis[h], frames, *how)
    return poses, pelvis


def level(
    T_WC: Float[np.ndarray, "t 4 4"],
    T_WH: Float[np.ndarray, "h t 4 4"],
    feet: Float[np.ndarray, "h t 2 3"],
    present: Bool[np.ndarray, "h t"],
    landmarks: Float[np.ndarray, "l 3"],
    fps: float,
    fitted: Bool[np.ndarray, " h"],
    gravity: tuple[float, ...] = (),
    standing: Bool[np.ndarray, "h t 2"] | None = None,
    edges: Edges | None = None,
) -> tuple[Float[np.ndarray, "4 4"], Upright]:
    """The rigid motion to a world whose y axis is up, and the cues it is based on.

    Cues (see `find_upright`) are evaluated in a roughly upright world, whose y axis is
    opposite to `gravity` (in the first camera's axes) if that is measured, else the
    mean direction of people's trunks, or, without people, the first camera's -y.
    """
    up = -T_WC[0, :3, 1]
    if gravity:
        up = -T_WC[0, :3, :3] @ np.asarray(gravity, float)
    elif present.any():
        up = T_WH[present][:, :3, 1].sum(axis=0)
    rough = upright(T_WC, up / np.linalg.norm(up))
    at = lambda points: points @ rough[:3, :3].T + rough[:3, 3]
    found = find_upright(
        T_WH[..., :3, 1] @ rough[:3, :3].T,
        at(feet),
        present,
        at(T_WC[:, :3, 3]),
        at(landmarks),
        fps,
        fitted,
        np.array([0.0, 1.0, 0.0]) if gravity else None,
        standing,
        None if edges is None else find_vertical(edges.rotated(rough[:3, :3])),
    )
    return upright(rough @ T_WC, found.up) @ rough, found


def upright(
    T_WC: Float[np.ndarray, "t 4 4"], up: Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "4 4"]:
    """The rigid motion to a world with y along the unit vector `up` and z ahead of the
    first camera, which is its origin."""
    y = up
    ahead = T_WC[0, :3, 2] - y * (y @ T_WC[0, :3, 2])
    if np.linalg.norm(ahead) < 1e-3:  # The camera looks straight up or down.
        ahead = T_WC[0, :3, 1] - y * (y @ T_WC[0, :3, 1])
    z = ahead / np.linalg.norm(ahead)
    turn = np.eye(4)
    turn[:3, :3] = np.stack([np.cross(y, z), y, z])
    turn[:3, 3] = -turn[:3, :3] @ T_WC[0, :3, 3]
    return turn
