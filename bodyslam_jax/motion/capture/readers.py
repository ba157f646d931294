"""Readers of motion capture: the CMU archive, AMASS folders, BVH files.

`read_motion` finds out which it was given. Every reader checks what it hands on:
finite numbers, right widths, a rate; errors are one line that names the file.
"""

import dataclasses
import logging
import zlib
from collections.abc import Callable
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.motion.capture.bvh import read_bvh
from bodyslam_jax.motion.capture.clips import Clip, leg_length, rest_from_offsets
from bodyslam_jax.motion.capture.legs import NoLegs, leg_from_height, leg_from_joints

logger = logging.getLogger(__name__)

_CMU_ARRAYS = (
    "poses trans fps parents seq_start seq_length seq_name seq_motion seq_subject "
    "seq_split seq_phase subjects subject_offsets"
).split()
_RATES = ("mocap_framerate", "mocap_frame_rate")


def read_motion(path: Path | str) -> tuple[Clip, ...]:
    """Reads all motion under a file or folder; clips keep the rate they have.

    In a folder, `.npz` files of other things are passed over, and so, with a warning,
    are sequences without bone lengths in which nobody stands.

    **Raises:** `FileNotFoundError` if there is nothing at `path`; `ValueError` if a
    file is damaged or if no file holds a usable sequence.
    """
    path = Path(path)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file or folder of motion data.")
    if path.is_file():
        if clips := _read_file(path):
            return clips
        with np.load(path, allow_pickle=False) as archive:
            names = ", ".join(archive.files[:8]) or "nothing"
        raise InputError(
            f"{path}: no motion, but {names}; expected `poses` and `trans` of AMASS, "
            "or a CMU archive."
        )
    files = sorted(
        file
        for file in path.rglob("*")
        if file.suffix.lower() in (".npz", ".bvh")
        and file.name not in ("shape.npz", "neutral_stagei.npz")
        and file.is_file()
    )
    clips, legless = [], []
    for file in files:
        try:
            clips += _read_file(file)
        except NoLegs as error:
            legless.append(error)
    if legless and not clips:
        raise legless[0]
    if legless:
        logger.warning(
            "passed over %d of %d files; the first: %s",
            len(legless),
            len(files),
            legless[0],
        )
    if not clips:
        raise InputError(
            f"{path}: no usable motion among {len(files)} .npz and .bvh files; "
            "expected AMASS sequences, a CMU archive or BVH."
        )
    return tuple(clips)


def _read_file(path: Path) -> tuple[Clip, ...]:
    if path.suffix.lower() == ".bvh":
        return (read_bvh(path),)
    with open(path, "rb") as file:
        try:
            archive = np.load(file, allow_pickle=False)
            names = set(archive.files)
        except (OSError, EOFError, AttributeError, ValueError, BadZipFile):
            raise InputError(f"{path}: not a readable .npz file.") from None
        if "seq_start" in names:
            return _read_cmu(path, _taker(path, archive))
        if "trans" in names and names & {"poses", "root_orient", "pose_body"}:
            return (_read_amass(path, names, _taker(path, archive)),)
    return ()


def _taker(path: Path, archive) -> Callable[[str], np.ndarray]:
    """One array by name; an object array, which would be a pickle, is refused."""

    def take(name: str) -> np.ndarray:
        if name not in archive.files:
            raise InputError(f"{path}: no array `{name}`, only {archive.files}.")
        try:
            return archive[name]
        except (BadZipFile, zlib.error, EOFError):
            raise InputError(f"{path}: `{name}` is damaged; copy it again.") from None
        except ValueError:
            raise InputError(
                f"{path}: `{name}` is a pickled object; expected a plain array."
            ) from None

    return take


