"""Reads BVH files with CMU's joint names as SMPL rotations.

As in the project's conversion of the CMU data, the global rotation of SMPL joint k is
`G_j A_k`: `G_j` is the rotation of the capture's bone j from its rest pose, and `A_k`
the smallest rotation from the direction of SMPL's rest bone to that of the capture's.
The directions of limbs are exact; their twist is that of the capture.
"""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.body import PARENTS
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3
from bodyslam_jax.io.declared import MAX_MAGNITUDE, as_array
from bodyslam_jax.io.files import read_bytes
from bodyslam_jax.motion.capture.clips import (
    Clip,
    leg_length,
    padded,
    rest_from_offsets,
)

_JOINT_NAMES = (
    "Hips LeftUpLeg,LHip RightUpLeg,RHip LowerBack,Spine,Chest LeftLeg,LKnee "
    "RightLeg,RKnee Spine,Spine1,Chest LeftFoot,LAnkle RightFoot,RAnkle "
    "Spine1,Spine2,Spine,Chest LeftToeBase,LeftToe RightToeBase,RightToe "
    "Neck1,Neck LeftShoulder,LCollar RightShoulder,RCollar Head LeftArm,LShoulder "
    "RightArm,RShoulder LeftForeArm,LElbow RightForeArm,RElbow LeftHand,LWrist "
    "RightHand,RWrist"
).split()
"""For each of SMPL's joints 0 to 21, names of the BVH joint whose rotation it takes;
the first name that the file contains is used."""

_REST_BONES = {
    1: (4, (0.08, -0.99, -0.01)),
    2: (5, (-0.08, -0.99, -0.01)),
    4: (7, (0.02, -0.99, -0.09)),
    5: (8, (-0.02, -0.99, -0.09)),
    7: (10, (0.26, -0.45, 0.85)),
    8: (11, (-0.26, -0.45, 0.85)),
    16: (18, (1.0, -0.05, -0.08)),
    17: (19, (-1.0, -0.05, -0.08)),
    18: (20, (1.0, 0.03, -0.01)),
    19: (21, (-1.0, 0.03, -0.01)),
}
"""Directions of SMPL's bones in the rest pose: joint -> (child, direction). Joints that
are not listed (spine, neck, collars) need no alignment."""

_POSITIONS = ("xposition", "yposition", "zposition")
_ROTATIONS = ("xrotation", "yrotation", "zrotation")
"""Names of channels in lower case, as files differ in case."""

_UNITS = (1.0, 0.01, 0.0254, 0.056444, 0.001)
"""Metres per unit of length: m, cm, inch, CMU's 1/0.45 inch, mm."""

_MAX_JOINTS = 500
"""Largest number of joints; a skeleton with fingers and face has some hundred."""


@dataclasses.dataclass
class _Joint:
    """A joint of the hierarchy."""

    name: str
    parent: int
    """Index of the parent; -1 for the root."""
    offset: np.ndarray
    """Position relative to the parent in the rest pose, in the file's unit."""
    channels: list[str]
    """Names of channels in the file's order, in lower case."""


def read_bvh(path: Path) -> Clip:
    """Reads one BVH file with joint names of the CMU conversions (y up).

    The unit of length is the one that makes the legs 0.55 to 1.15 m long.

    **Raises:** `InputError` if the file is not BVH, is truncated, contains NaN, unknown
    channels or an impossible frame time, or lacks a joint of the legs.
    """
    path = Path(path)
    joints, values, fps = _parse(path)
    index = {joint.name: i for i, joint in enumerate(joints)}
    source = [
        next((index[name] for name in names.split(",") if name in index), None)
        for names in _JOINT_NAMES
    ]
    for joint in (0, 1, 2, 4, 5, 7, 8):
        if source[joint] is None:
            raise InputError(
                f"{path}: no joint {_JOINT_NAMES[joint].replace(',', ' or ')}; found "
                f"{', '.join(list(index)[:8])}, ..."
            )
    global_rotation = padded(lambda rows: _forward(joints, jnp.asarray(rows)), values)
    channels, position = joints[0].channels, np.zeros((len(values), 3))
    if set(_POSITIONS) <= set(channels):
        position = values[:, [channels.index(name) for name in _POSITIONS]]
    rest = np.zeros((len(joints), 3))
    for i, joint in enumerate(joints):
        rest[i] = joint.offset + (rest[joint.parent] if joint.parent >= 0 else 0)
    smpl_rest = np.full((24, 3), np.nan)
    for k, j in enumerate(source):
        smpl_rest[k] = np.nan if j is None else rest[j]
    for k in range(1, 24):  # a joint that the capture lacks sits on its parent
        if np.isnan(smpl_rest[k, 0]):
            smpl_rest[k] = smpl_rest[PARENTS[k]]
    legs = float(leg_length(smpl_rest))
    unit = next((u for u in _UNITS if 0.55 < legs * u < 1.15), None)
    if unit is None:
        raise InputError(
            f"{path}: legs {legs:.3g} units long fit no known unit of length."
        )
    smpl_rest, position = smpl_rest * unit, position * unit
    align = np.tile(np.eye(3), (24, 1, 1))
    for k, (child, direction) in _REST_BONES.items():
        bone = smpl_rest[child] - smpl_rest[k]
        align[k] = _smallest_rotation(np.array(direction), bone)
    rotation = np.zeros((len(values), 24, 3, 3))
    for k in range(24):
        j = source[k] if k < 22 else None
        if j is None:
            rotation[:, k] = rotation[:, PARENTS[k]]
        else:
            rotation[:, k] = global_rotation[:, j] @ align[k]
    local = rotation.copy()
    for k in range(1, 24):
        local[:, k] = np.swapaxes(rotation[:, PARENTS[k]], -1, -2) @ rotation[:, k]
    poses = padded(_log, local)
    offsets = np.zeros((24, 3))
    for k in range(1, 24):
        offsets[k] = align[PARENTS[k]].T @ (smpl_rest[k] - smpl_rest[PARENTS[k]])
    return Clip(
        name=path.stem,
        subject=path.stem.split("_")[0],
        motion="other",
        split="",
        fps=fps,
        poses=poses.astype(np.float32),
        trans=position.astype(np.float32),
        offsets=offsets.astype(np.float32),
        leg_length=float(leg_length(rest_from_offsets(offsets, PARENTS))),
    )


