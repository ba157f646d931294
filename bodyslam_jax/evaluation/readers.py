"""Reads run folders and ground truths into one `Result` each.

`summary.json` of a run folder is untrusted input, and validated.
"""

import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bodyslam_jax.body import BodyModel, joints, load_body_model
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.evaluation.resampling import bracket, interpolate_poses
from bodyslam_jax.io import files
from bodyslam_jax.io import read_tum as read_tum
from bodyslam_jax.io.archive import read_npy, read_npz
from bodyslam_jax.io.declared import as_array, as_number
from bodyslam_jax.types import Result

log = logging.getLogger(__name__)
_MAX_OFFSET_M = 0.01
"""Distance between a result's joints and those of a body model from which the model
cannot be the one that the result was estimated with."""
_RUN_FIELDS = {
    "timestamps": ("t",),
    "T_WC": ("t", 4, 4),
    "scale": (),
    "intrinsics": ("i",),
    "landmarks": ("l", 3),
    "poses": ("h", "t", 72),
    "trans": ("h", "t", 3),
    "betas": ("h", 10),
    "joints": ("h", "t", 24, 3),
    "present": ("h", "t"),
}
_MAX_LETTERS = 10_000
_MAX_NUMBER = 1e15
"""Above everything that is counted or measured; products of two are finite."""
_REASON_SCHEMA = {"message": str, "advice": str, "status": str}
_SCHEMA: dict[str, Any] = {
    "status": str,
    "reasons": [(str, _REASON_SCHEMA)],
    "headline": [str],
    "warnings": [str],
    "input": (
        str,
        {"name": str, "frames": int, "width": int, "height": int, "fps": float},
    ),
    "settings": {},
    "camera_motion": str,
    "camera_path_m": float,
    "scale": {"value": float, "sigma": float},
    "people": [
        {
            "status": str,
            "reasons": [(str, _REASON_SCHEMA)],
            "stature_m": float,
            "stature_sigma_m": float,
            "place_sigma_m": float,
            "height_sigma_m": float,
            "speed_m_s": float,
        }
    ],
    "frames_used": [int],
    "durations_s": {"*": float},
    "errors": {"*": {"*": (float, str, bool, {}, [])}},
    "has_camera": bool,
}
"""Types of the entries that readers of run folders use. Any may be missing or null; `*`
is any name, and a tuple lists alternatives."""


def read_result(path: Path) -> Result:
    """Reads `result.npz` (or the run folder around it) and its `summary.json`.

    **Raises:** `InputError`, naming the file, what was found and
    what was expected.
    """
    file = path / "result.npz" if path.is_dir() else path
    archive = read_npz(file, "a run's result.npz")
    archive.require(*_RUN_FIELDS)
    fields: dict[str, Any] = {
        name: archive.array(name, shape) for name, shape in _RUN_FIELDS.items()
    }
    if fields["timestamps"].size == 0 or (np.diff(fields["timestamps"]) <= 0).any():
        raise InputError(f"{file}: `timestamps` do not increase, or there is none.")
    # fx fy cx cy, or with the four distortion coefficients of OPENCV.
    if len(fields["intrinsics"]) not in (4, 8) or (fields["intrinsics"][:2] <= 0).any():
        raise InputError(
            f"{file}: `intrinsics` are {fields['intrinsics'][:8].tolist()}, expected "
            "fx, fy, cx, cy and for some k1, k2, p1, p2."
        )
    _check_rigid(file, fields["T_WC"])
    fields["scale"] = float(fields["scale"])
    fields["present"] = archive.array("present", ("h", "t"), kind="boolean")
    for name, width in (("joint_sigma", 24), ("root_sigma", 3)):
        if name in archive:
            fields[name] = archive.array(name, ("h", "t", width), low=0)
    summary_file = file.with_name("summary.json")
    summary = read_summary(summary_file) if summary_file.exists() else {}
    return Result(**fields, summary=summary)


_ROTATION_TOLERANCE = 0.01
"""Largest entry of `RᵀR - 1` of a rotation: rounding to float16 stays below 0.002."""


