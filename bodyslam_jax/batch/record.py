"""Reads and writes the record in a run folder that identifies a finished job.

It has hashes of the input's content and of settings, models and the package's source,
and a stamp: a hash of the names, sizes and dates of the input's files. If the stamp is
unchanged, the content is not read again.
"""

import contextlib
import functools
import hashlib
import json
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bodyslam_jax.batch.inputs import Input
from bodyslam_jax.config import Config
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic, files
from bodyslam_jax.io.camera.calibration import split_camera_name
from bodyslam_jax.io.parts import find_parts
from bodyslam_jax.pipeline.stage_cache import body_model_file, fingerprint

log = logging.getLogger(__name__)
_RECORD_FILE = ".job.json"
_SUMMARY_FILE = "summary.json"
_TEXT_FIELDS = ("source", "settings", "stamp", "status", "message", "summary")
"""Fields of the record of a finished run, all of them text."""
STATUSES = ("ok", "doubtful", "failed")
"""Statuses of a run that left a result."""


def read(out: Path) -> dict[str, Any] | None:
    """Reads the record of a finished run; `None` if there is none, or the summary has
    changed since."""
    record = _load(out)
    try:
        is_kept = record.get("summary") == _hash_of(out / _SUMMARY_FILE)
    except OSError:
        return None
    if not is_kept:
        return None
    texts = all(isinstance(record.get(name), str) for name in _TEXT_FIELDS)
    if not texts or record["status"] not in STATUSES:
        log.warning(
            "%s: not the record of a run; the clip is run again", out / _RECORD_FILE
        )
        return None
    return {name: record[name] for name in _TEXT_FIELDS}


def is_begun(out: Path) -> bool:
    """Returns whether a folder is that of a job."""
    return (out / _RECORD_FILE).is_file()


def finish(out: Path, record: dict[str, Any]) -> None:
    """Records that the run in `out` is finished."""
    record = record | {"summary": _hash_of(out / _SUMMARY_FILE)}
    atomic.write_text(out / _RECORD_FILE, json.dumps(record))


@contextlib.contextmanager
def begun(out: Path, source: str) -> Iterator[None]:
    """Records the input of a run before it is finished. If the run fails and leaves
    nothing else, the folder is removed."""
    if _load(out).get("source") != source:
        out.mkdir(exist_ok=True)
        atomic.write_text(out / _RECORD_FILE, json.dumps({"source": source}))
    try:
        yield
    except Exception:
        if [entry.name for entry in out.iterdir()] == [_RECORD_FILE]:
            (out / _RECORD_FILE).unlink(missing_ok=True)
            with contextlib.suppress(OSError):
                out.rmdir()
        raise


def begun_for(out: Path) -> str | None:
    """Returns the hash of the input of the run in `out`; `None` if there is none."""
    source = _load(out).get("source")
    return source if isinstance(source, str) else None


def source_hash(source: Input, config: Config) -> str:
    """Returns the hash of the content of the input's files, and of its name."""
    return fingerprint(source.name, _files(source, config))


@functools.lru_cache(maxsize=256)
def settings_hash(config: Config) -> str:
    """Returns the hash of settings, models and the package's source."""
    return fingerprint(config, body_model_file(config.body_model))


def stamp(source: Input, config: Config) -> str:
    """Returns the hash of names, sizes and dates of the input's files."""
    digest = hashlib.sha256()
    for path in _files(source, config):
        for file in sorted(path.rglob("*")) if path.is_dir() else [path]:
            if file.is_file() and not file.name.startswith("."):
                state = file.stat()
                text = f"{file.name} {state.st_size} {state.st_mtime_ns}\n"
                digest.update(text.encode())
    return digest.hexdigest()[:16]


def _files(source: Input, config: Config) -> list[Path]:
    """Returns the files and folders that a job reads, except models."""
    parts = find_parts(source.path)
    camera = source.camera or parts.camera
    if camera is not None:
        camera, _ = split_camera_name(camera)
    found = [
        parts.footage,
        source.keypoints or parts.keypoints,
        source.bodies or parts.bodies,
        camera,
        parts.tracks,
        parts.masks,
        source.groundtruth or parts.groundtruth,
    ]
    if config.camera_path is not None:
        found.append(Path(config.camera_path))
    return [path for path in found if path is not None]


def _load(out: Path) -> dict[str, Any]:
    if not (out / _RECORD_FILE).exists():
        return {}
    try:
        found = files.read_json(out / _RECORD_FILE, "the record of a run")
    except InputError as error:
        log.warning("%s The clip is run again.", error)
        return {}
    return found if isinstance(found, dict) else {}


def _hash_of(file: Path) -> str:
    if not file.is_file():  # reading a pipe would block
        raise FileNotFoundError(file)
    with file.open("rb") as opened:
        return hashlib.file_digest(opened, "sha256").hexdigest()[:16]
