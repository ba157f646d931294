"""Finds the inputs of a batch: folders, globs, files and manifests become named
inputs.

A manifest is a table (`.csv`) of clips, checked completely before anything runs.
Columns: `video` (a video, a folder of images or a sequence folder), and where needed
`name`, `keypoints`, `bodies`, `camera`, `height`, `groundtruth`, `options`. Paths are
relative to the manifest's folder. `options` are those of `bodyslam run`.
"""

import csv
import dataclasses
import difflib
import glob
import io
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from bodyslam_jax.config import Config, with_options
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.camera.calibration import read_camera, split_camera_name
from bodyslam_jax.io.camera.calibration_files import read_named_cameras
from bodyslam_jax.io.files import read_text
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
COLUMNS = (
    *("name", "video", "keypoints", "bodies", "camera"),
    *("height", "groundtruth", "options"),
)
_TRUTH_FILES = ("camera.txt", "camera.tum", "body.npz", "body_*.npz", "result.npz")
_TRUTH_FOLDERS = ("", "groundtruth/")
Row = dict[str, str]


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
        # File systems allow 255 bytes, and suffixes follow.
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


def read_manifest(path: Path, config: Config = Config()) -> list[Input]:
    """Returns the inputs that a manifest lists.

    **Raises:** `InputError` with a line for each mistake: file, line, column, what was
    found, what was expected.
    """
    header, lines = _table(path)
    mistakes = [f"{path}:1: {text}" for text in _wrong_header(header)]
    if mistakes:
        raise InputError(*mistakes)
    found: list[Input] = []
    first: dict[str, int] = {}
    for number, cells in lines:
        wrong: list[str] = []
        if len(cells) != len(header):
            wrong.append(f"{len(cells)} cells, expected {len(header)} as in the header")
        else:
            row = dict(zip(header, (cell.strip() for cell in cells), strict=True))
            one, wrong = _input(row, path.parent, config)
            earlier = first.setdefault(one.name.lower(), number)
            if earlier != number:
                wrong.append(f"name: {one.name!r} is that of line {earlier}")
            found.append(one)
        mistakes += [f"{path}:{number}: {text}." for text in wrong]
    if not lines:
        mistakes.append(f"{path}: no lines below the header.")
    if mistakes:
        raise InputError(*mistakes)
    return found


def _table(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Returns the header, and the other lines with their numbers; empty lines are left
    out."""
    text = read_text(path, "a manifest (CSV)")
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    rows: list[tuple[int, list[str]]] = []
    try:
        start = 1
        for cells in reader:
            if any(cell.strip() for cell in cells):
                rows.append((start, cells))
            start = reader.line_num + 1
    except csv.Error as error:
        raise InputError(f"{path}:{reader.line_num}: not CSV ({error}).") from None
    if not rows:
        raise InputError(f"{path}: empty, expected a header with the column video.")
    (_, header), *lines = rows
    return [cell.strip().lower() for cell in header], lines


def _wrong_header(header: list[str]) -> Iterator[str]:
    if len(header) == 1 and any(sign in header[0] for sign in ";\t"):
        sign = ";" if ";" in header[0] else "tab"
        yield f"columns separated by {sign}, expected commas."
        return
    for name in header:
        if name not in COLUMNS:
            close = difflib.get_close_matches(name, COLUMNS, n=1)
            hint = f"did you mean {close[0]}?" if close else f"{', '.join(COLUMNS)}."
            yield f"no column {name!r}; " + (hint if close else f"expected {hint}")
    for name in COLUMNS:
        if header.count(name) > 1:
            yield f"column {name} appears {header.count(name)} times."
    if "video" not in header:
        yield "no column video, which every manifest needs."


def _input(row: Row, home: Path, config: Config) -> tuple[Input, list[str]]:
    """Returns the input of a line, and what is wrong with it."""
    wrong: list[str] = []
    at = lambda column: home / row[column] if row.get(column) else None
    video = at("video")
    if video is None:
        wrong.append("video: empty")
        video = home
    else:
        wrong += _told("video", _wrong_video(video))
    name = row.get("name") or safe_name(video)
    if mistake := wrong_name(name):
        wrong.append(f"name: {mistake}")
    camera = at("camera")
    wrong += _told("keypoints", _wrong_file("keypoints", at("keypoints"), folder=True))
    wrong += _told("bodies", _wrong_file("bodies", at("bodies")))
    wrong += _told("camera", _wrong_camera(camera))
    if camera is not None and camera.suffix == ".json" and os.path.isfile(camera):
        try:
            # A calibration without an image size is checked with its video.
            if read_named_cameras(camera) is None:
                read_camera(camera, None)
        except ValueError as error:
            wrong.append(f"camera: {error}".rstrip("."))
    truth = at("groundtruth")
    wrong += _told("groundtruth", _wrong_truth(truth))
    options = row.get("options", "")
    if row.get("height"):
        options = f"--height {row['height']} {options}".strip()
    try:
        with_options(config, options)
    except ValueError as error:
        column = "height" if str(error).startswith("height:") else "options"
        wrong.append(f"{column}: {str(error).removeprefix(f'{column}: ').rstrip('.')}")
    one = Input(name, video, at("keypoints"), at("bodies"), camera, truth, options)
    return one, wrong


def _told(column: str, wrong: Iterator[str]) -> list[str]:
    """Returns what is wrong with a path, including errors of the file system."""
    try:
        return list(wrong)
    except (OSError, ValueError) as error:
        return [f"{column}: {getattr(error, 'strerror', None) or error}"]


def _wrong_video(path: Path) -> Iterator[str]:
    if not path.exists():
        yield f"video: {path}: no such file or folder"
    elif path.is_dir():
        try:
            parts = find_parts(path)
        except (ValueError, OSError) as error:
            yield f"video: {str(error).rstrip('.')}"
            return
        if parts.footage is None and parts.tracks is None:
            yield f"video: {path}: a folder without a video, images or tracks.npz"
    elif path.suffix.lower() not in VIDEO_SUFFIXES:
        yield f"video: {path}: {path.suffix or 'no suffix'}, expected that of a video"
    else:
        yield from _wrong_file("video", path)


def _wrong_file(column: str, path: Path | None, folder: bool = False) -> Iterator[str]:
    if path is None:
        return
    if not path.exists():
        yield f"{column}: {path}: no such file" + (" or folder" if folder else "")
    elif path.is_dir():
        if not folder:
            yield f"{column}: {path}: a folder, expected a file"
        elif not any(path.iterdir()):
            yield f"{column}: {path}: an empty folder"
    elif path.stat().st_size == 0:
        yield f"{column}: {path}: an empty file"
    elif not os.access(path, os.R_OK):
        yield f"{column}: {path}: cannot be read"


def _wrong_camera(path: Path | None) -> Iterator[str]:
    if path is not None:
        file, _ = split_camera_name(path)
        yield from _wrong_file("camera", file, folder=True)


def _wrong_truth(path: Path | None) -> Iterator[str]:
    if path is None:
        return
    yield from _wrong_file("groundtruth", path, folder=True)
    if path.is_dir() and not any(
        any(path.glob(f"{within}{name}"))
        for name in _TRUTH_FILES
        for within in _TRUTH_FOLDERS
    ):
        yield f"groundtruth: {path}: neither camera.txt nor body.npz in this folder"