def _check_rigid(file: Path, T_WC: Float[np.ndarray, "t 4 4"]) -> None:
    """Checks that the 3x3 block of every pose is a rotation.

    **Raises:** `InputError` if one is not.
    """
    R = np.clip(T_WC[:, :3, :3], -10, 10)
    away = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2))
    wrong = (away > _ROTATION_TOLERANCE) | (np.linalg.det(R) < 0)
    if wrong.any():
        raise InputError(
            f"{file}: `T_WC` of frame {wrong.argmax()} has no rotation, expected "
            "poses of the camera."
        )


def read_groundtruth(path: Path, body: BodyModel) -> Result:
    """Reads a true camera trajectory, true bodies, or both, into one `Result`.

    `path` is a folder with `camera.txt` (TUM, camera to world) and `body.npz` (AMASS
    style; or `body_0.npz`, `body_1.npz` ... for several people), a sequence folder with
    such a `groundtruth/`, a run folder, or one such file. Bodies start at the camera's
    first timestamp. Bodies without joints are posed with `body`. Without a camera
    `summary["has_camera"]` is false; without bodies there are no people.

    **Raises:** `InputError`, naming the file, what was found and
    what was expected.
    """
    if not path.exists():
        raise InputError(f"{path}: no such ground truth.")
    if path.is_dir():
        if (path / "groundtruth").is_dir():
            path = path / "groundtruth"
        elif (path / "result.npz").exists():
            return read_result(path)
        cameras = [p for n in ("camera.txt", "camera.tum") if (p := path / n).exists()]
        bodies = sorted(path.glob("body.npz")) or sorted(path.glob("body_*.npz"))
        landmarks = path / "landmarks.npy"
    elif path.suffix == ".npz":
        if "T_WC" in read_npz(path):
            return read_result(path)
        cameras, bodies, landmarks = [], [path], None
    else:
        cameras, bodies, landmarks = [path], [], None
    if not cameras and not bodies:
        raise InputError(f"{path}: neither camera.txt nor body.npz in this folder.")
    people = [read_body(file, body) for file in bodies]
    camera = read_tum(cameras[0]) if cameras else None
    times, T_WC = _timeline(camera, people)
    if camera is not None:
        for file, person in zip(bodies, people, strict=True):
            _warn_of_rest(file, person, times)
    placed = [_at(person, times, camera is not None) for person in people]
    stack = lambda name, *shape: np.reshape(
        [person[name] for person in placed], (len(placed), *shape)
    )
    return Result(
        timestamps=times,
        T_WC=T_WC,
        scale=1.0,
        intrinsics=np.ones(4),
        landmarks=_landmarks(landmarks),
        poses=stack("poses", len(times), 72).astype(float),
        trans=stack("trans", len(times), 3).astype(float),
        betas=stack("betas", 10).astype(float),
        joints=stack("joints", len(times), 24, 3).astype(float),
        present=stack("present", len(times)).astype(bool),
        summary={"input": str(path), "has_camera": camera is not None},
    )


