"""Regressed bodies of any tool -> one checked `Bodies`.

The formats are in `formats`, `bodies.npz`, that of this package, among them.
"""

import dataclasses
import logging
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bodyslam_jax.config import Association
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.bodies.body_format import body_formats
from bodyslam_jax.io.bodies.parts import Rows, Video, genders_in
from bodyslam_jax.io.budget import check_bytes, last_frame_problem
from bodyslam_jax.io.formats import attributed, format_of, names_of
from bodyslam_jax.io.frame_index import Warn
from bodyslam_jax.io.safe_pickle import restricted_load
from bodyslam_jax.types import Bodies, Intrinsics

_log = logging.getLogger(__name__)

_MAX_DISTANCE_M = 200.0
"""Largest distance of a body from the camera, m; further away, `trans` is in another
unit."""
_MAX_BETA = 100.0
"""Largest β, in standard deviations of SMPL's shapes; those of people are within 5."""
_MIN_FINITE_SHARE = 0.5
"""Least share of the bodies that are finite."""


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
    """Reads a file or folder of any format in `body_formats`, recognised by content.

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
    among = body_formats()
    chosen, source = format_of(path, among, _arrays)
    if chosen is None:
        keys = ", ".join(str(k) for k in list(source.content)[:6])
        raise InputError(f"{path}: not bodies of {names_of(among)}; it holds {keys}.")
    with attributed(path, "bodies"):
        rows = chosen.read(source, video)
    gender = _gender(source.content, warn)
    return dataclasses.replace(_gather(path, rows, num_frames, warn), gender=gender)


def _arrays(path: Path) -> dict:
    """Returns the named arrays of a file.

    **Raises:** `InputError`, naming the file, if it has none.
    """
    data = restricted_load(path)
    if isinstance(data, dict) and set(data) == {"results"}:
        data = data["results"]
    if not isinstance(data, dict) or not data:
        raise InputError(f"{path}: no named arrays in it, so not bodies.")
    return data


def _gender(data: Any, warn: Warn) -> str | None:
    """Returns the gender of the model that all bodies of a file belong to, if it is
    one."""
    found = data.get("gender") if isinstance(data, dict) else None
    known, other = genders_in(found)
    if other:
        words = ", ".join(sorted(other)[:3])
        warn(f"bodies: gender {words!r}, expected female, male or neutral: ignored.")
    if len(known) > 1:
        warn(
            f"bodies of {' and '.join(sorted(known))} models: one model is used for "
            "all, in which β of the others mean other shapes."
        )
    return known.pop() if len(known) == 1 else None


def _finite(path: Path, rows: Rows, warn: Warn) -> Rows:
    """Returns the bodies that are finite; others are absent in their frames, with a
    warning.

    **Raises:** `InputError` if most are not finite.
    """
    names = ("poses", "betas", "trans")
    fine = {name: np.isfinite(getattr(rows, name)).all(axis=1) for name in names}
    kept = np.all(list(fine.values()), axis=0)
    if kept.all():
        return rows
    broken = " and ".join(f"`{name}`" for name in names if not fine[name].all())
    text = f"{broken} has NaN or infinity in {(~kept).sum()} of {len(kept)} bodies"
    if kept.mean() < _MIN_FINITE_SHARE:
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
    if distance > _MAX_DISTANCE_M:
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
    # 72 angles, 10 β and 3 coordinates of 8 bytes.
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
