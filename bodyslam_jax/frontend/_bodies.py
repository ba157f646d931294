"""Regressed bodies -> one checked `Bodies`, whatever tool they came from.

The contract's `bodies.npz` and SPIN's keys are read here; `_body_tools.py` reads the
result files of other tools.
"""

import dataclasses
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.frontend._keypoints import numbers, open_npz
from bodyslam_jax.frontend._perspective import full_translation, turn_to_camera
from bodyslam_jax.sequence import Bodies, Intrinsics

_MAX_DISTANCE = 200.0
"""A person further away than this is not a person, m."""


@dataclasses.dataclass(frozen=True)
class Rows:
    """`m` bodies in the camera frame, in no order."""

    frame: Int[np.ndarray, " m"]
    person: Int[np.ndarray, " m"]
    """Any integer that is the same for the same person."""
    poses: Float[np.ndarray, "m 72"]
    """Axis-angle, rad, root first."""
    betas: Float[np.ndarray, "m 10"]
    trans: Float[np.ndarray, "m 3"]
    """m: the pelvis is at `J_0(β) + trans`."""


def read_bodies(path: Path, *, num_frames: int, intrinsics: Intrinsics) -> Bodies:
    """Reads regressed bodies, recognised by content.

    **Raises:** `ValueError`, naming the file, if it is none of the known kinds, has NaN
    or infinity in it, or belongs to another video.
    """
    if not path.is_file():
        raise ValueError(f"{path}: no such file.")
    rows = _read_npz(path, num_frames, intrinsics)
    return _gather(path, rows, num_frames)


def _read_npz(path: Path, num_frames: int, intrinsics: Intrinsics) -> Rows:
    with open_npz(path) as archive:
        keys = set(archive.files)
        get = lambda key: numbers(path, archive, key)
        if {"poses", "betas", "frame"} <= keys and keys & {"trans", "camera"}:
            poses, frame = get("poses"), get("frame")
        elif {"pose", "betas", "camera"} <= keys:  # SPIN: a row per frame, no numbers
            poses, frame = get("pose"), np.arange(len(get("pose")))
            if "frame" in keys:
                frame = get("frame")
            elif len(poses) != num_frames:
                raise ValueError(
                    f"{path}: {len(poses)} bodies without `frame`, but the video has "
                    f"{num_frames} frames."
                )
        else:
            raise ValueError(
                f"{path}: not bodies that this program knows; arrays {archive.files}."
            )
        person = get("person") if "person" in keys else np.zeros(len(poses))
        betas = get("betas")
        if "trans" in keys:
            trans = get("trans")
        else:
            if "bbox" not in keys:
                raise ValueError(f"{path}: `camera` needs `bbox` (cx, cy, side px).")
            camera, box = get("camera"), get("bbox")
            _check_shape(path, "camera", camera, (len(poses), 3))
            _check_shape(path, "bbox", box, (len(poses), 3))
            _check_shape(path, "pose", poses, (len(poses), 72))
            if (camera[:, 0] <= 0).any() or (box[:, 2] <= 0).any():
                raise ValueError(
                    f"{path}: `camera` or `bbox` with a size of 0 or less."
                )
            trans = full_translation(camera, box, intrinsics)
            root = turn_to_camera(poses[:, :3], box, intrinsics)
            poses = np.concatenate([root, poses[:, 3:]], axis=-1)
    for name, array, shape in (
        ("poses", poses, (len(poses), 72)),
        ("betas", betas, (len(poses), 10)),
        ("trans", trans, (len(poses), 3)),
        ("frame", frame, (len(poses),)),
        ("person", person, (len(poses),)),
    ):
        _check_shape(path, name, array, shape)
    return Rows(frame.astype(np.int64), person.astype(np.int64), poses, betas, trans)


def _check_shape(
    path: Path, name: str, array: np.ndarray, expected: tuple[int, ...]
) -> None:
    if array.shape != expected:
        raise ValueError(f"{path}: `{name}` is {array.shape}, not {expected}.")


def _gather(path: Path, rows: Rows, num_frames: int) -> Bodies:
    """Sorts rows by person and frame, after a last look at all of them."""
    if not len(rows.frame):
        raise ValueError(f"{path}: no body in any frame.")
    low, high = int(rows.frame.min()), int(rows.frame.max())
    if low < 0 or high >= num_frames:
        raise ValueError(
            f"{path}: bodies of frames {low} to {high}, but the video has {num_frames}."
        )
    distance = float(np.linalg.norm(rows.trans, axis=-1).max())
    if distance > _MAX_DISTANCE:
        raise ValueError(f"{path}: a body {distance:.0f} m away; `trans` is in m.")
    if (rows.trans[:, 2] < -0.5).all():
        raise ValueError(f"{path}: all bodies behind the camera; z is forward.")
    people, index = np.unique(rows.person, return_inverse=True)
    size = (len(people), num_frames)
    present = np.zeros(size, dtype=bool)
    if len(np.unique(index * num_frames + rows.frame)) < len(index):
        raise ValueError(f"{path}: two bodies of one `person` in the same `frame`.")
    poses, shapes = np.zeros((*size, 72)), np.zeros((*size, 10))
    trans = np.zeros((*size, 3))
    at = (index, rows.frame)
    present[at] = True
    poses[at], shapes[at], trans[at] = rows.poses, rows.betas, rows.trans
    return Bodies(present, poses, shapes, trans)
