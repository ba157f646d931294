"""Functions that readers of regressed bodies share: checks, frames, rotations, cameras.

Errors are `InvalidContent`, to which the caller adds the file's name.

Readers make a table of bodies, `Rows`, from a file and what they need to know of the
video.

Weak-perspective bodies of cropped images become bodies in the camera frame. A network
that sees a crop regresses the body's size (`s`) and position (`tx, ty`) in the crop,
and its rotation relative to the crop's viewing direction. Formulas: `cam_crop2full` of
CLIFF (Li et al., ECCV 2022) with the true principal point; the rotation by the crop's
ray is that of Henning et al. (ECCV 2022, Section 3.3).
"""

import dataclasses
import logging
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.config import Association
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.io.budget import MAX_PEOPLE
from bodyslam_jax.io.declared import as_array
from bodyslam_jax.io.frame_index import InvalidContent, Warn, frames_of_names
from bodyslam_jax.tracking.tracker import PointSet, identify
from bodyslam_jax.types import DEFAULT_FPS, Intrinsics

PELVIS_SMPL = np.array([-0.0018, -0.2233, 0.0282])
"""J_0 of SMPL's neutral template, m."""
PELVIS_SMPLX = np.array([0.0031, -0.3514, 0.0120])
"""J_0 of SMPL-X's neutral template, m."""
_NO_FILE = Path("bodies")
_GENDERS = {"f": "female", "m": "male", "n": "neutral"}
_GENDERS |= {gender: gender for gender in _GENDERS.values()}
_BODY_GRID_M = np.stack(
    np.meshgrid(np.linspace(-0.25, 0.25, 5), np.linspace(-0.85, 0.85, 5))
)
"""Grid of the size of a body around its middle, in the plane of the image, m."""
_GRID_POINTS = PointSet(min_confidence=0.0)
_log = logging.getLogger(__name__)
_MIN_SIZE_PX = 1e-9
"""Least size, px, which avoids a division by 0; far below that of any person."""


def numbers_of(data: dict, key: str, shape: tuple[int, ...] | None) -> np.ndarray:
    """Returns a float64 array of the given shape (-1: any length).

    Values that are not finite become NaN; the reader leaves out their bodies.

    **Raises:** `InvalidContent` if `data` has no numeric array `key`, or if that array
    is of another shape.
    """
    if not isinstance(data, dict) or key not in data:
        raise InvalidContent(f"no `{key}`")
    value = data[key]
    if isinstance(value, np.ndarray) and value.dtype.kind == "O":
        value = value.tolist()
    try:
        array = as_array(_NO_FILE, key, value, finite=False)
    except InputError as error:  # the caller knows the file
        text = str(error).removeprefix(f"{_NO_FILE}: ").rstrip(".")
        raise InvalidContent(text) from None
    array = np.where(np.isfinite(array), array, np.nan)
    if shape is not None:
        fits = array.ndim == len(shape) and all(
            want in (-1, have) for want, have in zip(shape, array.shape, strict=True)
        )
        if not fits:
            expected = tuple("any" if n < 0 else n for n in shape)
            raise InvalidContent(f"`{key}` is {array.shape}, not {expected}")
    return array


def betas_of(data: dict, key: str, n: int) -> np.ndarray:
    """Returns the first ten β of each of `n` bodies; one row may stand for all."""
    betas = np.atleast_1d(numbers_of(data, key, None))
    if betas.size == 0 or betas.size // betas.shape[-1] not in (1, n):
        raise InvalidContent(f"`{key}` is {betas.shape}, not (10,) or ({n}, 10)")
    betas = np.broadcast_to(betas.reshape(-1, betas.shape[-1]), (n, betas.shape[-1]))
    if betas.shape[1] < 10:
        raise InvalidContent(
            f"`{key}` has {betas.shape[1]} numbers a body, not 10 or more"
        )
    return betas[:, :10].copy()


