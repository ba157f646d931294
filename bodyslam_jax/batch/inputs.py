"""Finds the inputs of a batch: folders, globs, files and manifests become named
inputs."""

import dataclasses
import glob
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from bodyslam_jax.config import Config, with_options
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.parts import find_parts
from bodyslam_jax.io.video import VIDEO_SUFFIXES

BATCH_FILE = "batch.json"
"""File that marks the folder of a batch."""
RUNS_FOLDER = "runs"
"""Folder with the run folders of a batch, separate from the batch's own files, so that
clips may have any name."""
_MAX_NAME_LETTERS = 120
"""Maximal length of names; file systems allow 255 bytes including all suffixes."""
_SUMMARY_FILE = "summary.json"


@dataclasses.dataclass(frozen=True)
class Input:
    """A clip with its accompanying files and options."""

    name: str
    """Name of its run folder; unique in a batch."""
    path: Path
    """Sequence folder, video file or folder of images."""
    keypoints: Path | None = None
    bodies: Path | None = None
    camera: Path | None = None
    groundtruth: Path | None = None
    options: str = ""
    """Settings of this clip alone, as on the command line."""

    def settings(self, config: Config) -> Config:
        """Returns the settings of this clip: `config` with its options applied.

        **Raises:** `InputError` for options that do not exist.
        """
        return with_options(config, self.options) if self.options else config


def find_inputs(
    sources: Iterable[str | Path] | str | Path, config: Config = Config()
) -> list[Input]:
    """Returns all clips of the sources in order, each with a unique name.

    A source is a sequence folder, a video, a folder of images, a folder of such, a glob
    pattern of such, or a manifest (`.csv`). Run folders and folders of batches are left
    out. Clips of the same name get the name of their folder in front.

    **Raises:** `InputError` if a source does not exist or has no clips, or if the
    manifest has mistakes: a line for each.
    """
    from bodyslam_jax.batch.manifest import read_manifest

    if isinstance(sources, (str, Path)):
        sources = [sources]
    found: list[Input] = []
    for source in sources:
        for path in _matching(source):
            if path.suffix.lower() == ".csv":
                found += read_manifest(path, config)
            else:
                found += [Input(safe_name(p), p) for p in _clips(path)]
    if not found:
        raise InputError("no inputs: expected folders, videos or a manifest (.csv).")
    return _distinct(found)


def shard(inputs: Sequence[Input], which: str) -> list[Input]:
    """Returns part `I/N` of the inputs, I from 1: every N-th input, so that parts are
    similar.

    **Raises:** `InputError` if it is no such part.
    """
    match = re.fullmatch(r"(\d+)/(\d+)", which)
    part, parts = map(int, match.groups()) if match else (0, 0)
    if not 1 <= part <= parts:
        raise InputError(f"--shard {which}: expected I/N with I from 1 to N, as 2/8.")
    return list(inputs[part - 1 :: parts])


def safe_name(path: Path) -> str:
    """Returns the name of a run folder for this input."""
    name = path.resolve().name if path.is_dir() else path.stem
    name = re.sub(r"[^\w.+-]+", "_", name).strip("._") or "clip"
    return name[:_MAX_NAME_LETTERS]


def wrong_name(name: str) -> str | None:
    """Returns what is wrong with the name of a run folder; `None` if nothing is."""
    if not re.fullmatch(r"[\w.+ -]+", name) or name.startswith("."):
        return f"{name!r}, expected letters, digits, _ - + . and spaces"
    if len(name) > _MAX_NAME_LETTERS:
        return f"{len(name)} letters, expected at most {_MAX_NAME_LETTERS}"
    return None


def is_file_name(name: str) -> bool:
    """Returns whether a name that was read from a file is a valid name of a folder,
    without a path."""
    size = len(name.encode(errors="replace"))
    signs = "/\\" if os.name == "nt" else "/"
    plain = name.isprintable() or not any(sign in name for sign in "\0\n\r")
    return (
        0 < size <= 240
        and plain
        and name not in (".", "..")
        and not (set(signs) & set(name))
    )


def _matching(source: str | Path) -> list[Path]:
    path = Path(source)
    if path.exists():
        return [path]
    if any(letter in str(source) for letter in "*?["):
        found = [Path(p) for p in sorted(glob.glob(str(source), recursive=True))]
        clips = [p for p in found if p.is_dir() or _is_video(p) or p.suffix == ".csv"]
        if clips:
            return clips
        raise InputError(f"{source}: matches no folder, video or manifest.")
    raise InputError(f"{source}: no such file or folder.")


def _clips(path: Path) -> list[Path]:
    """Returns the clip at a path, or those in the folder at that path."""
    if path.is_file() or _is_clip(path):
        return [path]
    children = sorted(p for p in path.iterdir() if not p.name.startswith("."))
    children = [] if _is_result(path) else children
    found = [p for p in children if (p.is_dir() and _is_clip(p)) or _is_video(p)]
    if not found:
        raise InputError(
            f"{path}: no clip, nor a folder of clips: expected videos or sequence "
            "folders in it."
        )
    return found


def _is_result(folder: Path) -> bool:
    return (folder / BATCH_FILE).exists() or (folder / _SUMMARY_FILE).exists()


def _is_clip(folder: Path) -> bool:
    if _is_result(folder):
        return False
    try:
        parts = find_parts(folder)
    except ValueError:  # several videos
        return False
    if parts.footage is None or parts.tracks is not None:
        return parts.tracks is not None
    known = (parts.keypoints, parts.bodies, parts.camera, parts.groundtruth)
    # A lone video of another name, without other files, is a clip in a folder of clips.
    loose = parts.footage.is_file() and parts.footage.stem.lower() != "video"
    return not loose or any(part is not None for part in known)


def _is_video(path: Path) -> bool:
    return path.suffix.lower() in VIDEO_SUFFIXES and path.is_file()


def _distinct(inputs: list[Input]) -> list[Input]:
    """Returns the inputs with distinct names, also for file systems that ignore
    case."""
    shared = _repeated(one.name for one in inputs)
    longer = []
    for one in inputs:
        if one.name.lower() in shared:
            parent = safe_name(one.path.resolve().parent)
            one = dataclasses.replace(one, name=f"{parent}-{one.name}")
        longer.append(one)
    taken: set[str] = set()
    found = []
    for one in longer:
        name, number = one.name, 1
        while name.lower() in taken:
            number += 1
            name = f"{one.name}-{number}"
        taken.add(name.lower())
        found.append(dataclasses.replace(one, name=name))
    return found


def _repeated(names: Iterable[str]) -> set[str]:
    seen: set[str] = set()
    return {n for n in map(str.lower, names) if n in seen or seen.add(n)}
