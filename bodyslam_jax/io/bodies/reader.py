"""Regressed bodies of any tool -> one checked `Bodies`.

`bodies.npz`, the format of this package, is read here, result files of other tools by
`tools`.
"""

import dataclasses
import logging
import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bodyslam_jax.config import Association
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.bodies.amass import body_pose, is_smplx
from bodyslam_jax.io.bodies.body_records import Rows, Video
from bodyslam_jax.io.bodies.parts import (
    PELVIS_SMPL,
    PELVIS_SMPLX,
    join,
    numbers_of,
    whole_of,
)
from bodyslam_jax.io.bodies.slahmr import with_track_info
from bodyslam_jax.io.bodies.tools import READERS, from_spin
from bodyslam_jax.io.budget import check_bytes, last_frame_problem
from bodyslam_jax.io.frame_index import InvalidContent, Warn
from bodyslam_jax.io.safe_pickle import restricted_load
from bodyslam_jax.types import Bodies, Intrinsics

_log = logging.getLogger(__name__)

_MAX_DISTANCE = 200.0
"""Of a body from the camera, m; further away, `trans` is in another unit."""
_MAX_BETA = 100.0
"""Standard deviations of SMPL's shapes; those of people are within 5."""
_MIN_FINITE = 0.5
"""Share of the bodies that must be finite."""


def read_bodies(
    path: Path,
    *,
    num_frames: int | None,
    intrinsics: Intrinsics,
    fps: float | None = None,
    times: Float[np.ndarray, " t"] | None = None,
    images: tuple[str, ...] = (),
    config: Association = Association(),
    warn: Warn = _log.warning,
) -> Bodies:
    """Reads regressed bodies, recognised by content; or a folder of TRAM's tracks.

    Shapes in `bodies.npz` count as regressed by a network, unless its array
    `shapes_regressed` () is false, for shapes that were measured or optimised.
    Pickles are read by `safe_pickle`, which runs nothing in them.

    Args:
        num_frames: of the video; `None` for as many as the file has.
        fps: of the video, 1/s. Without it a motion of another rate is refused.
        times: of each of the video's frames, s.
        images: names of the video's frames, if it is a folder of images.

    **Raises:** `InputError`, naming the file, if it is none of the known kinds, has NaN
    or infinity in it, or belongs to another video.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file.")
    video = Video(intrinsics, num_frames, fps, times, images, config, warn)
    if path.is_dir():
        rows = _read_tram_folder(path, video)
    else:
        rows = _read(path, with_track_info(path, restricted_load(path)), video)
    return _gather(path, rows, num_frames, warn)


def _read(path: Path, data: Any, video: Video) -> Rows:
    if isinstance(data, dict) and set(data) == {"results"}:
        data = data["results"]
    if not isinstance(data, dict) or not data:
        raise InputError(f"{path}: no named arrays in it, so not bodies.")
    try:
        if {"frame", "poses", "betas"} <= set(data):
            return _from_contract(data, video)
        for _, recognise, read in READERS:
            if recognise(data):
                return read(data, video)
    except InvalidContent as error:
        raise InputError(f"{path}: {error}.") from None
    except InputError:
        raise
    except Exception as error:
        # Dictionaries of other tools, nested in any way: whatever fails is theirs.
        what = " ".join(f"{type(error).__name__}: {error}".split())[:120]
        raise InputError(f"{path}: incomplete or damaged bodies ({what}).") from None
    supported = ", ".join(dict.fromkeys(name for name, _, _ in READERS))
    keys = ", ".join(str(k) for k in list(data)[:6])
    raise InputError(
        f"{path}: not bodies of {supported} or bodies.npz; it holds {keys}."
    )


def _from_contract(data: dict, video: Video) -> Rows:
    regressed = _flag(data, "shapes_regressed", default=True)
    if "trans" not in data:
        if "camera" not in data:
            raise InvalidContent("neither `trans` nor `camera` and `bbox`")
        rows = from_spin({**data, "pose": data["poses"]}, video)
        return dataclasses.replace(rows, shapes_regressed=regressed)
    arrays = {}
    n = numbers_of(data, "frame", None).size
    data = _as_smpl(data)
    person = data.get("person", np.zeros(n))
    for name, value, shape in (
        ("frame", data["frame"], (n,)),
        ("person", person, (n,)),
        ("poses", data["poses"], (n, 72)),
        ("betas", data["betas"], (n, 10)),
        ("trans", data["trans"], (n, 3)),
    ):
        array = numbers_of({name: value}, name, shape)
        whole = name in ("frame", "person")
        arrays[name] = whole_of(array, name) if whole else array
    return Rows(**arrays, shapes_regressed=regressed)


def _as_smpl(data: dict) -> dict:
    """The data with SMPL's poses, if they are as wide as SMPL-H's or SMPL-X's."""
    poses, betas = (numbers_of(data, name, None) for name in ("poses", "betas"))
    if poses.ndim != 2 or poses.shape[1] not in (66, 156, 165):
        poses72 = poses
    else:
        poses72 = body_pose(poses)
        if is_smplx(data, poses.shape[1]):
            trans = numbers_of(data, "trans", (-1, 3)) + PELVIS_SMPLX - PELVIS_SMPL
            return {
                **data,
                "poses": poses72,
                "trans": trans,
                "betas": 0 * betas[:, :10],
            }
    if betas.ndim == 2 and betas.shape[1] > 10:
        betas = betas[:, :10]
    return {**data, "poses": poses72, "betas": betas}


