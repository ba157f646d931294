"""Readers of motion capture: the CMU archive, AMASS folders, BVH files.

`read_motion` recognises the format. Every reader checks that numbers are finite, arrays
have the expected shapes and the frame rate is plausible; errors are one line that names
the file.

In files without a skeleton, leg lengths are those of joints or of the height.
"""

import dataclasses
import logging
from pathlib import Path

import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.archive import Archive, read_npz
from bodyslam_jax.io.declared import shown
from bodyslam_jax.io.files import reading
from bodyslam_jax.motion.capture.bvh import read_bvh
from bodyslam_jax.motion.capture.clips import (
    Clip,
    leg_length,
    rest_from_offsets,
    root_matrices,
)

logger = logging.getLogger(__name__)
_CMU_ARRAYS = (
    "poses trans fps parents seq_start seq_length seq_name seq_motion seq_subject "
    "seq_split seq_phase subjects subject_offsets"
).split()
"""Arrays of the CMU archive."""
_RATE_ARRAYS = ("mocap_framerate", "mocap_frame_rate")
"""Names of the frame rate in AMASS files."""
_LEG_RANGE_M = (0.6, 1.1)
"""Range of plausible leg lengths, m."""
_REST_PELVIS_M = np.array([0.0, -0.22, 0.03])
"""Position of SMPL's pelvis joint for `trans` of zero, m."""
_MIN_UP_COSINE = 0.7
"""Least mean cosine between the up axes of world and body for a standing person."""


