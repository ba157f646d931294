"""Converts the joint estimate to metres, in a world whose y axis is up."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import body as body_
from bodyslam_jax import people
from bodyslam_jax.body.skeleton import FEET, NECK, PELVIS
from bodyslam_jax.config import Config
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.lengths import lengthened, padded_length
from bodyslam_jax.geometry.whittaker import low_pass, low_pass_rotations
from bodyslam_jax.ground.gravity import GravityCues, Upright, level, measured_up
from bodyslam_jax.ground.stances import find_stances, toes_standing
from bodyslam_jax.ground.vertical_edges import Edges
from bodyslam_jax.pipeline.seated_legs import nearer_floor, with_seated_legs
from bodyslam_jax.types import JointEstimate, Result, Sequence, SfmResult


def to_metric(
    sequence: Sequence,
    config: Config,
    body: body_.BodyModel,
    cameras: SfmResult,
    joint: JointEstimate,
    edges: Edges | None = None,
) -> tuple[Result, Upright]:
    """Returns the result in a metric world whose y axis is up, and the estimate of up.

    Feet that stand on the ground are at y = 0. Legs that are not in view sit where that
    is more probable (`seated_legs`), unless a regressor gave them. `edges` are straight
    edges in the world of `joint`.
    """
    T_WC = joint.cameras.copy()
    T_WC[:, :3, 3] *= joint.scale
    joints = _placed(sequence, config, body, joint, T_WC)[2]
    shown = np.zeros((*joint.present.shape, 25), bool)
    if joint.present.any():
        shown = people.shown_keypoints(sequence, body)
    legs = people.legs_shown(shown, joint.present, sequence.fps)
    above = joint.above_ground
    # Rungs and steps under feet are no plane: feet are where the ground is below them.
    above = np.zeros((*joint.present.shape, 3)) if above is None else above
    landmarks = joint.scale * joint.landmarks
    standing = toes_standing(joint.contacts)
    cues = GravityCues(
        trunks=_trunks(joint, legs, T_WC, joints),
        feet=joints[:, :, list(FEET)] - above[:, :, None],
        present=joint.present,
        eyes=T_WC[:, :3, 3],
        landmarks=landmarks if cameras.kind == "moving" else landmarks[:0],
        fps=sequence.fps,
        fitted=people.without_bodies(sequence),
        measured_up=measured_up(T_WC, config.gravity),
        standing=standing,
        on_floor=joint.on_floor,
    )
    turn, up = level(T_WC, cues, edges)
    T_WC = turn @ T_WC
    landmarks = landmarks @ turn[:3, :3].T + turn[:3, 3]
    poses, trans, joints = _placed(sequence, config, body, joint, T_WC)
    if joint.present.any():
        # By climbers only if nobody stands on the ground.
        climbs = np.any(above != 0, axis=(1, 2))
        on_ground = joint.present & ~climbs[:, None]
        told = on_ground if on_ground.any() else joint.present
        of, rest = (body, joint.shapes), (sequence.fps, standing)
        lower = (above @ turn[:3, :3].T)[:, :, None]
        floor = standing_height(*of, joints - lower, told & legs, *rest)
        fitted = joint.present & people.without_bodies(sequence)[:, None]
        seats = with_seated_legs(
            poses, joints, shown, fitted, sequence.fps, T_WC[:, :3, 3]
        )
        if not np.array_equal(seats, poses):
            changed = (seats != poses).any(axis=2)
            sits = _posed(body, seats, joint.shapes, trans)
            nearer = nearer_floor(joints, sits, changed, floor)
            poses = np.where(nearer[..., None], seats, poses)
            joints = np.where(nearer[..., None, None], sits, joints)
        floor = floor_height(*of, joints - lower, told, *rest)
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


def _trunks(
    joint: JointEstimate,
    legs: Bool[np.ndarray, "h t"],
    T_WC: Float[np.ndarray, "t 4 4"],
    joints: Float[np.ndarray, "h t 24 3"],
) -> Float[np.ndarray, "h t 3"]:
    """Returns the directions in which trunks point: the y axes of the roots, and from
    pelvis to neck of people whose legs are not shown in most of their frames, as
    nothing else holds the pelvis' pitch then."""
    trunks = (T_WC @ joint.roots)[..., :3, 1]
    mostly = 2 * (legs & joint.present).sum(axis=1) >= joint.present.sum(axis=1)
    line = joints[:, :, NECK] - joints[:, :, PELVIS]
    line = line / np.maximum(np.linalg.norm(line, axis=-1, keepdims=True), 1e-9)
    return np.where(mostly[:, None, None], trunks, line)


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
    """Returns poses (rad), `trans` and joints (m) of people in the world of the cameras
    `T_WC`; of regressed bodies they are low-passed."""
    T_WH = T_WC @ joint.roots
    root = so3.log(np.asarray(T_WH[..., :3, :3]))
    poses = np.concatenate([root, joint.poses.reshape(*root.shape[:2], 69)], axis=-1)
    poses, pelvis = _smoothed(sequence, config, joint.present, poses, T_WH[..., :3, 3])
    rest = np.asarray(body_.rest_joints(body, jnp.asarray(joint.shapes)))
    trans = pelvis - rest[:, None, 0]
    return poses, trans, _posed(body, poses, joint.shapes, trans)


