"""Readers of motion capture: the CMU archive, AMASS folders, BVH files.

`read_motion` finds out which it was given. Every reader checks what it hands on:
finite numbers, right widths, a rate; errors are one line that names the file.
"""

import itertools
from collections.abc import Callable
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
from jaxtyping import Float

from bodyslam_jax.motion._bvh import read_bvh
from bodyslam_jax.motion._clips import Clip, leg_length, rest_from_offsets

_CMU_ARRAYS = (
    "poses trans fps parents seq_start seq_length seq_name seq_motion seq_subject "
    "seq_split seq_phase subjects subject_offsets"
).split()


def read_motion(path: Path | str) -> tuple[Clip, ...]:
    """Reads all motion under a file or folder; clips keep the rate they have.

    In a folder, `.npz` files of other things are passed over.

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
        raise ValueError(
            f"{path}: no motion, but {names}; expected `poses` and `trans` of AMASS, "
            "or a CMU archive."
        )
    files = sorted(
        file
        for suffix in ("npz", "bvh")
        for file in itertools.chain(path.rglob(f"*.{suffix}"))
        if file.name not in ("shape.npz", "neutral_stagei.npz")
    )
    clips = tuple(itertools.chain.from_iterable(map(_read_file, files)))
    if not clips:
        raise ValueError(
            f"{path}: no usable motion among {len(files)} .npz and .bvh files; "
            "expected AMASS sequences, a CMU archive or BVH."
        )
    return clips


def _read_file(path: Path) -> tuple[Clip, ...]:
    if path.suffix.lower() == ".bvh":
        return (read_bvh(path),)
    with open(path, "rb") as file:
        try:
            archive = np.load(file, allow_pickle=False)
            names = set(archive.files)
        except (OSError, EOFError, AttributeError, ValueError, BadZipFile):
            raise ValueError(f"{path}: not a readable .npz file.") from None
        if "seq_start" in names:
            return _read_cmu(path, _taker(path, archive))
        if "trans" in names and names & {"poses", "root_orient", "pose_body"}:
            return (_read_amass(path, names, _taker(path, archive)),)
    return ()


def _taker(path: Path, archive) -> Callable[[str], np.ndarray]:
    """One array by name; an object array, which would be a pickle, is refused."""

    def take(name: str) -> np.ndarray:
        if name not in archive.files:
            raise ValueError(f"{path}: no array `{name}`, only {archive.files}.")
        try:
            return archive[name]
        except BadZipFile:
            raise ValueError(f"{path}: `{name}` is damaged; copy it again.") from None
        except ValueError:
            raise ValueError(
                f"{path}: `{name}` is a pickled object; expected a plain array."
            ) from None

    return take


def _check(path: Path, name: str, poses: np.ndarray, trans: np.ndarray) -> None:
    if len(poses) != len(trans):
        raise ValueError(
            f"{path}: {name} has {len(poses)} poses but {len(trans)} positions."
        )
    for what, array in (("pose", poses), ("position", trans)):
        bad = ~np.isfinite(array.reshape(len(array), -1)).all(-1)
        if bad.any():
            raise ValueError(
                f"{path}: {name} has a NaN or infinite {what} in frame "
                f"{int(bad.argmax())} ({int(bad.sum())} frames); expected numbers."
            )


def _read_cmu(path: Path, take: Callable[[str], np.ndarray]) -> tuple[Clip, ...]:
    """The archive of CMU trials as SMPL rotations, one clip per trial and phase."""
    data = {name: take(name) for name in _CMU_ARRAYS}
    poses, trans = data["poses"], data["trans"]
    if poses.ndim != 3 or poses.shape[1:] != (24, 3) or trans.shape[1:] != (3,):
        raise ValueError(
            f"{path}: poses {poses.shape}, trans {trans.shape}; expected (n, 24, 3) "
            "and (n, 3)."
        )
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
            raise ValueError(f"{path}: no skeleton of subject {subject!r}.")
        offsets = np.array(data["subject_offsets"][subjects[subject]])
        clips.append(
            Clip(
                name=str(names[i]),
                subject=subject,
                motion=str(data["seq_motion"][i]),
                split=str(data["seq_split"][i]),
                fps=float(data["fps"]),
                poses=poses[rows],
                trans=trans[rows],
                offsets=offsets,
                leg_length=float(leg_length(rest_from_offsets(offsets, parents))),
                phase=int(phase[i]),
                phases=4 if (phase[names == names[i]] > 0).any() else 1,
            )
        )
    if not clips:
        raise ValueError(f"{path}: the archive holds no sequence.")
    return tuple(clips)


def _read_amass(path: Path, names: set[str], take: Callable) -> Clip:
    """One AMASS sequence, SMPL-H or SMPL-X release; the world's z is up.

    `reference.md` of nghorbani/amass: `poses` (t, 156) of SMPL-H, of which SMPL has
    the first 66; `mocap_framerate` or `mocap_frame_rate`.
    """
    rates = names & {"mocap_framerate", "mocap_frame_rate"}
    if not rates:
        raise ValueError(f"{path}: no `mocap_framerate`; expected frames per second.")
    fps = float(take(rates.pop()))
    if not fps > 0:
        raise ValueError(f"{path}: frame rate {fps}; expected a positive number.")
    if "poses" in names:
        poses = take("poses")
    else:
        poses = np.concatenate([take("root_orient"), take("pose_body")], -1)
    trans = take("trans")
    if poses.ndim != 2 or poses.shape[1] < 66 or trans.shape[1:] != (3,):
        raise ValueError(
            f"{path}: poses {poses.shape}, trans {trans.shape}; expected (t, 66 or "
            "more) and (t, 3)."
        )
    if len(poses) == 0:
        raise ValueError(f"{path}: the sequence has no frame.")
    _check(path, "the sequence", poses, trans)
    hands = np.zeros((len(poses), 6))
    poses = np.concatenate([poses[:, :66], hands], -1).reshape(-1, 24, 3)
    return Clip(
        name=path.stem,
        subject=path.parent.name,
        motion=_motion_class(path.stem),
        split="",
        fps=fps,
        poses=poses.astype(np.float32),
        trans=trans.astype(np.float32),
        offsets=None,
        leg_length=_leg_from_height(trans),
    )


def gender(path: Path) -> str:
    """The gender that an AMASS file states, whether stored as text or as bytes."""
    with np.load(path, allow_pickle=False) as archive:
        value = _taker(path, archive)("gender").item()
    text = value.decode() if isinstance(value, bytes) else str(value)
    text = text.strip("b'\" ").lower()
    return text if text in ("female", "male", "neutral") else "neutral"


def _leg_from_height(trans: Float[np.ndarray, "t 3"]) -> float:
    """Leg length (m) from the usual height of SMPL's origin above AMASS's floor.

    AMASS holds no bone length without a licensed body model. Its floor is z = 0, and
    the pelvis stands 0.92 to 0.94 m high in people with legs of 0.80 m (CMU).
    """
    height = float(np.percentile(trans[:, 2], 75))
    return float(np.clip(0.86 * height, 0.6, 1.1))


def _motion_class(text: str) -> str:
    text = text.lower()
    for word, kind in (("run", "run"), ("jog", "run"), ("walk", "walk")):
        if word in text:
            return kind
    return "other"