def _flag(data: dict, key: str, default: bool) -> bool:
    value = np.asarray(data.get(key, default))
    if value.size != 1 or value.item() not in (0, 1):
        raise InvalidContent(f"`{key}` is {str(value)[:40]}, not true or false")
    return bool(value.item())


def _read_tram_folder(folder: Path, video: Video) -> Rows:
    """TRAM's `hps/` (one file per person), with `camera.npy` beside or above it."""
    tracks = sorted(folder.glob("**/hps_track_*.npy"))
    if not tracks:
        raise InputError(f"{folder}: a folder without TRAM's hps_track_*.npy.")
    cameras = [p / "camera.npy" for p in (folder, tracks[0].parent, folder.parent)]
    camera_file = next((p for p in cameras if p.is_file()), None)
    camera = restricted_load(camera_file) if camera_file else {}
    if not isinstance(camera, dict):
        raise InputError(f"{camera_file}: not a dictionary, expected TRAM's camera.")
    shared = {k: camera[k] for k in ("img_focal", "img_center") if k in camera}
    rows = []
    for track in tracks:
        data = restricted_load(track)
        if not isinstance(data, dict):
            raise InputError(f"{track}: not a dictionary of arrays.")
        one = _read(track, {**data, **shared}, video)
        digits = re.findall(r"\d{1,9}", track.stem)
        if not digits:
            raise InputError(f"{track}: no number of a person in its name.")
        number = int(digits[-1])
        person = np.full(len(one.frame), number)
        rows.append(Rows(one.frame, person, one.poses, one.betas, one.trans))
    return join(rows)


def _finite(path: Path, rows: Rows, warn: Warn) -> Rows:
    """The bodies that are finite; others are absent in their frames, with a warning.

    **Raises:** `InputError` if most are not finite.
    """
    names = ("poses", "betas", "trans")
    fine = {name: np.isfinite(getattr(rows, name)).all(axis=1) for name in names}
    kept = np.all(list(fine.values()), axis=0)
    if kept.all():
        return rows
    broken = " and ".join(f"`{name}`" for name in names if not fine[name].all())
    text = f"{broken} has NaN or infinity in {(~kept).sum()} of {len(kept)} bodies"
    if kept.mean() < _MIN_FINITE:
        raise InputError(f"{path}: {text}.")
    warn(f"{text}: taken as absent in those frames.")
    arrays = {n: getattr(rows, n)[kept] for n in ("frame", "person", *names)}
    return dataclasses.replace(rows, **arrays)


def _gather(
    path: Path, rows: Rows, num_frames: int | None, warn: Warn = _log.warning
) -> Bodies:
    """Checks the rows and sorts them by person and frame."""
    if not len(rows.frame):
        raise InputError(f"{path}: no body in any frame.")
    m = len(rows.frame)
    for name, more in (
        ("person", ()),
        ("poses", (72,)),
        ("betas", (10,)),
        ("trans", (3,)),
    ):
        shape = getattr(rows, name).shape
        if shape != (m, *more):
            raise InputError(
                f"{path}: {m} frames for `{name}` of {shape}, expected {(m, *more)}."
            )
    rows = _finite(path, rows, warn)
    low, high = int(rows.frame.min()), int(rows.frame.max())
    if num_frames is None:
        observed = len(np.unique(rows.frame))
        if problem := last_frame_problem(high, observed, "bodies"):
            raise InputError(f"{path}: {problem}.")
        num_frames = high + 1
    if low < 0 or high >= num_frames:
        raise InputError(
            f"{path}: bodies of frames {low} to {high}, but the video has {num_frames}."
        )
    distance = float(np.linalg.norm(rows.trans, axis=-1).max())
    if distance > _MAX_DISTANCE:
        raise InputError(f"{path}: a body {distance:.0f} m away; `trans` is in m.")
    if (rows.trans[:, 2] < -0.5).all():
        raise InputError(f"{path}: all bodies behind the camera; z is forward.")
    turn = float(np.linalg.norm(rows.poses.reshape(-1, 3), axis=-1).max())
    if turn > 20:
        raise InputError(f"{path}: a joint turned by {turn:.0f} rad; degrees?")
    widest = float(np.abs(rows.betas).max(initial=0))
    if widest > _MAX_BETA:
        raise InputError(
            f"{path}: a shape of {widest:.3g} standard deviations (`betas`), expected "
            f"at most {_MAX_BETA:g}."
        )
    people, index = np.unique(rows.person, return_inverse=True)
    size = (len(people), num_frames)
    check_bytes(path, 8 * 85 * len(people) * num_frames, "as a table ")
    present = np.zeros(size, dtype=bool)
    if len(np.unique(index * num_frames + rows.frame)) < len(index):
        raise InputError(f"{path}: two bodies of one `person` in the same `frame`.")
    poses, shapes = np.zeros((*size, 72)), np.zeros((*size, 10))
    trans = np.zeros((*size, 3))
    at = (index, rows.frame)
    present[at] = True
    poses[at], shapes[at], trans[at] = rows.poses, rows.betas, rows.trans
    return Bodies(present, poses, shapes, trans, rows.shapes_regressed)
