"""Writes simulated sequences as folders, with their ground truth."""

import contextlib
import dataclasses
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.config import Simulation
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic, write_body, write_tum
from bodyslam_jax.io.files import read_json
from bodyslam_jax.simulation.camera_paths import FPS
from bodyslam_jax.simulation.renderer import render, write_video
from bodyslam_jax.simulation.sensor_noise import Regressed
from bodyslam_jax.simulation.sequences import (
    SimulatedSequence,
    shapes_regressed,
    simulate,
)

_MARKER_FILE = "simulation.json"
"""File with the settings of the simulation; a folder that has it may be overwritten."""
_PARTIAL_PREFIX = ".simulation-"
_VIDEO_FILE = "video.mp4"
_SIMULATION_FILES = (
    "groundtruth/camera.txt",
    "groundtruth/landmarks.npy",
    "groundtruth/body.npz",
    "groundtruth/body_[0-9].npz",
    "camera.json",
    "bodies.npz",
    "bodies_weak_perspective.npz",
    "keypoints/[EMD][1-4]-*_keypoints.json",
    "tracks.npz",
    _VIDEO_FILE,
)
"""Files of a simulation. They are written in this order and removed in the reverse
order, so that an incomplete folder has neither tracks nor frames and is refused by
readers."""
_DEMO_FRAMES = 105


def write_sequence(
    folder: Path,
    simulated: SimulatedSequence,
    *,
    tracks: bool = True,
    people: bool = True,
) -> Path:
    """Writes a sequence folder with its ground truth, atomically.

    A video is rendered if the settings say so. `bodies_weak_perspective.npz` holds the
    same bodies as `bodies.npz`, as weak perspective in the crops they were seen in.

    **Arguments:**

    - `folder`: new, empty, or with an earlier simulation, whose files are replaced;
        others, such as a run in a folder below, are kept.
    - `tracks`: whether `tracks.npz` is written; without it tracks come from the video.
    - `people`: whether keypoints and bodies are written; without them people are found
        in the video.

    **Raises:** `InputError` if `folder` holds something else or cannot be written.
    """
    folder = Path(folder)
    with _partial(folder, simulated.settings) as partial:
        _write(partial, simulated, tracks, people)
        _move(partial, folder, simulated.settings)
    return folder


def check_folder(folder: Path, settings: Simulation) -> None:
    """Checks that `folder` can be written, before anything is simulated; leaves it
    unchanged.

    **Raises:** as `write_sequence`.
    """
    with _partial(Path(folder), settings):
        pass


def demo_settings(seed: int = 0) -> Simulation:
    """Returns the settings of the demo: 3.5 s in which the camera follows a walker."""
    return Simulation(
        sequence="M1", family="follow", length=_DEMO_FRAMES, seed=seed, render=True
    )


def demo_scene(
    folder: Path,
    seed: int = 0,
    *,
    people: bool = True,
) -> Path:
    """Renders the demo: a walker whom a moving camera follows.

    Writes a sequence folder without tracks, so that they are computed from the video.
    An existing scene of the same seed is kept. Without `people` there are
    neither keypoints nor bodies, so that people are detected in the video, too.
    """
    settings = demo_settings(seed)
    if _earlier(Path(folder)) == _mark(settings, False, people):
        return Path(folder)
    return write_sequence(folder, simulate(settings), tracks=False, people=people)


def film_scene(folder: Path, simulated: SimulatedSequence) -> Path:
    """Renders a sequence to a folder with the video, the camera's calibration and the
    ground truth only, so that people and tracks must be found in the images.

    An existing film of the same settings is kept.

    **Raises:** as `write_sequence`.
    """
    settings = dataclasses.replace(simulated.settings, render=True)
    if _earlier(Path(folder)) == _mark(settings, False, False):
        return Path(folder)
    simulated = dataclasses.replace(simulated, settings=settings)
    return write_sequence(folder, simulated, tracks=False, people=False)


@contextlib.contextmanager
def _partial(folder: Path, settings: Simulation) -> Iterator[Path]:
    """Yields a temporary hidden folder in `folder`; on failure, created folders are
    removed."""
    try:
        _check(folder, settings)
        home = Path(os.path.realpath(folder))
        for killed in home.glob(f"{_PARTIAL_PREFIX}????????"):
            shutil.rmtree(killed, ignore_errors=True)
        with atomic.hidden_folder(home, _PARTIAL_PREFIX) as partial:
            yield partial
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"{folder}: cannot be written ({reason}).") from None


def _check(folder: Path, settings: Simulation) -> None:
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: a file; expected a folder to write.")
    if not folder.exists():
        return
    earlier = _earlier(folder)
    if earlier is None:
        if any(
            not entry.name.startswith(_PARTIAL_PREFIX) for entry in folder.iterdir()
        ):
            raise InputError(
                f"{folder}: not empty and not a simulation; choose another."
            )
    elif (
        settings.render
        and not earlier.get("render")
        and (folder / _VIDEO_FILE).exists()
    ):
        raise InputError(
            f"{folder}: has {_VIDEO_FILE}, which no simulation wrote; choose "
            "another folder."
        )