def whole_of(array: np.ndarray, name: str) -> np.ndarray:
    """Returns numbers of frames or people as integers.

    **Raises:** `InvalidContent` if one is not a whole number.
    """
    off = array[~np.isfinite(array) | (array != np.round(array))]
    if len(off):
        raise InvalidContent(f"`{name}` has {off[0]:g} in it, expected whole numbers")
    return array.astype(np.int64)


def people_of(data: dict, n: int) -> np.ndarray:
    """Returns the number of each body's person; all 0 if the file has none."""
    if "person" not in data:
        return np.zeros(n, dtype=np.int64)
    return whole_of(numbers_of(data, "person", (n,)), "person")


def frames_of(data: dict, key: str, n: int, num_frames: int | None) -> np.ndarray:
    """Returns the frame of each of `n` bodies; without `key`, one body per frame."""
    if key in data:
        found = whole_of(np.ravel(numbers_of(data, key, None)), key)
        if len(found) != n:
            raise InvalidContent(f"`{key}` has {len(found)} entries for {n} bodies")
        return found
    if num_frames is not None and n != num_frames:
        raise InvalidContent(
            f"{n} bodies without `{key}`, but the video has {num_frames} frames"
        )
    return np.arange(n)


@dataclasses.dataclass(frozen=True)
class Video:
    """The video that a file of bodies is read for."""

    camera: Intrinsics
    num_frames: int | None = None
    """Number of frames; `None` if it is that of the file."""
    fps: float | None = None
    """Frame rate, 1/s; `None` if unknown."""
    times: Float[np.ndarray, " t"] | None = None
    """Time of every frame, s; `None` if unknown."""
    images: tuple[str, ...] = ()
    """Names of the frames, if the video is a folder of images."""
    config: Association = Association()
    warn: Warn = _log.warning

    @property
    def rate(self) -> float:
        """Frame rate, 1/s; 30 if it is not known."""
        return self.fps or DEFAULT_FPS

    def frames_in(self, seconds: float) -> int:
        """Returns the number of frames in so many seconds, at least 1."""
        return max(1, round(seconds * self.rate))


def frames_of_images(names: list[str], video: Video, *, complete: bool) -> np.ndarray:
    """Returns the frame of each body, from the name of its image."""
    frames = frames_of_names(
        names,
        what="bodies",
        num_frames=video.num_frames,
        images=video.images,
        complete=complete,
        warn=video.warn,
    )
    return np.array([frames[name] for name in names], dtype=np.int64)


def tell_apart(frame: np.ndarray, trans: np.ndarray, video: Video) -> np.ndarray:
    """Returns numbers of people, (m,), for a tool that does not track them: by position
    and size in the image. With at most one body per frame there is one person."""
    if len(np.unique(frame)) == len(frame):
        return np.zeros(len(frame), dtype=np.int64)
    if (busiest := np.unique(frame, return_counts=True)[1].max()) > MAX_PEOPLE:
        raise InvalidContent(
            f"{busiest} bodies in one frame, expected at most {MAX_PEOPLE}"
        )
    fx, fy, cx, cy = video.camera.params[:4]
    order = np.argsort(frame, kind="stable")
    x, y, z = trans[order].T[:, :, None]
    z = np.maximum(z, 0.1)
    u = fx * (x + _BODY_GRID_M[0].ravel()) / z + cx
    v = fy * (y + _BODY_GRID_M[1].ravel()) / z + cy
    points = np.stack([u, v, np.ones_like(u)], axis=-1)
    points[~np.isfinite(points).all(axis=-1)] = 0.0
    first = np.searchsorted(frame[order], np.arange(1, frame.max(initial=0) + 1))
    found = identify(
        np.split(points, first), video.rate, video.config.max_gap, _GRID_POINTS
    )
    person = np.empty(len(frame), dtype=np.int64)
    person[order] = np.concatenate(found)
    return person