def _numbers(path: Path, name: str, array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in "fiub":
        raise InputError(
            f"{path}: `{name}` is of type {array.dtype}; expected real numbers."
        )
    return array


def _rate(path: Path, fps: np.ndarray) -> float:
    if fps.size != 1 or not 1 <= fps.item() <= 1000:
        raise InputError(
            f"{path}: frame rate {fps.tolist()}; expected one number of 1 to 1000."
        )
    return float(fps.item())


def _check(path: Path, name: str, poses: np.ndarray, trans: np.ndarray) -> None:
    if len(poses) != len(trans):
        raise InputError(
            f"{path}: {name} has {len(poses)} poses but {len(trans)} positions."
        )
    for what, array in (("pose", poses), ("position", trans)):
        bad = ~np.isfinite(array.reshape(len(array), -1)).all(-1)
        if bad.any():
            raise InputError(
                f"{path}: {name} has a NaN or infinite {what} in frame "
                f"{int(bad.argmax())} ({int(bad.sum())} frames); expected numbers."
            )


def _read_cmu(path: Path, take: Callable[[str], np.ndarray]) -> tuple[Clip, ...]:
    """The archive of CMU trials as SMPL rotations, one clip per trial and phase."""
    data = {name: take(name) for name in _CMU_ARRAYS}
    for name in ("poses", "trans", "fps", "subject_offsets"):
        _numbers(path, name, data[name])
    poses, trans = data["poses"], data["trans"]
    if poses.ndim != 3 or poses.shape[1:] != (24, 3) or trans.shape[1:] != (3,):
        raise InputError(
            f"{path}: poses {poses.shape}, trans {trans.shape}; expected (n, 24, 3) "
            "and (n, 3)."
        )
    fps = _rate(path, data["fps"])
    parents = [int(p) for p in data["parents"]]
    subjects = {str(name): i for i, name in enumerate(data["subjects"])}
    phase, names = data["seq_phase"], data["seq_name"]
    clips = []
    for i, (start, length) in enumerate(
        zip(data["seq_start"], data["seq_length"], strict=True)
    ):
        rows = slice(int(start), int(start) + int(length))
        _check(path, str(names[i]), poses[rows], trans[rows])
        subject = str(data["seq_subject"][i])
        if subject not in subjects:
            raise InputError(f"{path}: no skeleton of subject {subject!r}.")
        offsets = np.array(data["subject_offsets"][subjects[subject]])
        clips.append(
            Clip(
                name=str(names[i]),
                subject=subject,
                motion=str(data["seq_motion"][i]),
                split=str(data["seq_split"][i]),
                fps=fps,
                poses=poses[rows],
                trans=trans[rows],
                offsets=offsets,
                leg_length=float(leg_length(rest_from_offsets(offsets, parents))),
                phase=int(phase[i]),
                phases=4 if (phase[names == names[i]] > 0).any() else 1,
            )
        )
    if not clips:
        raise InputError(f"{path}: the archive holds no sequence.")
    return tuple(clips)


def _read_amass(path: Path, names: set[str], take: Callable) -> Clip:
    """One AMASS sequence, SMPL-H or SMPL-X release, or a body that this project wrote.

    `reference.md` of nghorbani/amass: `poses` (t, 156) of SMPL-H, of which SMPL has
    the first 66; `mocap_framerate` or `mocap_frame_rate`. The project's own files have
    `joints` (t, 24, 3) besides, in the world, m.
    """
    number = lambda name: _numbers(path, name, take(name))
    rate = next((name for name in _RATES if name in names), None)
    if rate is None:
        raise InputError(f"{path}: no `mocap_framerate`; expected frames per second.")
    fps = _rate(path, number(rate))
    parts = ("poses",) if "poses" in names else ("root_orient", "pose_body")
    angles = [_rows(number(name)) for name in parts]
    trans = number("trans")
    if any(a.ndim != 2 for a in angles) or len({len(a) for a in angles}) > 1:
        shapes = ", ".join(f"{n} {a.shape}" for n, a in zip(parts, angles, strict=True))
        wanted = "(t, 3) and (t, 63)" if len(parts) > 1 else "(t, 66 or more)"
        raise InputError(f"{path}: {shapes}; expected {wanted}.")
    poses = np.concatenate(angles, -1)
    if poses.shape[1] < 66 or trans.shape[1:] != (3,):
        raise InputError(
            f"{path}: poses {poses.shape}, trans {trans.shape}; expected (t, 66 or "
            "more) and (t, 3)."
        )
    if len(poses) == 0:
        raise InputError(f"{path}: the sequence has no frame.")
    run = slice(None)
    if "present" in names:
        run = _longest(path, take("present"), len(poses))
    poses, trans = poses[run], trans[run]
    _check(path, "the sequence", poses, trans)
    hands = np.zeros((len(poses), 6))
    poses = np.concatenate([poses[:, :66], hands], -1).reshape(-1, 24, 3)
    clip = Clip(
        name=path.stem,
        subject=path.parent.name,
        motion=_motion_class(path.stem),
        split="",
        fps=fps,
        poses=poses.astype(np.float32),
        trans=trans.astype(np.float32),
        offsets=None,
        leg_length=np.nan,
    )
    joints = number("joints")[run] if "joints" in names else np.zeros(0)
    if joints.shape[1:] == (24, 3):
        leg = leg_from_joints(path, joints, len(poses))
    else:
        leg = leg_from_height(path, clip)
    return dataclasses.replace(clip, leg_length=leg)


def _longest(path: Path, present: np.ndarray, num_frames: int) -> slice:
    """The longest run of frames in which the person is present."""
    flags = present.dtype.kind in "biu" and np.isin(present, (0, 1)).all()
    if present.shape != (num_frames,) or not flags or not present.any():
        raise InputError(
            f"{path}: present is {present.dtype} {present.shape}; expected bool "
            f"{(num_frames,)}, true somewhere."
        )
    edges = np.flatnonzero(np.diff(np.r_[False, present.astype(bool), False]))
    best = np.argmax(edges[1::2] - edges[::2])
    return slice(edges[::2][best], edges[1::2][best])


def _rows(angles: np.ndarray) -> np.ndarray:
    """A row per frame, also of angles that are stored joint by joint."""
    if angles.ndim == 3:
        return angles.reshape(len(angles), angles.shape[1] * angles.shape[2])
    return angles


def gender(path: Path) -> str:
    """The gender that an AMASS file states, whether stored as text or as bytes."""
    with np.load(path, allow_pickle=False) as archive:
        value = _taker(path, archive)("gender").item()
    text = value.decode() if isinstance(value, bytes) else str(value)
    text = text.strip("b'\" ").lower()
    return text if text in ("female", "male", "neutral") else "neutral"


def _motion_class(text: str) -> str:
    text = text.lower()
    for word, kind in (("run", "run"), ("jog", "run"), ("walk", "walk")):
        if word in text:
            return kind
    return "other"