def _posed(
    body: body_.BodyModel,
    poses: Float[np.ndarray, "h t 72"],
    shapes: Float[np.ndarray, "h 10"],
    trans: Float[np.ndarray, "h t 3"],
) -> Float[np.ndarray, "h t 24 3"]:
    """Returns the joints of posed bodies, m, by a program compiled for few lengths."""
    frames = poses.shape[1]
    longer = lengthened((poses, trans), padded_length(frames), axis=1)
    joints = _joints(body, longer[0], jnp.asarray(shapes)[:, None], longer[1])
    return np.array(joints)[:, :frames]


def floor_height(
    body: body_.BodyModel,
    shapes: Float[np.ndarray, "h 10"],
    joints: Float[np.ndarray, "h t 24 3"],
    present: Bool[np.ndarray, "h t"],
    fps: float,
    standing: Bool[np.ndarray, "h t 2"] | None = None,
) -> float:
    """Returns the height of the floor under standing feet, m; if none stand, under the
    lowest feet.

    `joints` are in a world whose y axis is up, m.
    """
    found = standing_height(body, shapes, joints, present, fps, standing)
    if found is not None:
        return found
    lowest = joints[present][:, list(FEET), 1].min(axis=1)
    return float(np.quantile(lowest, 0.05)) - _sole(body, shapes)


def standing_height(
    body: body_.BodyModel,
    shapes: Float[np.ndarray, "h 10"],
    joints: Float[np.ndarray, "h t 24 3"],
    present: Bool[np.ndarray, "h t"],
    fps: float,
    standing: Bool[np.ndarray, "h t 2"] | None = None,
) -> float | None:
    """Returns the height of the floor under standing feet, m; `None` if none stand."""
    stances = find_stances(joints[:, :, list(FEET)], present, fps, standing)
    heights = np.concatenate([places[:, 1] for places in stances])
    return float(np.median(heights)) - _sole(body, shapes) if len(heights) else None


def _sole(body: body_.BodyModel, shapes: Float[np.ndarray, "h 10"]) -> float:
    return float(np.median([sole_height(body, shape) for shape in shapes]))


def sole_height(body: body_.BodyModel, shape: Float[np.ndarray, " 10"]) -> float:
    """Returns the height of the toe joints above the sole of a standing body, m."""
    template = np.asarray(body.template, np.float64)[:, 1]
    skin = template + np.asarray(body.shape_dirs, np.float64)[:, 1] @ shape
    rest = np.asarray(body_.rest_joints(body, jnp.asarray(shape)))
    return float(rest[list(FEET), 1].mean() - skin.min())


def _smoothed(sequence, config, present, poses, pelvis):
    """Low-passes regressed rotations and their paths in the world at `smoothing_hz`.

    Bodies fitted to keypoints are unchanged: the fit's prior on motion leaves hardly
    any noise, and the filter would take their motion (`benchmarks/experiments.md`).
    """
    if config.smoothing_hz is None:
        return poses, pelvis
    how = (sequence.fps, config.smoothing_hz)
    poses, pelvis = poses.copy(), pelvis.copy()
    for h in np.flatnonzero(~people.without_bodies(sequence)):
        joints = poses[h].reshape(-1, 24, 3)
        poses[h] = low_pass_rotations(joints, present[h], *how).reshape(-1, 72)
        pelvis[h] = low_pass(pelvis[h], present[h], *how)
    return poses, pelvis
