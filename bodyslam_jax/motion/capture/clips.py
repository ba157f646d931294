"""Clips of motion capture as SMPL rotations, and their resampling.

Units are axis-angle (rad) and metres. The root's rotation takes H (x left, y up, z
forward) to the capture's world, whose heading and up axis do not matter, as
displacements are learnt in the body's frame.

A network is trained on the skeleton that it is used with, so that clips are retargeted:
a shape is fitted and the path scaled. The root's path must match the legs; otherwise
feet slide and the true displacements are wrong.
"""

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import least_squares

from bodyslam_jax.body import PARENTS, BodyModel, rest_joints
from bodyslam_jax.body.skeleton import ANKLES, HIPS, KNEES, MIRRORED
from bodyslam_jax.geometry import so3

FPS = 30.0
"""Frame rate of every motion model, 1/s."""
LEFT_RIGHT = tuple((k, other) for k, other in enumerate(MIRRORED) if other > k)
"""Pairs of SMPL joints that mirroring swaps."""
_FITTED_JOINTS = (1, 2, 4, 5, 7, 8, 16, 17, 18, 19, 20, 21)
"""Bones, by their lower joint, whose lengths determine the shape."""
_BONE_SIGMA_M = np.where(np.isin(_FITTED_JOINTS, (4, 5, 7, 8)), 0.01, 0.03)
"""Standard deviations of the lengths of these bones, m: small for legs; captures place
hips and shoulders at the markers."""


@dataclasses.dataclass(frozen=True)
class Clip:
    """One continuous recording of one person, `t` frames at a constant rate."""

    name: str
    subject: str
    """Clips with the same subject are on the same side of every split."""
    motion: str
    """Class of motion, such as walk or run."""
    split: str
    """Part of the data set, `train`, `val` or `other`; empty if the data define
    none."""
    fps: float
    """Frame rate, 1/s."""
    poses: Float[np.ndarray, "t 24 3"]
    """Axis-angle, rad; row 0 takes H to the world."""
    trans: Float[np.ndarray, "t 3"]
    """Pelvis joint in the world, m."""
    offsets: Float[np.ndarray, "24 3"] | None
    """The subject's bones in the rest pose, parent to joint, m; `None` if unknown."""
    leg_length: float
    """Hip to knee to ankle, mean of both sides, m: the unit of displacement."""
    phase: int = 0
    """Index of this clip among the interleaved decimations of one recording."""
    phases: int = 1
    """Number of these decimations, for `interleave`."""


def leg_length(rest: Float[np.ndarray, "*b 24 3"]) -> Float[np.ndarray, "*b"]:
    """Returns the leg length (m) of joints in any pose: hip to knee to ankle, mean of
    both sides."""
    rest = np.asarray(rest)
    bones = [*zip(HIPS, KNEES), *zip(KNEES, ANKLES)]
    lengths = [
        np.linalg.norm(rest[..., j, :] - rest[..., i, :], axis=-1) for i, j in bones
    ]
    return np.asarray(sum(lengths) / 2)


def rest_from_offsets(
    offsets: Float[np.ndarray, "24 3"], parents: Sequence[int]
) -> Float[np.ndarray, "24 3"]:
    """Sums bone vectors along the tree; returns rest joints with the pelvis at the
    origin."""
    rest = np.zeros_like(offsets)
    for joint in range(1, 24):
        rest[joint] = rest[parents[joint]] + offsets[joint]
    return rest


def hip_centre(clip: Clip) -> Float[np.ndarray, "t 3"]:
    """Returns the midpoint of the hip joints in the world, m.

    Body models and captures differ in the height of the pelvis joint above the hips,
    so that paths are transferred between them by the hips.
    """
    if clip.offsets is None:  # SMPL's mean shape
        below = np.array([0.0, -0.086, -0.016]) * clip.leg_length / 0.82
    else:
        below = (clip.offsets[1] + clip.offsets[2]) / 2
    return (clip.trans + root_matrices(clip) @ below).astype(np.float32)


def root_matrices(clip: Clip) -> Float[np.ndarray, "t 3 3"]:
    """Returns `C_WH` of every frame."""
    return padded(_matrix, clip.poses[:, 0])


@jax.jit
def _matrix(angles: Float[Array, "t 3"]) -> Float[Array, "t 3 3"]:
    return so3.exp(angles)


def mirror(clip: Clip) -> Clip:
    """Exchanges left and right of a motion; the world's x changes sign."""
    order = np.arange(24)
    for left, right in LEFT_RIGHT:
        order[[left, right]] = right, left
    turn, flip = np.array([1, -1, -1]), np.array([-1, 1, 1])
    offsets = None if clip.offsets is None else clip.offsets[order] * flip
    return dataclasses.replace(
        clip,
        name=clip.name + "-mirrored",
        poses=clip.poses[:, order] * turn.astype(clip.poses.dtype),
        trans=clip.trans * flip.astype(clip.trans.dtype),
        offsets=offsets,
    )


