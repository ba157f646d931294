"""Exports a result to files of other programs; all files appear complete or not at
all."""

import dataclasses
import importlib
import json
import logging
import os
import shutil
from collections.abc import Callable
from pathlib import Path

from bodyslam_jax import evaluation
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.export.formats.registry import FORMATS, Format
from bodyslam_jax.export.formats.scene import (
    Observations,
    Scene,
    Up,
    make_scene,
    of_people,
)
from bodyslam_jax.io import atomic
from bodyslam_jax.types import Result

log = logging.getLogger(__name__)

_MARKER_FILE = "bodyslam_export.json"
_MORE_SUFFIXES = {".usd": "usd", ".usda": "usd"}


def export(
    result: Result,
    path: Path,
    to: str | tuple[str, ...] | None = None,
    up: Up = "y",
    person: int | tuple[int, ...] | None = None,
    *,
    body: BodyModel | None = None,
    observations: Observations | None = None,
    video: Path | None = None,
) -> list[Path]:
    """Writes a result in one or more formats, and returns the files and folders
    written.

    All files appear complete or not at all.

    Args:
        path: file, for one format, or an existing folder; for several formats, and for
            those that are folders (COLMAP, nerfstudio), a folder. Formats with one file
            per person get the person's number before the suffix if there are several
            people.
        to: names of `FORMATS`; by default the suffix of `path` decides.
        up: axis of the world that points up.
        person: number of the only person to write, or numbers of several; by default
            everybody.
        body: body model of the result; by default the one of this machine. A file that
            the result names is not opened.
        observations: observations of landmarks, for COLMAP (`read_observations`).
        video: video or folder of images, whose frames are written beside the files of
            COLMAP and nerfstudio.

    **Raises:** `InputError`, in one line, for unknown formats, missing extras, nobody
    to write, another body model, or a folder whose content is no earlier export.
    """
    names = _names(path, to)
    formats = [FORMATS[name] for name in names]
    writers = [_writer(format) for format in formats]
    several = len(formats) > 1
    if several and path.suffix in {f.suffix for f in FORMATS.values() if f.suffix}:
        raise InputError(
            f"{path}: a file, expected a folder for {len(formats)} formats."
        )
    if body is None:
        body = evaluation.body_of_run(result)
    scene = make_scene(result, body, up, person, observations, video)
    plain = scene if up == "y" else make_scene(result, body, "y", person, observations)
    inside = several or (path.is_dir() and bool(formats[0].suffix))
    jobs = []
    for format, write in zip(formats, writers, strict=True):
        if up == "z" and not format.turns:
            log.warning("%s: y is up in it by its specification.", format.name)
        base = path / format.file if inside else path
        for target, part in _parts(format, base, scene if format.turns else plain):
            _check_target(format, target)
            jobs.append((format, write, target, part))
    with atomic.hidden_folder(path if inside else path.parent) as partial:
        # Each in its own folder, with its final name, which some formats contain.
        places = [partial / str(k) / job[2].name for k, job in enumerate(jobs)]
        for place, (format, write, _, part) in zip(places, jobs, strict=True):
            place.parent.mkdir()
            write(place, part)
            if not format.suffix:
                (place / _MARKER_FILE).write_text(
                    json.dumps(_origin(format, part)) + "\n"
                )
        for place, (_, _, target, _) in zip(places, jobs, strict=True):
            _move(place, target)
    return [job[2] for job in jobs]


def _move(place: Path, target: Path) -> None:
    """Replaces files and folders of the same names; others in the folder of an earlier
    export are kept."""
    if not target.is_dir():
        os.replace(place, target)
        return
    for part in place.iterdir():
        if (target / part.name).is_dir():
            shutil.rmtree(target / part.name)
        os.replace(part, target / part.name)


def _origin(format: Format, scene: Scene) -> dict[str, str]:
    """Returns the content of the file that describes an exported folder, and
    distinguishes it from a user's own folder."""
    return {"format": format.name, "input": scene.name, "up": scene.up, "unit": "m"}


def _check_target(format: Format, target: Path) -> None:
    """Checks that nothing but an earlier export would be replaced.

    **Raises:** `InputError` otherwise.
    """
    if format.suffix and target.is_dir():
        raise InputError(f"{target}: a folder, expected a file ({format.suffix}).")
    if format.suffix or not target.exists():
        return
    if not target.is_dir():
        raise InputError(f"{target}: a file, expected a folder for {format.name}.")
    if any(target.iterdir()) and not (target / _MARKER_FILE).exists():
        raise InputError(
            f"{target}: has files in it that are no earlier export, expected a new "
            "folder; give another one."
        )


def _names(path: Path, to: str | tuple[str, ...] | None) -> tuple[str, ...]:
    if to is None:
        known = {f.suffix: f.name for f in FORMATS.values() if f.suffix}
        found = (known | _MORE_SUFFIXES).get(path.suffix.lower())
        if found is None:
            raise InputError(
                f"{path}: suffix {path.suffix!r} names no format, expected one of "
                f"{', '.join(known)}; or name the format (--to)."
            )
        return (found,)
    names = (to,) if isinstance(to, str) else tuple(dict.fromkeys(to))
    unknown = [name for name in names if name not in FORMATS]
    if unknown or not names:
        raise InputError(
            f"--to {' '.join(unknown)}: unknown, expected of {', '.join(FORMATS)}."
        )
    return names


def _writer(format: Format) -> Callable[[Path, Scene], None]:
    """Returns the function that writes the format.

    **Raises:** `InputError` that says how to install a missing extra.
    """
    module = importlib.import_module(format.module)
    if format.extra is not None and not module.is_installed():
        raise InputError(
            f"--to {format.name}: not installed, expected the extra `{format.extra}`; "
            f"pip install 'bodyslam-jax[{format.extra}]'."
        )
    return module.write


def _parts(format: Format, base: Path, scene: Scene) -> list[tuple[Path, Scene]]:
    """Returns the files of a format, each with the scene to write into it."""
    if not format.per_person:
        return [(base, scene)]
    if not scene.people:
        raise InputError(f"--to {format.name}: nobody is in this run, expected people.")
    found = []
    for k, number in enumerate(scene.people):
        one = of_people(scene.result, slice(k, k + 1))
        part = dataclasses.replace(scene, result=one, people=(number,))
        if "{}" in base.name:
            target = base.with_name(base.name.format(number))
        elif len(scene.people) == 1:
            target = base
        else:
            target = base.with_name(f"{base.stem}_{number}{base.suffix}")
        found.append((target, part))
    return found
