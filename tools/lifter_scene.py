"""Motion capture seen by made-up cameras: what `train_lifter.py` learns from.

People of random shape walk before cameras that stand or follow, and are seen by
detectors of several definitions of keypoints, each person with offsets of their own,
and with the errors of `simulation.NOISE` or of the detector that ships.
"""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from lifter_detector import add_errors
from make_posture_prior import archives
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from bodyslam_jax.body import MIRRORED
from bodyslam_jax.body.skeleton import KNEES
from bodyslam_jax.people.skeleton import NUM_SHAPE, Skeleton, place_points
from bodyslam_jax.simulation.sensor_noise import NOISE, detect_keypoints

FRAMES = 320
"""Of a clip, at most."""
CAMERA, SIZE = np.array([1200.0, 1200.0, 640.0, 360.0]), (1280, 720)
STEEP = 0.3
"""Share of cameras that look up by as much as 30 degrees, or down by 70."""
_STRAIGHT, _STILL = 0.35, 60
"""rad, frames."""
_SHAPE_SPREAD = np.where(np.arange(NUM_SHAPE) < 10, 0.7, 1.0)
# Keypoints that an edge of the image or a piece of furniture hides together.
_GROUPS = (
    (11, 14, 19, 20, 21, 22, 23, 24),
    (10, 11, 13, 14, 19, 20, 21, 22, 23, 24),
    (3, 4),
    (6, 7),
    (0, 15, 16, 17, 18),
)


@dataclasses.dataclass(frozen=True)
class Motion:
    """One recorded sequence."""

    name: str
    walks: bool
    """Whether of `cmu_locomotion.npz`."""
    poses: Float[np.ndarray, "t 24 3"]
    trans: Float[np.ndarray, "t 3"]
    """Pelvis, m, y up."""


@dataclasses.dataclass(frozen=True)
class View:
    """A motion as a camera saw it, and the truth."""

    uv: Float[np.ndarray, "t 25 2"]
    confidence: Float[np.ndarray, "t 25"]
    T_CH: Float[np.ndarray, "t 4 4"]
    angles: Float[np.ndarray, "t 63"]
    """θ of joints 1 to 21, rad."""
    shape: Float[np.ndarray, " s"]


def read_motions(
    folder: Path, subjects: tuple[str, ...], within: bool, phases: tuple[int, ...]
) -> list[Motion]:
    """Sequences of more than a second of who is (not) in `subjects`."""
    found = []
    for name, data, usable in archives(folder):
        keep = usable & (np.isin(data["seq_subject"], subjects) == within)
        keep &= (data["seq_length"] >= 40) & np.isin(data["seq_phase"], phases)
        for i in np.flatnonzero(keep):
            rows = slice(
                data["seq_start"][i], data["seq_start"][i] + data["seq_length"][i]
            )
            poses, trans = (data[n][rows].astype(float) for n in ("poses", "trans"))
            walks = name == "locomotion"
            found.append(Motion(str(data["seq_name"][i]), walks, poses, trans))
    return found


def mirrored(motion: Motion) -> Motion:
    poses = motion.poses[:, np.array(MIRRORED)] * [1.0, -1.0, -1.0]
    return dataclasses.replace(
        motion, poses=poses, trans=motion.trans * [-1.0, 1.0, 1.0]
    )


def standing(motion: Motion, rng: np.random.Generator) -> Motion | None:
    """Somebody who stands still in one of the motion's postures with legs all but
    straight; `None` if there is none."""
    knees = np.linalg.norm(motion.poses[:, KNEES], axis=-1).max(axis=1)
    straight = np.flatnonzero(knees < _STRAIGHT)
    if not len(straight):
        return None
    k = rng.choice(straight)
    still = lambda a: np.repeat(a[k : k + 1], _STILL, axis=0)
    sway = gaussian_filter1d(rng.standard_normal((_STILL, 24, 3)), 15, axis=0)
    return dataclasses.replace(
        motion, poses=still(motion.poses) + 0.1 * sway, trans=still(motion.trans)
    )