def _timeline(
    camera: tuple[np.ndarray, np.ndarray] | None, people: list[dict[str, Any]]
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the timestamps (s) of the denser of camera and bodies, and the camera's
    poses at these."""
    longest = max(people, key=lambda p: len(p["poses"]), default=None)
    if camera is None:
        assert longest is not None
        times = np.arange(len(longest["poses"])) / longest["fps"]
        return times, np.tile(np.eye(4), (len(times), 1, 1))
    times, T_WC = camera
    if longest is None or len(longest["poses"]) <= len(times):
        return times, T_WC
    at = times[0] + np.arange(len(longest["poses"])) / longest["fps"]
    between = bracket(times, at)
    available = between.available
    return at[available], interpolate_poses(T_WC, between)[available]


def _warn_of_rest(file: Path, person: dict[str, Any], times: np.ndarray) -> None:
    """Warns of bodies after the last true camera, which are dropped."""
    num, fps = len(person["poses"]), person["fps"]
    beyond = times[0] + (num - 1) / fps - times[-1]
    if num != len(times) and beyond > 1.5 / fps:
        log.warning(
            "%s: %d frames, of which the last %d are after the last true camera and "
            "left out.",
            *(file, num, round(beyond * fps)),
        )


def _at(
    person: dict[str, Any], times: np.ndarray, has_camera: bool
) -> dict[str, np.ndarray]:
    """Resamples one person to the given timestamps (s)."""
    num, fps = len(person["poses"]), person["fps"]
    own = times[0] + np.arange(num) / fps
    if (
        has_camera
        and num == len(times) > 1
        and abs(np.median(np.diff(times)) * fps - 1) < 0.02
    ):
        own = times  # frame by frame, also if the camera's rate varies
    between = bracket(own, times)
    before, after, weight = between.before, between.after, between.weight
    w = weight[:, None]
    nearest = np.where(weight < 0.5, before, after)
    trans, joint, present = person["trans"], person["joints"], person["present"]
    # Between two frames, both must be known.
    known = (present[before] | (weight == 1)) & (present[after] | (weight == 0))
    return {
        "poses": person["poses"][nearest],
        "trans": (1 - w) * trans[before] + w * trans[after],
        "betas": person["betas"],
        "joints": (1 - w[..., None]) * joint[before] + w[..., None] * joint[after],
        "present": between.available & known,
    }


def read_body(path: Path, body: BodyModel) -> dict[str, Any]:
    """Reads a body in the style of AMASS; of SMPL-H poses the 22 body joints are kept,
    of betas the first 10.

    An optional `present` (t,) marks the frames in which the person is known. Joints are
    posed with `body` unless the file has them.

    **Raises:** `InputError` that names the file, and what was found and expected.
    """
    archive = read_npz(path, "a true body (.npz)")
    rate = next((n for n in _FRAME_RATE_KEYS if n in archive), _FRAME_RATE_KEYS[0])
    archive.require("poses", "trans", "betas", rate)
    poses, trans = archive.array("poses", ("t", None)), archive.array("trans", ("t", 3))
    betas = np.ravel(archive.array("betas"))
    fps = as_number(path, rate, archive.raw(rate), 1, 1000)
    num = len(poses)
    if num < 1 or poses.shape[1] < 66:
        raise InputError(
            f"{path}: poses {poses.shape}, trans {trans.shape}, not (t, 72), (t, 3)."
        )
    if poses.shape[1] != 72:
        poses = np.concatenate([poses[:, :66], np.zeros((num, 6))], 1)
    betas = np.pad(betas[:10], (0, max(0, 10 - len(betas))))
    if "joints" in archive:
        found = archive.array("joints", ("t", 24, 3))
    else:
        found = posed_joints(body, poses, betas, trans)
        # Extreme angles and shapes may overflow.
        found = as_array(path, "joints of its poses and betas", found)
    present = np.ones(num, bool)
    if "present" in archive:
        present = archive.array("present", ("t",), kind="boolean")
    return {
        "poses": poses,
        "trans": trans,
        "betas": betas,
        "joints": found,
        "present": present,
        "fps": fps,
    }


def posed_joints(
    body: BodyModel,
    poses: Float[np.ndarray, "t 72"],
    betas: Float[np.ndarray, " 10"],
    trans: Float[np.ndarray, "t 3"],
) -> Float[np.ndarray, "t 24 3"]:
    """Returns the joints of a posed body model, m.

    Frames are processed in padded chunks, so that one compilation serves all lengths.
    """
    found = []
    for start in range(0, len(poses), _CHUNK_FRAMES):
        part = slice(start, start + _CHUNK_FRAMES)
        missing = _CHUNK_FRAMES - len(poses[part])
        pose, place = (np.pad(x[part], ((0, missing), (0, 0))) for x in (poses, trans))
        as_body = [jnp.asarray(x, body.dtype) for x in (pose, betas, place)]
        posed = np.asarray(_joints(body, *as_body), np.float64)
        found.append(posed[: _CHUNK_FRAMES - missing])
    return np.concatenate(found)


_CHUNK_FRAMES = 256
_joints = eqx.filter_jit(joints)
_FRAME_RATE_KEYS = ("mocap_framerate", "mocap_frame_rate")


def _landmarks(path: Path | None) -> np.ndarray:
    if path is None or not path.exists():
        return np.zeros((0, 3))
    return as_array(path, "landmarks", read_npy(path), (None, 3))


def body_of_run(result: Result) -> BodyModel:
    """Returns the body model of this machine, if the result was estimated with it.

    The file that `settings.body_model` of the summary names is not opened: a run folder
    is untrusted and may name any file.

    **Raises:** `InputError`, one line that asks for `--body-model`, if the result has
    another body model.
    """
    body = load_body_model()
    check_body(result, body)
    return body


def check_body(result: Result, body: BodyModel) -> None:
    """Checks that the joints of each person, in two frames, are those of `body`.

    **Raises:** `InputError` if `body` is not the body model of the result.
    """
    for h, there in enumerate(result.present):
        if not there.any():
            continue
        k = np.flatnonzero(there)[[0, -1]]
        cast = lambda x: jnp.asarray(x, body.dtype)
        posed = joints(
            body, *map(cast, (result.poses[h, k], result.betas[h], result.trans[h, k]))
        )
        away = np.linalg.norm(np.asarray(posed) - result.joints[h, k], axis=-1).max()
        if not away < _MAX_OFFSET_M:
            raise InputError(
                f"body model {body.name}: its joints are {100 * away:.0f} cm off the "
                f"run's, expected the body model of the run{_named(result)}; give it "
                "by --body-model."
            )


def _named(result: Result) -> str:
    """Returns text on the body model that the summary names, which may be anything."""
    settings = result.summary.get("settings")
    named = settings.get("body_model") if isinstance(settings, dict) else None
    if not isinstance(named, str):
        return ""
    return f" ({named[:200]!r}, which is not opened unless it is given)"


def read_summary(file: Path) -> dict[str, Any]:
    """Reads a `summary.json` and checks the types of the entries that readers use.

    **Raises:** `InputError`, one line that names the file, the place, what was found
    and what was expected.
    """
    found = files.read_json(file, "the summary of a run")
    if not isinstance(found, dict):
        raise InputError(f"{file}: {type(found).__name__}, expected an object.")
    for name, form in _SCHEMA.items():
        if wrong := _misfit(name, found.get(name), form):
            raise InputError(f"{file}: {wrong}.")
    return found


def _misfit(place: str, value: Any, form: Any) -> str:
    """Returns the error message for a value that does not fit the schema, or "" if it
    does."""
    if value is None:
        return ""
    if isinstance(form, tuple):
        wrong = [_misfit(place, value, one) for one in form]
        return "" if "" in wrong else wrong[-1]
    if isinstance(form, Mapping):
        if not isinstance(value, dict):
            return _wrong(place, value, "an object")
        named = dict(form)
        if "*" in named:
            named = dict.fromkeys(value, named["*"])
        parts = ((f"{place}.{n}", value.get(n), one) for n, one in named.items())
        return next(filter(None, (_misfit(*part) for part in parts)), "")
    if isinstance(form, Sequence):
        if not isinstance(value, list):
            return _wrong(place, value, "a list")
        if form and None in value:
            return _wrong(f"{place}[{value.index(None)}]", None, "no null")
        parts = (
            (f"{place}[{k}]", item, form[0]) for k, item in enumerate(value) if form
        )
        return next(filter(None, (_misfit(*part) for part in parts)), "")
    if form is str:
        fits = isinstance(value, str) and len(value) <= _MAX_LETTERS
        return (
            ""
            if fits
            else _wrong(place, value, f"text of at most {_MAX_LETTERS} letters")
        )
    if form is bool:
        return "" if isinstance(value, bool) else _wrong(place, value, "true or false")
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not is_number or not abs(value) < _MAX_NUMBER or not math.isfinite(value):
        return _wrong(place, value, "a number")
    if form is int and value != int(value):
        return _wrong(place, value, "a whole number")
    return ""


def _wrong(place: str, value: Any, expected: str) -> str:
    """Returns the error message for a value, which may be of any size."""
    kinds = {dict: "an object", list: "a list", bool: "true or false"}
    found = kinds.get(type(value))
    if found is None:
        large = isinstance(value, int) and abs(value) >= _MAX_NUMBER
        found = "a number of many digits" if large else repr(value)[:80]
    return f"{place[:80]} is {found}, expected {expected}"
