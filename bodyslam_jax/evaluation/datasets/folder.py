"""Writes sequence folders atomically."""

import contextlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic, write_body, write_tum

FPS = 30.0
"""Frame rate of all three data sets, 1/s."""
_MARKER_FILE = "conversion.json"
"""File with the source of a converted sequence; a folder that has it may be
overwritten."""


@contextlib.contextmanager
def sequence_folder(out: Path, dataset: str, source: Path) -> Iterator[Path]:
    """Yields a hidden folder whose content is moved to `out` when the block succeeds.

    It replaces what an earlier conversion wrote; other files in `out` are kept. If the
    block raises, `out` is unchanged.

    **Raises:** `InputError` if `out` cannot be written, or has files of the same names
    that no conversion wrote.
    """
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: a file; expected a folder to write.")
    try:
        with atomic.hidden_folder(out.resolve().parent, ".conversion-") as partial:
            yield partial
            mark = {"dataset": dataset, "source": str(source.resolve())}
            (partial / _MARKER_FILE).write_text(json.dumps(mark) + "\n")
            # Readable by everybody, as `mkdir` makes folders.
            partial.chmod(0o755)
            _move(partial, out)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}).") from None


def _move(partial: Path, out: Path) -> None:
    if not out.exists():
        os.replace(partial, out)
        return
    written = sorted(partial.iterdir(), key=lambda entry: entry.name == _MARKER_FILE)
    theirs = [e.name for e in written if os.path.lexists(out / e.name)]
    if theirs and not (out / _MARKER_FILE).exists():
        raise InputError(
            f"{out}: has {', '.join(theirs)}, which no conversion wrote; choose "
            "another folder."
        )
    for entry in written:
        old = out / entry.name
        if old.is_dir() and not old.is_symlink():
            shutil.rmtree(old)
        else:
            old.unlink(missing_ok=True)
        os.replace(entry, old)


def write_truth(
    folder: Path, T_CW: Float[np.ndarray, "t 4 4"], people: list[dict[str, Any]]
) -> None:
    """Writes the trajectory, camera to world, and a file for each person."""
    truth = folder / "groundtruth"
    truth.mkdir()
    write_tum(truth / "camera.txt", np.arange(len(T_CW)) / FPS, np.linalg.inv(T_CW))
    for h, person in enumerate(people):
        name = "body.npz" if len(people) == 1 else f"body_{h}.npz"
        write_body(truth / name, fps=FPS, **person)


def write_camera(
    folder: Path,
    K: Float[np.ndarray, "3 3"],
    size: tuple[int, int],
    distortion: tuple[float, ...] = (),
) -> None:
    """Writes `camera.json`, with `k1 k2 p1 p2` if there is any distortion."""
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    model = "PINHOLE"
    if any(distortion):
        model, params = "OPENCV", [*params, *distortion[:4]]
    camera = {"model": model, "width": size[0], "height": size[1]}
    camera |= {"params": [float(p) for p in params], "fps": FPS}
    (folder / "camera.json").write_text(json.dumps(camera) + "\n")


def link_images(folder: Path, images: Path) -> None:
    """Links the images instead of copying them, as data sets are large."""
    link = folder / "images"
    link.symlink_to(images.resolve(), target_is_directory=True)


def write_keypoints(
    folder: Path, name: str, people: list[Float[np.ndarray, "t 18 3"]]
) -> None:
    """Writes keypoints in OpenPose's format, COCO-18; people who were not detected in a
    frame are left out."""
    keypoints = folder / "keypoints"
    keypoints.mkdir()
    for k in range(len(people[0])):
        found: list[Mapping[str, Any]] = [
            {"person_id": [-1], "pose_keypoints_2d": person[k].ravel().tolist()}
            for person in people
            if person[k, :, 2].any()
        ]
        # The version of OpenPose's files.
        text = json.dumps({"version": 1.3, "people": found})
        (keypoints / f"{name}_{k:012d}_keypoints.json").write_text(text)