def excerpt(motion: Motion, frames: int, rng: np.random.Generator) -> Motion:
    first = rng.integers(0, max(len(motion.poses) - frames, 0) + 1)
    rows = slice(first, first + frames)
    return dataclasses.replace(
        motion, poses=motion.poses[rows], trans=motion.trans[rows]
    )


_placed = jax.jit(jax.vmap(place_points, in_axes=(None, 0, None)))


def place(
    skeleton: Skeleton, angles: Float[np.ndarray, "t 63"], shape: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Joints and keypoints about the pelvis, in H; at most `FRAMES`."""
    filled = np.concatenate([angles, np.zeros((FRAMES - len(angles), 63))])
    found = _placed(skeleton, jnp.asarray(filled), jnp.asarray(shape))
    joints, points = (np.asarray(a[: len(angles)], float) for a in found)
    return joints, points


def watch(
    motion: Motion,
    skeleton: Skeleton,
    rng: np.random.Generator,
    noise: str,
    built_in: bool = False,
    exact: bool = False,
) -> View:
    """By one camera, of a person of one shape, with a detector's errors; those of the
    detector that ships too, if `built_in`. If `exact`, keypoints have no offsets that
    are a person's own."""
    shape = rng.standard_normal(NUM_SHAPE) * _SHAPE_SPREAD
    shape[10:] *= not exact
    angles = motion.poses[:, 1:22].reshape(-1, 63)
    joints, points = place(skeleton, angles, shape)
    R_CW, camera = _camera(motion.trans, rng)
    T_CH = np.tile(np.eye(4), (len(angles), 1, 1))
    T_CH[:, :3, :3] = R_CW @ Rotation.from_rotvec(motion.poses[:, 0]).as_matrix()
    T_CH[:, :3, 3] = np.einsum("tij,tj->ti", R_CW, motion.trans - camera)
    T_CH[:, 2, 3] = np.maximum(T_CH[:, 2, 3], 1.2)
    seen = lambda p: (
        np.einsum("tij,tkj->tki", T_CH[:, :3, :3], p) + T_CH[:, None, :3, 3]
    )
    uv, confidence = detect_keypoints(
        seen(points), seen(joints), CAMERA, SIZE, NOISE[noise], rng
    )
    if built_in:
        uv, confidence = add_errors(uv, confidence, seen(points), rng)
    return View(uv, confidence, T_CH, angles, shape)


def hide(view: View, rng: np.random.Generator) -> View:
    """Without one part of the body, in all frames."""
    confidence = view.confidence.copy()
    confidence[:, _GROUPS[rng.integers(len(_GROUPS))]] = 0.0
    return dataclasses.replace(view, confidence=confidence)


def _camera(
    trans: Float[np.ndarray, "t 3"], rng: np.random.Generator
) -> tuple[Float[np.ndarray, "t 3 3"], Float[np.ndarray, "t 3"]]:
    """R_CW and place of one that stands, or goes with the person, and turns to watch.

    W has y up; C has y down and z ahead.
    """
    follows = rng.random() < 0.5
    target = gaussian_filter1d(trans, 30, axis=0, mode="nearest")
    target = target if follows else np.repeat(trans.mean(0)[None], len(trans), 0)
    yaw, distance = rng.uniform(0, 2 * np.pi), rng.uniform(2.5, 9.0)
    # Most cameras are held in hands, some hang above people or lie below them.
    rise = rng.uniform(-0.5, 1.2) if rng.random() < STEEP else 0.0
    away = np.array([np.sin(yaw) * np.cos(rise), 0.0, np.cos(yaw) * np.cos(rise)])
    camera = target - distance * away
    camera[:, 1] = rng.uniform(0.5, 2.3) + distance * np.sin(rise)
    camera += np.cumsum(0.0015 * rng.standard_normal(camera.shape), axis=0)
    aim = gaussian_filter1d(trans, 20, axis=0, mode="nearest") + rng.normal(0, 0.15, 3)
    unit = lambda v: v / np.linalg.norm(v, axis=1, keepdims=True)
    z = unit(aim - camera)
    up = np.array([0.08 * rng.standard_normal(), 1.0, 0.08 * rng.standard_normal()])
    x = unit(np.cross(z, up))
    return np.stack([x, np.cross(z, x), z], axis=1), camera
