"""Keeps results of stages on disk, so that an interrupted run resumes.

A result is a dataclass of arrays and plain values, stored as an `.npz` whose name
contains a hash of all inputs: the sequence, the settings, the content of files that
they name, and the source of the package. If any of them changes, the stage is computed
again.
"""

import dataclasses
import functools
import hashlib
import json
import logging
import shutil
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import AbstractArray, jaxtyped

from bodyslam_jax.body import search_paths
from bodyslam_jax.config.errors import InputError, error_line
from bodyslam_jax.io import atomic, files
from bodyslam_jax.io.archive import read_npz

T = TypeVar("T")
log = logging.getLogger(__name__)
_HASHED_BYTES = 1 << 20
"""Number of bytes hashed at each end of a file."""
_SOURCE_FILE = "source.json"
"""File in the cache folder that describes the input."""
_CACHE_FOLDER = ".cache"
"""Name of the folder of stage results inside a run folder."""
_HEADER, _DIGEST = "__header__", "__sha256__"
"""Members of a stage file beside its arrays: its structure, and a hash of the
content."""
_NAN_FIELDS = ("shape_covariance",)
"""Fields whose arrays may contain NaN where nothing was computed."""
_FILE_SETTINGS = ("body_model", "motion_model", "motion")
"""Settings that name a file, whose content is hashed in place of its name."""


def fingerprint(*parts: Any) -> str:
    """Returns a hash of settings, arrays and files (by size and content of their ends).

    Files that settings name are hashed by content; the source of the package is
    included.
    """
    digest = hashlib.sha256(package_hash())
    for part in parts:
        _update(digest, part)
    return digest.hexdigest()[:16]


def body_model_file(setting: str | None) -> Path | None:
    """Returns the file or folder of the setting `body_model`.

    Without a setting it is the body model found on this machine, or `None` for the
    default body.
    """
    if setting is not None:
        return Path(setting)
    return next((path for path in search_paths() if path.is_file()), None)


@functools.cache
def package_hash() -> bytes:
    """Returns a hash of the source, models and motion files of the package."""
    root = Path(__file__).parents[1]
    digest = hashlib.sha256()
    kept = (
        path for suffix in ("py", "npz", "onnx") for path in root.rglob(f"*.{suffix}")
    )
    for path in sorted(kept):
        digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.digest()


def _update(digest: Any, part: Any) -> None:
    """Adds an array, file, folder, dataclass, sequence or plain value to a hash."""
    if isinstance(part, np.ndarray):
        digest.update(str((part.shape, part.dtype)).encode())
        digest.update(np.ascontiguousarray(part).tobytes())
    elif isinstance(part, Path):
        digest.update(str(part.name).encode())
        if part.is_dir():
            for item in sorted(part.iterdir()):
                # A run folder inside the input is not part of the input.
                run = item.is_dir() and (item / _CACHE_FOLDER).is_dir()
                if not item.name.startswith(".") and not run:
                    _update(digest, item)
        elif part.is_file():
            size = part.stat().st_size
            digest.update(str(size).encode())
            with part.open("rb") as file:
                digest.update(file.read(_HASHED_BYTES))
                file.seek(max(0, size - _HASHED_BYTES))
                digest.update(file.read(_HASHED_BYTES))
    elif dataclasses.is_dataclass(part) and not isinstance(part, type):
        digest.update(type(part).__name__.encode())
        for field in dataclasses.fields(part):
            digest.update(field.name.encode())
            value = getattr(part, field.name)
            if field.name in _FILE_SETTINGS and (
                value is None or isinstance(value, str)
            ):
                value = _named_file(field.name, value)
            _update(digest, value)
    elif isinstance(part, (tuple, list)):
        digest.update(str(len(part)).encode())
        for item in part:
            _update(digest, item)
    else:
        digest.update(repr(part).encode())


def _named_file(name: str, setting: str | None) -> Path | None:
    """Returns the file that a setting in `_FILE_SETTINGS` names; `None` for the
    default."""
    if name == "body_model":
        return body_model_file(setting)
    # The default belongs to the package, which `package_hash` covers.
    return None if setting is None else Path(setting)


@dataclasses.dataclass(frozen=True)
class Cache:
    """A folder of stage results; nothing is kept with `folder=None`."""

    folder: Path | None
    source: dict[str, Any] | None = None
    """Description of the input, stored beside the stages and returned by `owner`."""

    def stage(self, name: str, key: str, kind: type[T], compute: Callable[[], T]) -> T:
        """Returns the result of stage `name`, from disk if stored under the same
        `key`."""
        if self.folder is None:
            return compute()
        path = self.folder / f"{name}-{key}.npz"
        if path.exists():
            try:
                found = load(path, kind, sealed=True)
            except Exception as error:
                # Whatever the file contains, the stage can be computed again.
                reason = error_line(error).removeprefix(f"{path}: ").rstrip(".")
                log.warning("%s: not readable (%s); computed again", path, reason)
            else:
                log.info("%s: taken from an earlier run", name)
                return found
        result = compute()
        self.folder.mkdir(parents=True, exist_ok=True)
        if self.source is not None:
            (self.folder / _SOURCE_FILE).write_text(json.dumps(self.source))
        for old in self.folder.glob(f"{name}-*.npz"):
            if old.is_dir() and not old.is_symlink():
                shutil.rmtree(old, ignore_errors=True)
            else:
                old.unlink(missing_ok=True)  # another process may have removed it
        save(path, result)
        return result

    def owner(self) -> dict[str, Any] | None:
        """Returns the description of the input from which the results were computed.

        This is the `source` of the cache that wrote them; `None` if there is none.
        """
        if self.folder is None:
            return None
        try:
            found = files.read_json(self.folder / _SOURCE_FILE)
        except InputError:
            return None
        return found if isinstance(found, dict) else None