def _smallest_rotation(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Returns the matrix of the smallest rotation from one direction to another."""
    start, end = start / np.linalg.norm(start), end / max(np.linalg.norm(end), 1e-9)
    axis, cosine = np.cross(start, end), float(start @ end)
    cross = np.array(
        [[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]]
    )
    return np.eye(3) + cross + cross @ cross / max(1 + cosine, 1e-9)


@jax.jit
def _log(matrices: Float[Array, "t j 3 3"]) -> Float[Array, "t j 3"]:
    return so3.log(matrices)


def _forward(
    joints: list[_Joint], rows: Float[Array, "t c"]
) -> Float[Array, "t j 3 3"]:
    """Returns global rotations of all joints; rotations of a joint's channels are
    composed in the file's order."""
    found, column = [], 0
    for joint in joints:
        rotation = jnp.broadcast_to(jnp.eye(3, dtype=rows.dtype), (len(rows), 3, 3))
        for channel in joint.channels:
            if channel in _ROTATIONS:
                axis = jnp.asarray(np.eye(3)[_ROTATIONS.index(channel)], rows.dtype)
                rotation = rotation @ so3.exp(jnp.deg2rad(rows[:, column, None]) * axis)
            column += 1
        if joint.parent >= 0:
            rotation = found[joint.parent] @ rotation
        found.append(rotation)
    return jnp.stack(found, 1)


def _parse(path: Path) -> tuple[list[_Joint], Float[np.ndarray, "t c"], float]:
    """Returns joints, channel values and frame rate (1/s) of a BVH file.

    **Raises:** as `read_bvh`.
    """
    content = read_bytes(path, "a BVH file")
    words = content.decode("utf-8", errors="replace").split()
    try:
        start = words.index("MOTION")
        joints, stack, i = [], [-1], 0
        while i < start:
            word = words[i]
            if word in ("ROOT", "JOINT"):
                joints.append(_Joint(words[i + 1], stack[-1], np.zeros(3), []))
                i += 1
            elif word == "End":  # a leaf has no channels and is no joint
                while words[i] != "}":
                    i += 1
            elif word == "{":
                stack.append(len(joints) - 1)
            elif word == "}":
                stack.pop()
            elif word == "OFFSET":
                joints[-1].offset = _numbers(words[i + 1 : i + 4])
                if joints[-1].offset.shape != (3,):
                    raise ValueError("an OFFSET of less than three numbers")
            elif word == "CHANNELS":
                count = int(words[i + 1])
                if not 0 <= count <= 6:
                    raise ValueError("a joint of more than six channels")
                named = words[i + 2 : i + 2 + count]
                joints[-1].channels = [name.lower() for name in named]
            i += 1
        frames = int(words[words.index("Frames:", start) + 1])
        time = words.index("Time:", start)
        step = float(words[time + 1])
        values = _numbers(words[time + 2 :])
    except (ValueError, IndexError):
        raise InputError(f"{path}: not a BVH file (HIERARCHY and MOTION).") from None
    if len(joints) > _MAX_JOINTS:
        raise InputError(
            f"{path}: {len(joints)} joints, expected at most {_MAX_JOINTS}."
        )
    for joint in joints:
        if not (np.abs(joint.offset) <= MAX_MAGNITUDE).all():
            raise InputError(
                f"{path}: OFFSET {joint.offset.tolist()} of {joint.name}; expected "
                "numbers."
            )
        for channel in joint.channels:
            if channel not in (*_POSITIONS, *_ROTATIONS):
                raise InputError(
                    f"{path}: channel {channel!r} of {joint.name}; expected Xposition, "
                    "Xrotation and the like."
                )
    if not 0.001 <= step <= 1:
        raise InputError(
            f"{path}: Frame Time {step:g}; expected 0.001 to 1 s from one to the next."
        )
    width = sum(len(joint.channels) for joint in joints)
    if frames < 1:
        raise InputError(f"{path}: {frames} frames; expected one or more.")
    if values.size != frames * width:
        raise InputError(
            f"{path}: {values.size} numbers; expected {frames} frames of {width}."
        )
    values = as_array(path, "MOTION", values.reshape(frames, width))
    return joints, values, 1 / step


def _numbers(words: list[str]) -> np.ndarray:
    """Converts words to numbers one by one: NumPy would first make an array of strings
    as wide as the longest word."""
    return np.array([float(word) for word in words])
