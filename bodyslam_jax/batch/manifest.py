"""Reads a manifest: a table (`.csv`) of clips, checked completely before anything runs.

Columns: `video` (a video, a folder of images or a sequence folder), and where needed
`name`, `keypoints`, `bodies`, `camera`, `height`, `groundtruth`, `options`. Paths are
relative to the manifest's folder. `options` are those of `bodyslam run`.
"""

import csv
import difflib
import io
import os
from collections.abc import Iterator
from pathlib import Path

from bodyslam_jax.batch.inputs import Input, safe_name, wrong_name
from bodyslam_jax.config import Config, with_options
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io.camera.calibration import read_camera, split_camera_name
from bodyslam_jax.io.camera.calibration_files import read_named_cameras
from bodyslam_jax.io.files import read_text
from bodyslam_jax.io.parts import find_parts
from bodyslam_jax.io.video import VIDEO_SUFFIXES

COLUMNS = (
    *("name", "video", "keypoints", "bodies", "camera"),
    *("height", "groundtruth", "options"),
)
_TRUTH_FILES = ("camera.txt", "camera.tum", "body.npz", "body_*.npz", "result.npz")
_TRUTH_FOLDERS = ("", "groundtruth/")

Row = dict[str, str]


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