def padded(function: Callable, *arrays: np.ndarray) -> np.ndarray:
    """Calls a row-wise JAX function on a power-of-two number of rows.

    Without padding, the function would be compiled for each length of clips.
    """
    rows = len(arrays[0])
    extra = (1 << max(rows - 1, 1).bit_length()) - rows
    arrays = tuple(np.concatenate([a, np.repeat(a[-1:], extra, 0)]) for a in arrays)
    return np.asarray(function(*arrays))[:rows]


@jax.jit
def _slerp(
    start: Float[Array, "n 24 3"], end: Float[Array, "n 24 3"], at: Float[Array, " n"]
) -> Float[Array, "n 24 3"]:
    way = so3.between(start, end) * at[:, None, None]
    return so3.compose(start, way)


def resample(clips: Sequence[Clip], fps: float = FPS) -> tuple[Clip, ...]:
    """Interpolates clips at exactly `fps`: rotations by slerp, positions linearly.

    Any rate is allowed (100, 120.00004577, ...). A new frame that coincides with an old
    one is copied. The last frames are dropped rather than extrapolated.
    """
    if not clips:
        return ()
    index, fraction, following, new = [], [], [], []
    offset = 0
    for clip in clips:
        ratio = clip.fps / fps  # frames of the clip per new frame
        nearest = round(ratio)
        if nearest >= 1 and abs(ratio - nearest) < 1e-3 * ratio:
            ratio = float(nearest)  # 120.00004577 is meant to be 120
        t = len(clip.poses)
        count = int(np.floor((t - 1) / ratio + 1e-6)) + 1
        position = np.minimum(np.arange(count) * ratio, t - 1)
        low = position.astype(int)
        index.append(low + offset)
        following.append(np.minimum(low + 1, t - 1) + offset)
        fraction.append(position - low)
        new.append(count)
        offset += t
    low, high = np.concatenate(index), np.concatenate(following)
    at = np.concatenate(fraction)
    poses = np.concatenate([clip.poses for clip in clips])
    trans = np.concatenate([clip.trans for clip in clips])
    between = padded(_slerp, poses[low], poses[high], at.astype(poses.dtype))
    between = np.where((at == 0)[:, None, None], poses[low], between)
    weight = at.astype(trans.dtype)[:, None]
    moved = trans[low] * (1 - weight) + trans[high] * weight
    ends = np.cumsum(new)
    return tuple(
        dataclasses.replace(
            clip, fps=fps, poses=between[end - n : end], trans=moved[end - n : end]
        )
        for clip, n, end in zip(clips, new, ends, strict=True)
    )


def interleave(clips: Sequence[Clip]) -> tuple[Clip, ...]:
    """Merges the phases of one recording, at their common higher rate.

    Clips of a single phase are returned as they are.
    """
    together: dict[str, list[Clip]] = {}
    for clip in clips:
        together.setdefault(clip.name, []).append(clip)
    out = []
    for group in together.values():
        group = sorted(group, key=lambda clip: clip.phase)
        n = group[0].phases
        if n == 1 or [clip.phase for clip in group] != list(range(n)):
            out.extend(group)
            continue
        t = min(len(clip.poses) for clip in group)
        weave = lambda arrays: np.stack([a[:t] for a in arrays], 1).reshape(
            t * n, *arrays[0].shape[1:]
        )
        out.append(
            dataclasses.replace(
                group[0],
                fps=group[0].fps * n,
                poses=weave([clip.poses for clip in group]),
                trans=weave([clip.trans for clip in group]),
                phases=1,
            )
        )
    return tuple(out)


def split(
    clips: Sequence[Clip], share: float = 0.2, seed: int = 0
) -> tuple[tuple[Clip, ...], tuple[Clip, ...]]:
    """Splits clips into training and validation; no subject is in both.

    Validation subjects are those that the data define; else a random `share` of the
    subjects, at least one, unless there is a single subject.
    """
    subjects = sorted({clip.subject for clip in clips})
    held = {clip.subject for clip in clips if clip.split == "val"}
    if not held and len(subjects) > 1:
        count = max(1, round(share * len(subjects)))
        rng = np.random.default_rng(seed)
        held = set(rng.permutation(subjects)[:count].tolist())
    training = tuple(clip for clip in clips if clip.subject not in held)
    kept = {"val", ""}
    validation = [c for c in clips if c.subject in held and c.split in kept]
    return training, tuple(validation)


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