def _earlier(folder: Path) -> dict[str, Any] | None:
    """Returns the settings of the simulation in a folder; `None` if there is none."""
    if not (folder / _MARKER_FILE).exists():
        return None
    try:
        found = read_json(folder / _MARKER_FILE)
    except InputError:
        return {}
    return found if isinstance(found, dict) else {}


def _move(partial: Path, folder: Path, settings: Simulation) -> None:
    """Replaces an earlier simulation by the content of `partial`."""
    earlier = _earlier(folder) or {}
    was_rendered = bool(earlier.get("render"))
    # An interruption from here on leaves a folder marked as unfinished.
    mark = {"unfinished": True, "render": was_rendered or settings.render}
    (partial / "mark").write_text(json.dumps(mark))
    os.replace(partial / "mark", folder / _MARKER_FILE)
    for name in ("keypoints", "groundtruth"):
        if (folder / name).is_symlink():  # its target belongs to somebody else
            (folder / name).unlink()
    for pattern in reversed(_SIMULATION_FILES):
        if pattern != _VIDEO_FILE or was_rendered:
            for old in folder.glob(pattern):
                old.unlink()
    with contextlib.suppress(OSError):  # absent, or with other files in it
        (folder / "keypoints").rmdir()
    for pattern in _SIMULATION_FILES:
        for new in sorted(partial.glob(pattern)):
            place = folder / new.relative_to(partial)
            place.parent.mkdir(exist_ok=True)
            os.replace(new, place)
    os.replace(partial / _MARKER_FILE, folder / _MARKER_FILE)


def _write(
    folder: Path, simulated: SimulatedSequence, tracks: bool, people: bool
) -> None:
    width, height = simulated.size
    camera = {
        "model": "PINHOLE",
        "width": width,
        "height": height,
        "params": simulated.intrinsics.tolist(),
        "fps": FPS,
    }
    (folder / "camera.json").write_text(json.dumps(camera))
    if people:
        _write_people(folder, simulated)
    if tracks:
        np.savez_compressed(
            folder / "tracks.npz",
            frame=simulated.tracks.frame.astype(np.int32),
            landmark=simulated.tracks.landmark.astype(np.int32),
            uv=simulated.tracks.uv.astype(np.float32),
        )
    truth = folder / "groundtruth"
    truth.mkdir()
    write_tum(truth / "camera.txt", simulated.timestamps, simulated.T_WC)
    np.save(truth / "landmarks.npy", simulated.landmarks)
    for h, actor in enumerate(simulated.actors):
        write_body(
            truth / ("body.npz" if not simulated.others else f"body_{h}.npz"),
            actor.poses,
            actor.trans,
            actor.person.shape,
            fps=FPS,
            joints=actor.joints,
        )
    if simulated.settings.render:
        write_video(folder / _VIDEO_FILE, render(simulated), FPS, simulated.size)
    mark = _mark(simulated.settings, tracks, people)
    (folder / _MARKER_FILE).write_text(json.dumps(mark, indent=1))


def _mark(settings: Simulation, tracks: bool, people: bool) -> dict[str, Any]:
    """Returns the content of the marker file: settings, and which measurements are
    written."""
    measured = {"tracks": tracks, "people": people}
    return {**dataclasses.asdict(settings), "measured": measured}


def _write_people(folder: Path, simulated: SimulatedSequence) -> None:
    """Writes the measured keypoints and bodies."""
    _write_keypoints(folder / "keypoints", simulated)
    bodies, person = _stacked([actor.bodies for actor in simulated.actors])
    np.savez_compressed(
        folder / "bodies.npz",
        frame=bodies.frame,
        person=person,
        poses=bodies.poses,
        betas=bodies.shapes,
        trans=bodies.trans,
        shapes_regressed=np.array(shapes_regressed(simulated)),
    )
    np.savez_compressed(
        folder / "bodies_weak_perspective.npz",
        frame=bodies.frame,
        person=person,
        poses=bodies.poses_crop,
        betas=bodies.shapes,
        camera=bodies.camera,
        bbox=bodies.box,
        shapes_regressed=np.array(shapes_regressed(simulated)),
    )


def _stacked(
    people: list[Regressed],
) -> tuple[Regressed, Int[np.ndarray, " m"]]:
    """Returns the bodies of all people concatenated, and the index of each body's
    person."""
    names = [field.name for field in dataclasses.fields(Regressed)]
    joined = {n: np.concatenate([getattr(p, n) for p in people]) for n in names}
    count = [len(one.frame) for one in people]
    return Regressed(**joined), np.repeat(np.arange(len(people)), count)


def _write_keypoints(folder: Path, simulated: SimulatedSequence) -> None:
    """Writes one file per frame in OpenPose's layout; undetected people are left
    out."""
    folder.mkdir()
    for k in range(simulated.num_frames):
        people = []
        for uv, confidence in (actor.keypoints for actor in simulated.actors):
            rows: Float[np.ndarray, "25 3"] = np.column_stack([uv[k], confidence[k]])
            flat = [round(float(x), 3) for x in rows.ravel()]
            if confidence[k].any():
                people.append({"person_id": [-1], "pose_keypoints_2d": flat})
        content = {"version": 1.3, "detector": "simulated", "people": people}
        path = folder / f"{simulated.name}_{k:012d}_keypoints.json"
        path.write_text(json.dumps(content))