def as_rotvec(array: np.ndarray, joints: int | None) -> np.ndarray:
    """Returns axis-angle (m, 3j), rad, from rotation matrices (m, j, 3, 3) or (j, 3,
    3).

    An array that already is axis-angle is returned unchanged.
    """
    array = np.asarray(array, dtype=np.float64)
    if array.shape[-2:] == (3, 3):
        if joints is not None and array.size % (9 * joints):
            raise InvalidContent(f"rotations {array.shape}, not of {joints} joints")
        rotvec = so3.log(array.reshape(-1, 3, 3))
        count = joints or array.shape[1]
        return rotvec.reshape(-1, 3 * count)
    return (
        array.reshape(len(array), -1)
        if joints is None
        else array.reshape(-1, 3 * joints)
    )


def pose_of(data: dict) -> np.ndarray:
    array = numbers_of(data, "pose", None)
    if array.shape[1:] not in ((72,), (24, 3), (24, 3, 3)):
        raise InvalidContent(f"`pose` is {array.shape}, not rotations of 24 joints")
    return as_rotvec(array, 24)


def middle(camera: Intrinsics) -> np.ndarray:
    """Returns the principal point (px) of tools that put it in the image's middle."""
    return np.array([(camera.width - 1) / 2, (camera.height - 1) / 2])


def refocused(
    trans: np.ndarray, focal: np.ndarray, center: np.ndarray, camera: Intrinsics
) -> np.ndarray:
    """Returns positions (m) at which bodies have the same image in the true camera.

    For the same size in the image, distance is proportional to the focal length.

    Args:
        trans: positions in the tool's camera, m.
        focal: of the tool's camera, px: one number per body, or two (x, y).
        center: its principal point, px: one for all, or one per body.
    """
    if (trans[:, 2] == 0).any():
        raise InvalidContent("a body at a distance of 0 from the camera (z = 0)")
    fx, fy, cx, cy = camera.params[:4]
    focal = np.broadcast_to(focal.reshape(len(trans), -1), (len(trans), 2))
    center = np.broadcast_to(center, (len(trans), 2))
    z = trans[:, 2] * fx / focal[:, 0]
    uv = center + focal * trans[:, :2] / trans[:, 2:]
    xy = (uv - [cx, cy]) / [fx, fy] * z[:, None]
    return np.concatenate([xy, z[:, None]], axis=-1)


def at_size(K: Float[np.ndarray, "n 3 3"], video: Video) -> Float[np.ndarray, "n 3 3"]:
    """Returns a tool's camera matrices, for images of the video's size.

    A tool that resized the images has its principal point in the middle of images of
    another size and the same aspect ratio.
    """
    whole = 2 * np.median(K[:, :2, 2], axis=0)
    size = np.array([video.camera.width, video.camera.height])
    x, y = whole / size
    if not (x > 0 and y > 0) or abs(np.log(x / y)) > 0.02 or abs(np.log(x)) < 0.2:
        return K
    factor = float(2 / (x + y))
    video.warn(
        f"bodies of a camera for images of {whole[0]:.0f}x{whole[1]:.0f} px, but the "
        f"video has {size[0]}x{size[1]} px: its pixels multiplied by {factor:.4g}."
    )
    return np.concatenate([factor * K[:, :2], K[:, 2:]], axis=1)


def focals(K: np.ndarray) -> np.ndarray:
    """Returns fx and fy of each camera matrix, (n, 2), px."""
    return np.stack([K[:, 0, 0], K[:, 1, 1]], axis=-1)


@dataclasses.dataclass(frozen=True)
class Rows:
    """`m` bodies in the camera frame, in any order."""

    frame: Int[np.ndarray, " m"]
    person: Int[np.ndarray, " m"]
    """Number of each body's person, in any order."""
    poses: Float[np.ndarray, "m 72"]
    """SMPL's joint rotations, axis-angle, rad; the first is `R_CH` of the root."""
    betas: Float[np.ndarray, "m 10"]
    """SMPL β."""
    trans: Float[np.ndarray, "m 3"]
    """Translation, m: the pelvis is at `J_0(β) + trans`."""
    shapes_regressed: bool = True
    """As in `Bodies`."""