def read_motion(path: Path | str) -> tuple[Clip, ...]:
    """Reads all motion in a file or folder; clips keep their frame rate.

    In a folder, `.npz` files with other content are skipped, and so, with a warning,
    are sequences without bone lengths in which nobody stands.

    **Raises:** `InputError` if there is nothing at `path`, if a file is damaged or if
    no file contains a usable sequence.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder of motion data.")
    if path.is_file():
        if clips := _read_file(path):
            return clips
        names = ", ".join(read_npz(path).names[:8])
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
    """Reads one file of any format; empty for `.npz` files with other content."""
    if path.suffix.lower() == ".bvh":
        return (read_bvh(path),)
    archive = read_npz(path, "motion (.npz)")
    if "seq_start" in archive:
        return _read_cmu(archive)
    if "trans" in archive and {"poses", "root_orient", "pose_body"} & {*archive.names}:
        return (_read_amass(archive),)
    return ()


def _rate(archive: Archive, name: str) -> float:
    """Reads a frame rate (1/s).

    **Raises:** `InputError` if it is not one number of 1 to 1000.
    """
    fps = archive.array(name)
    if fps.size != 1 or not 1 <= fps.item() <= 1000:
        raise InputError(
            f"{archive.path}: frame rate {shown(fps.tolist())}; expected one number of "
            "1 to 1000."
        )
    return float(fps.item())


def _check(path: Path, name: str, poses: np.ndarray, trans: np.ndarray) -> None:
    """**Raises:** `InputError` if lengths differ or numbers are not finite."""
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


def _read_cmu(archive: Archive) -> tuple[Clip, ...]:
    """Reads the archive of CMU trials as SMPL rotations, one clip per trial and
    phase."""
    path = archive.path
    archive.require(*_CMU_ARRAYS)
    poses = archive.array("poses", ("n", 24, 3), finite=False)
    trans = archive.array("trans", ("n", 3), finite=False)
    fps = _rate(archive, "fps")
    parents = archive.array("parents", (24,), kind="whole", low=-1, high=23).tolist()
    if any(p >= k for k, p in enumerate(parents) if k):
        raise InputError(f"{path}: `parents` has a joint before its parent.")
    offsets_of = archive.array("subject_offsets", ("subjects", 24, 3))
    subjects = {name: i for i, name in enumerate(_words(archive, "subjects"))}
    within = {"kind": "whole", "low": 0, "high": len(poses)}
    starts = archive.array("seq_start", ("s",), **within)
    lengths = archive.array("seq_length", ("s",), **within)
    phase = archive.array("seq_phase", ("s",), kind="whole")
    names = _words(archive, "seq_name")
    texts = ("seq_subject", "seq_motion", "seq_split")
    of_subject, motion, split = (_words(archive, name) for name in texts)
    each = {len(starts), *map(len, (names, of_subject, motion, split))}
    if len(each) > 1 or len(subjects) != len(offsets_of):
        raise InputError(
            f"{path}: {len(starts)} sequences of {sorted(each)} entries and "
            f"{len(subjects)} subjects with {len(offsets_of)} skeletons."
        )
    phases_of = dict.fromkeys(names, 1)
    phases_of |= {name: 4 for name, k in zip(names, phase, strict=True) if k > 0}
    clips = []
    for i, (start, length) in enumerate(zip(starts, lengths, strict=True)):
        rows = slice(int(start), int(start) + int(length))
        if not length or rows.stop > len(poses):
            raise InputError(
                f"{path}: {names[i]} is frames {rows.start} to {rows.stop} of "
                f"{len(poses)}."
            )
        _check(path, names[i], poses[rows], trans[rows])
        subject = of_subject[i]
        if subject not in subjects:
            raise InputError(f"{path}: no skeleton of subject {subject!r}.")
        offsets = offsets_of[subjects[subject]].astype(np.float32)
        clips.append(
            Clip(
                name=names[i],
                subject=subject,
                motion=motion[i],
                split=split[i],
                fps=fps,
                poses=poses[rows].astype(np.float32),
                trans=trans[rows].astype(np.float32),
                offsets=offsets,
                leg_length=float(leg_length(rest_from_offsets(offsets, parents))),
                phase=int(phase[i]),
                phases=phases_of[names[i]],
            )
        )
    if not clips:
        raise InputError(f"{path}: the archive holds no sequence.")
    return tuple(clips)


def _words(archive: Archive, name: str) -> list[str]:
    """Reads an array of texts."""
    found = archive.raw(name)
    if found.ndim != 1 or found.dtype.kind not in "SUiu":
        raise InputError(
            f"{archive.path}: `{name}` is {found.dtype}{found.shape}, expected texts."
        )
    with reading(archive.path, f"texts in `{name}`"):
        return [str(word) for word in found.tolist()]


def _read_amass(archive: Archive) -> Clip:
    """Reads one AMASS sequence, of the SMPL-H or SMPL-X release, or a body written by
    this project.

    By `reference.md` of nghorbani/amass, `poses` (t, 156) are of SMPL-H, and SMPL has
    the first 66 of them; the rate is `mocap_framerate` or `mocap_frame_rate`. Files of
    this project have `joints` (t, 24, 3) in addition, in the world, m.
    """
    path, names = archive.path, {*archive.names}
    number = lambda name: archive.array(name, finite=False)
    rate = next((name for name in _RATE_ARRAYS if name in names), None)
    if rate is None:
        raise InputError(f"{path}: no `mocap_framerate`; expected frames per second.")
    fps = _rate(archive, rate)
    parts = ("poses",) if "poses" in names else ("root_orient", "pose_body")
    angles = [_rows(number(name)) for name in parts]
    trans = number("trans")
    if any(a.ndim != 2 for a in angles) or len({len(a) for a in angles}) > 1:
        shapes = ", ".join(f"{n} {a.shape}" for n, a in zip(parts, angles, strict=True))
        wanted = "(t, 3) and (t, 63)" if len(parts) > 1 else "(t, 66 or more)"
        raise InputError(f"{path}: {shapes}; expected {wanted}.")
    poses = np.concatenate(angles, -1)
    if poses.shape[1] < 66 or trans.ndim != 2 or trans.shape[1] != 3:
        raise InputError(
            f"{path}: poses {poses.shape}, trans {trans.shape}; expected (t, 66 or "
            "more) and (t, 3)."
        )
    if len(poses) == 0:
        raise InputError(f"{path}: the sequence has no frame.")
    run = slice(None)
    if "present" in names:
        run = _longest(path, archive.raw("present"), len(poses))
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
    """Returns the longest run of frames in which the person is present."""
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
    """Flattens angles that are stored per joint to one row per frame."""
    if angles.ndim == 3:
        return angles.reshape(len(angles), angles.shape[1] * angles.shape[2])
    return angles


def gender(path: Path) -> str:
    """Returns the gender stated in an AMASS file, stored as text or as bytes; `neutral`
    if there is no other."""
    text = read_npz(path).text("gender").strip("b'\" ").lower()
    return text if text in ("female", "male", "neutral") else "neutral"


def _motion_class(text: str) -> str:
    """Returns the class of motion that a file name indicates."""
    text = text.lower()
    for word, kind in (("run", "run"), ("jog", "run"), ("walk", "walk")):
        if word in text:
            return kind
    return "other"


class NoLegs(InputError):
    """The motion is valid, but its leg length cannot be determined."""


def leg_from_joints(path: Path, joints: np.ndarray, num_frames: int) -> float:
    """Returns the leg length (m), as the median over frames.

    **Raises:** `InputError`, naming the file, if shape or leg length are not those of a
    person.
    """
    if joints.shape != (num_frames, 24, 3):
        raise InputError(
            f"{path}: joints {joints.shape}; expected {(num_frames, 24, 3)}."
        )
    leg = float(np.median(leg_length(joints)))
    if not _LEG_RANGE_M[0] <= leg <= _LEG_RANGE_M[1]:
        raise InputError(
            f"{path}: legs of {leg:.3g} by its joints; expected {_LEG_RANGE_M[0]} to "
            f"{_LEG_RANGE_M[1]} m."
        )
    return leg


def leg_from_height(path: Path, clip: Clip) -> float:
    """Estimates the leg length (m) from the typical height of the pelvis above the
    floor at 0.

    AMASS contains no bone lengths without a licensed body model. The pelvis is 0.92 to
    0.94 m high in people with legs of 0.80 m (CMU). The world of AMASS has z up, that
    of this project y: up is the axis to which the root's y axis of standing people
    points.

    **Raises:** `NoLegs` if nobody stands, or not on a floor at 0.
    """
    upward = root_matrices(clip)[:, :, 1].mean(0)
    axis = max((1, 2), key=lambda i: upward[i])
    if upward[axis] < _MIN_UP_COSINE:
        raise NoLegs(
            f"{path}: no `joints`, and the body's mean up is "
            f"{np.round(upward, 2).tolist()}; expected a person who stands, y or z up."
        )
    height = float(np.percentile(clip.trans[:, axis] + _REST_PELVIS_M[axis], 75))
    leg = 0.86 * height
    if not _LEG_RANGE_M[0] <= leg <= _LEG_RANGE_M[1]:
        raise NoLegs(
            f"{path}: no `joints`, and the pelvis is {height:.3g} m up in "
            f"{'xyz'[axis]}; expected {_LEG_RANGE_M[0] / 0.86:.1f} to "
            f"{_LEG_RANGE_M[1] / 0.86:.1f} m above a floor at 0."
        )
    return leg