def save(path: Path, value: Any) -> None:
    """Writes a dataclass of arrays and plain values with their hash, atomically."""
    arrays: dict[str, np.ndarray] = {}
    header = _encode(value, "", arrays)
    arrays[_HEADER] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    digest = np.frombuffer(_digest(arrays), np.uint8)
    atomic.write_npz(path, {**arrays, _DIGEST: digest}, compressed=False)


def load(path: Path, kind: type[T], *, sealed: bool = False) -> T:
    """Reads what `save` wrote, and checks types, shapes and finiteness of every field.

    Args:
        sealed: True to reject files without a hash of their content, as written by
            earlier versions.

    **Raises:** `InputError` if the content was changed or if `kind` had other fields
    when it was saved; other exceptions for manipulated files.
    """
    archive = read_npz(path, "a stage of a run")
    arrays = {name: archive.raw(name) for name in archive.names}
    sealed = sealed or _DIGEST in arrays
    if sealed and arrays.pop(_DIGEST).tobytes() != _digest(arrays):
        raise InputError(f"{path}: its content is not what was written.")
    header = json.loads(arrays[_HEADER].tobytes())
    return _decode(header, kind, arrays)


def _digest(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Returns a hash of the arrays with names, types and shapes, independent of
    order."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(name.encode())
        _update(digest, arrays[name])
    return digest.digest()


def _encode(value: Any, prefix: str, arrays: dict[str, np.ndarray]) -> Any:
    """Returns the structure of a value for JSON, and moves its arrays to `arrays`."""
    if isinstance(value, np.ndarray):
        arrays[prefix or "value"] = value
        return {"array": prefix or "value"}
    if dataclasses.is_dataclass(value):
        return {
            "fields": {
                f.name: _encode(getattr(value, f.name), f"{prefix}.{f.name}", arrays)
                for f in dataclasses.fields(value)
            }
        }
    if isinstance(value, Path):
        return {"path": str(value)}
    if isinstance(value, tuple):
        items = [_encode(v, f"{prefix}.{i}", arrays) for i, v in enumerate(value)]
        return {"tuple": items}
    if isinstance(value, np.generic):
        value = value.item()
    return {"value": value}


def _decode(header: dict[str, Any], kind: Any, archive: Any) -> Any:
    """Inverts `_encode`, with checks of every field against its annotation."""
    if "array" in header:
        return archive[header["array"]]
    if "path" in header:
        return Path(header["path"])
    if "tuple" in header:
        return tuple(_decode(item, None, archive) for item in header["tuple"])
    if "fields" in header:
        fields = header["fields"]
        # A default of a new field may differ from what was computed, so it is no match.
        is_class = isinstance(kind, type) and dataclasses.is_dataclass(kind)
        if not is_class or fields.keys() != {f.name for f in dataclasses.fields(kind)}:
            raise InputError(f"fields {', '.join(fields)} of another version")
        kinds = typing.get_type_hints(kind)
        found = {n: _decode(h, _class(kinds[n]), archive) for n, h in fields.items()}
        with jaxtyped("context"):  # axes of one name have one length
            for name, value in found.items():
                _check_field(name, value, kinds[name])
        return kind(**found)
    return header["value"]


def _check_field(name: str, value: Any, annotation: Any) -> None:
    """**Raises:** `InputError` for a value of another type or shape, or not finite."""
    if not _fits(value, annotation):
        shape = f" {value.shape}" if isinstance(value, np.ndarray) else ""
        raise InputError(f"{name} is a {type(value).__name__}{shape}")
    is_real = isinstance(value, np.ndarray) and value.dtype.kind in "fc"
    if is_real and name not in _NAN_FIELDS and not np.isfinite(value).all():
        raise InputError(f"{name} is not finite")


def _fits(value: Any, annotation: Any) -> bool:
    """Returns True for a value of the annotated type; `jaxtyped` binds shapes."""
    options = typing.get_args(annotation)
    origin = typing.get_origin(annotation)
    if annotation is Any:
        return True
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, option) for option in options)
    if origin is tuple:
        if not isinstance(value, tuple):
            return False
        if options[-1] is Ellipsis:
            return all(_fits(item, options[0]) for item in value)
        return len(value) == len(options) and all(map(_fits, value, options))
    if annotation is float:
        return isinstance(value, (int, float)) and not isinstance(value, bool)
    if isinstance(annotation, type) and issubclass(annotation, AbstractArray):
        return isinstance(value, annotation)
    return isinstance(value, origin or annotation)


def _class(annotation: Any) -> Any:
    """Returns the dataclass in `Class | None`."""
    for option in (annotation, *typing.get_args(annotation)):
        if dataclasses.is_dataclass(option):
            return option
    return annotation