def from_crops(
    frame: np.ndarray,
    person: np.ndarray,
    poses: np.ndarray,
    betas: np.ndarray,
    crop: np.ndarray,
    box: np.ndarray,
    camera: Intrinsics,
) -> Rows:
    """Returns bodies given in weak perspective (s, tx, ty) of square boxes (cx, cy,
    side px), with root rotations relative to the crop's ray."""
    if (crop[:, 0] <= 0).any() or (box[:, 2] <= 0).any():
        raise InvalidContent(
            "a weak-perspective camera or box with a size of 0 or less"
        )
    trans = full_translation(crop, box, camera)
    root = turn_to_camera(poses[:, :3], box, camera)
    return Rows(
        frame, person, np.concatenate([root, poses[:, 3:]], axis=-1), betas, trans
    )


def join(rows: list[Rows]) -> Rows:
    """Returns the bodies of several people in one table."""
    if not rows:
        raise InvalidContent("no person in it")
    names = ("frame", "person", "poses", "betas", "trans")
    return Rows(
        *(np.concatenate([getattr(r, name) for r in rows]) for name in names),
        shapes_regressed=any(r.shapes_regressed for r in rows),
    )


def gender_of(value: Any) -> str | None:
    """Returns `female`, `male` or `neutral`, from text, bytes or an array of one of
    them."""
    value = value.item() if isinstance(value, np.ndarray) and value.size == 1 else value
    text = value.decode("latin1") if isinstance(value, bytes) else str(value)
    return _GENDERS.get(text.strip().lower())


def genders_in(value: Any) -> tuple[set[str], set[str]]:
    """Returns the genders in a file's entry, of one person or of each: those that are
    known, and other words."""
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, np.ndarray):
        value = np.unique(value).tolist() if value.dtype.kind in "SU" else []
    known, other = set(), set()
    for one in value if isinstance(value, list | tuple) else [value]:
        if not isinstance(one, str | bytes):
            continue
        gender = gender_of(one)
        word = one.decode("latin1") if isinstance(one, bytes) else one
        if gender:
            known.add(gender)
        elif word.strip().lower() not in ("", "unknown", "none"):
            other.add(word.strip()[:20])
    return known, other


def full_translation(
    camera: Float[np.ndarray, "m 3"],
    box: Float[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
) -> Float[np.ndarray, "m 3"]:
    """Returns `trans` (m) of bodies given as `(s, tx, ty)` in square boxes `(cx, cy,
    side px)`.

    Distortion is ignored: it moves a box's centre, whose own error is larger.
    """
    fx, fy, px, py = intrinsics.params[:4]
    s, tx, ty = camera.T
    cx, cy, side = box.T
    scale = side * s + _MIN_SIZE_PX
    z = 2 * fx / scale
    x = tx + 2 * (cx - px) / scale
    # With fx != fy a row of the crop spans fx / fy as many metres as a column.
    y = ty * fx / fy + 2 * (cy - py) / scale * fx / fy
    return np.stack([x, y, z], axis=-1)


def turn_to_camera(
    orientation: Float[np.ndarray, "m 3"],
    box: Float[np.ndarray, "m 3"],
    intrinsics: Intrinsics,
) -> Float[np.ndarray, "m 3"]:
    """Returns root rotations (axis-angle, rad) in the camera, of those relative to each
    crop's ray; NaN where a rotation or box is not finite.

    The pelvis does not move: rotations pivot at `J_0(β) + trans`.
    """
    fx, fy, px, py = intrinsics.params[:4]
    ray = np.stack([(box[:, 0] - px) / fx, (box[:, 1] - py) / fy], axis=-1)
    finite = np.isfinite(np.hstack([orientation, ray])).all(axis=1, keepdims=True)
    ray, turn = np.where(finite, ray, 0.0), np.where(finite, orientation, 0.0)
    turned = so3.compose(so3.optical_axis_to_ray(ray), turn)
    return np.where(finite, turned, np.nan)
