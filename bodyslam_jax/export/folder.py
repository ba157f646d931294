"""Writes the run folder: every file of the contract, all of them or none.

Files are written into a hidden folder inside the run folder and moved out together,
`summary.json` last. A folder without `summary.json` is not a finished run.
"""

import contextlib
import dataclasses
import errno
import json
import math
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import trimesh
import yaml
from jaxtyping import Float, Int

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic, files, write_body, write_tum
from bodyslam_jax.types import Result

_SUMMARY_FILE = "summary.json"
_RUN_FILES = (
    "result.npz",
    "camera.tum",
    "body_*.npz",
    "landmarks.ply",
    _SUMMARY_FILE,
    "config.yaml",
)
_RUN_FILES += ("report.html", "overlay.webm", "overlay.mp4", "scene.html")


def check_folder(
    folder: Path,
    source: dict[str, Any] | None = None,
    begun_for: dict[str, Any] | None = None,
) -> None:
    """Checks, before anything is computed, that a run could be written to the folder.

    Args:
        source: the input of the run, with the keys of `input` in `summary.json`.
        begun_for: the input of an unfinished run in `folder`.

    **Raises:** `InputError` naming the folder and what is wrong with it: not writable,
    a full disk, files that are not of a run, or the run of another input.
    """
    owner = begun_for or _finished_for(folder)
    if owner is None:
        theirs = sorted(file.name for p in _RUN_FILES for file in folder.glob(p))
        if theirs:
            raise InputError(
                f"{folder}: has {', '.join(theirs[:3])}, but is not the folder of a "
                "run; give another folder."
            )
    elif source and (differ := [k for k in source if owner.get(k) != source[k]]):
        was = ", ".join(f"{k} {owner.get(k)}" for k in differ)
        now = ", ".join(f"{k} {source[k]}" for k in differ)
        raise InputError(
            f"{folder}: is the run of another input ({was}, not {now}); give another "
            "folder, or delete this one."
        )
    with _partial(folder) as partial:
        (partial / _SUMMARY_FILE).write_text("{}")


def _finished_for(folder: Path) -> dict[str, Any] | None:
    """Returns the input of the finished run in a folder, `None` if there is none."""
    try:
        found = files.read_json(folder / _SUMMARY_FILE)["input"]
    except (InputError, LookupError, TypeError):
        return None
    return found if isinstance(found, dict) else None


@contextlib.contextmanager
def run_folder(folder: Path) -> Iterator[Path]:
    """Yields a hidden folder whose files are moved to `folder` when the block succeeds.

    Files of an earlier run are then removed, others (the stage cache) are kept. If the
    block raises, what it wrote is deleted and `folder` is unchanged.

    **Raises:** `InputError` if the folder cannot be written or the disk is full.
    """
    with _partial(folder) as partial:
        yield partial
        (folder / _SUMMARY_FILE).unlink(missing_ok=True)
        for pattern in _RUN_FILES:
            for old in folder.glob(pattern):
                old.unlink()
        written = sorted(partial.iterdir(), key=lambda file: file.name == _SUMMARY_FILE)
        for file in written:
            os.replace(file, folder / file.name)


@contextlib.contextmanager
def _partial(folder: Path) -> Iterator[Path]:
    """Yields a temporary hidden folder in `folder`; a created `folder` is removed if
    empty."""
    try:
        with atomic.hidden_folder(folder) as partial:
            yield partial
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            reason = "the disk is full"
        elif error.errno in _NOT_WRITABLE_ERRNOS and str(folder) in str(error.filename):
            reason = f"cannot be written ({os.strerror(error.errno or 0)})"
        else:
            raise
        raise InputError(f"{folder}: {reason}; give a writable folder.") from error


_NOT_WRITABLE_ERRNOS = (
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
    errno.ENOTDIR,
    errno.EEXIST,
    errno.ENAMETOOLONG,
)


def clear_run(folder: Path) -> None:
    """Removes a run's files and stage results, `summary.json` first; keeps other
    files."""
    (folder / _SUMMARY_FILE).unlink(missing_ok=True)
    for pattern in _RUN_FILES:
        for file in folder.glob(pattern):
            file.unlink()
    shutil.rmtree(folder / ".cache", ignore_errors=True)


def clear_partial(folder: Path) -> None:
    """Removes incomplete files of killed processes; the caller must hold the lock."""
    for partial in folder.glob(".partial-*"):
        shutil.rmtree(partial, ignore_errors=True)
    for file in folder.glob(".cache/.*.partial*"):
        file.unlink(missing_ok=True)


def write_run(folder: Path, result: Result, config: Any = None) -> None:
    """Writes the files of the contract that programs read; all or none.

    `config` are the resolved settings, a dataclass or a dictionary. To add report,
    overlay and scene, use `run_folder` and `write_files`.
    """
    with run_folder(folder) as partial:
        write_files(partial, result, config)


def write_files(folder: Path, result: Result, config: Any = None) -> None:
    """Writes the files of `write_run` into an existing folder, one by one."""
    arrays = {
        field.name: np.asarray(getattr(result, field.name))
        for field in dataclasses.fields(result)
        if field.name != "summary" and getattr(result, field.name) is not None
    }
    statuses = [p.get("status") for p in result.summary.get("people") or []]
    if statuses and None not in statuses:
        arrays["person_status"] = np.array(statuses, dtype="U14")
    atomic.write_npz(folder / "result.npz", arrays)
    located = result.located
    write_tum(folder / "camera.tum", result.timestamps[located], result.T_WC[located])
    for h in range(len(result.poses)):
        write_body(
            folder / f"body_{h}.npz",
            result.poses[h],
            result.trans[h],
            result.betas[h],
            fps=result.fps,
            joints=result.joints[h],
            present=result.present[h],
            timestamps=result.timestamps,
        )
    write_points(folder / "landmarks.ply", result.landmarks)
    (folder / "config.yaml").write_text(to_yaml(config))
    (folder / _SUMMARY_FILE).write_text(
        json.dumps(plain(result.summary), indent=2) + "\n"
    )


def write_points(path: Path, points: Float[np.ndarray, "l 3"]) -> None:
    """Writes points as binary PLY, m."""
    if len(points):
        trimesh.PointCloud(points).export(path, file_type="ply")
        return
    # trimesh refuses an empty cloud, but an empty map is a valid result.
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    path.write_text(
        f"ply\nformat ascii 1.0\nelement vertex 0\n{properties}end_header\n"
    )


def write_mesh(
    path: Path, vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"]
) -> None:
    """Writes one mesh, m; the suffix is `.glb`, `.obj`, `.ply` or `.stl`.

    **Raises:** `InputError` for another suffix.
    """
    suffixes = (".glb", ".obj", ".ply", ".stl")
    if path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: suffix {path.suffix!r}, not one of {suffixes}.")
    trimesh.Trimesh(vertices, faces, process=False).export(path)


def to_yaml(config: Any) -> str:
    """Returns settings (dataclass or dictionary) as YAML."""
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        config = dataclasses.asdict(config)
    return yaml.safe_dump(plain(config or {}), sort_keys=False)


def plain(value: Any) -> Any:
    """Converts a value to types of JSON and YAML: arrays to lists, paths to text, NaN
    to null."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray | jnp.ndarray):
        return plain(np.asarray(value).tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return str(value)
