"""Simulated sequences as folders, films and the objects that the pipeline takes."""

import contextlib
import dataclasses
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from bodyslam_jax.config import Simulation
from bodyslam_jax.export import write_tum
from bodyslam_jax.result import Result
from bodyslam_jax.sequence import Bodies, Intrinsics, Keypoints, Sequence
from bodyslam_jax.synthetic._filming import FPS
from bodyslam_jax.synthetic._render import Renderer, write_video
from bodyslam_jax.synthetic._simulate import SimulatedSequence, simulate

_MARK = "simulation.json"
"""Settings of the simulation; a folder with it may be written again."""
_PARTIAL = ".simulation-"
_FILM = "video.mp4"
_OWN = (
    "groundtruth/camera.txt",
    "groundtruth/landmarks.npy",
    "groundtruth/body.npz",
    "camera.json",
    "bodies.npz",
    "bodies_weak_perspective.npz",
    "keypoints/[EMD][1-4]-*_keypoints.json",
    "tracks.npz",
    _FILM,
)
"""What a simulation writes. It appears in this order and goes in the reverse, so that
what is there only in part has neither tracks nor frames: no reader takes it."""
_DEMO_FRAMES = 105


def write_sequence(
    folder: Path, simulated: SimulatedSequence, *, tracks: bool = True
) -> Path:
    """Writes a sequence folder with its ground truth, whole or not at all.

    A video is rendered if the settings say so. `bodies_weak_perspective.npz` holds the
    same bodies as `bodies.npz`, as weak perspective in the crops they were seen in.

    **Arguments:**

    - `folder`: new, empty, or with an earlier simulation, whose files are replaced;
        others, such as a run in a folder below, are kept.
    - `tracks`: whether `tracks.npz` is written; without it tracks come from the video.

    **Raises:** `ValueError` if `folder` holds something else or cannot be written.
    """
    folder = Path(folder)
    with _partial(folder, simulated.settings) as partial:
        _write(partial, simulated, tracks)
        _move(partial, folder, simulated.settings)
    return folder


def check_folder(folder: Path, settings: Simulation) -> None:
    """Fails early, before anything is simulated; leaves `folder` as it is.

    **Raises:** as `write_sequence`.
    """
    with _partial(Path(folder), settings):
        pass


def demo_settings(seed: int = 0) -> Simulation:
    """Of the demo: three and a half seconds in which the camera goes along."""
    return Simulation(
        sequence="M1", family="follow", length=_DEMO_FRAMES, seed=seed, render=True
    )


def demo_scene(
    folder: Path, seed: int = 0, simulated: SimulatedSequence | None = None
) -> Path:
    """Renders the walker whom a camera goes along with.

    Writes a sequence folder without tracks, so that they come from the video. What is
    there of the same seed is kept. `simulated` is the demo's scene of that seed, if
    there is one already.
    """
    settings = demo_settings(seed)
    if _earlier(Path(folder)) == dataclasses.asdict(settings):
        return Path(folder)
    if simulated is None:
        simulated = simulate(settings)
    return write_sequence(folder, simulated, tracks=False)


def render(simulated: SimulatedSequence) -> Iterator[UInt8[np.ndarray, "rows cols 3"]]:
    """The frames (BGR) of a simulated sequence, one after the other."""
    seed = [simulated.num_frames, *simulated.name.encode()]
    renderer = Renderer(
        simulated.room,
        simulated.person,
        simulated.intrinsics,
        simulated.size,
        np.random.default_rng(seed),
    )
    G, x = simulated.person.joints(simulated.walk.poses, simulated.walk.pelvis)
    for k, T_WC in enumerate(simulated.T_WC):
        yield renderer.frame(T_WC, simulated.person.vertices(G[k], x[k]))[0]


def as_sequence(simulated: SimulatedSequence) -> Sequence:
    """What is measured, as the readers would give it; without a video."""
    uv, confidence = simulated.keypoints
    bodies, t = simulated.bodies, simulated.num_frames
    present = np.zeros((1, t), bool)
    poses, shapes = np.zeros((1, t, 72)), np.zeros((1, t, 10))
    trans = np.zeros((1, t, 3))
    present[0, bodies.frame] = True
    poses[0, bodies.frame] = bodies.poses
    shapes[0, bodies.frame] = bodies.shapes
    trans[0, bodies.frame] = bodies.trans
    return Sequence(
        name=simulated.name,
        frames=None,
        timestamps=simulated.timestamps,
        intrinsics=Intrinsics(simulated.intrinsics, *simulated.size),
        keypoints=Keypoints(uv[None], confidence[None]),
        bodies=Bodies(present, poses, shapes, trans, _shapes_regressed(simulated)),
        tracks=simulated.tracks,
    )


def as_truth(simulated: SimulatedSequence) -> Result:
    """What is true, as a result that evaluation compares with."""
    return Result(
        timestamps=simulated.timestamps,
        T_WC=simulated.T_WC,
        scale=1.0,
        intrinsics=simulated.intrinsics,
        landmarks=simulated.landmarks,
        poses=simulated.poses[None],
        trans=simulated.trans[None],
        betas=simulated.person.shape[None],
        joints=simulated.joints[None],
        present=np.ones((1, simulated.num_frames), bool),
    )


def _shapes_regressed(simulated: SimulatedSequence) -> bool:
    """Not where bodies are written as they truly are."""
    settings = simulated.settings
    return (settings.body_noise or settings.noise) != "none"


@contextlib.contextmanager
def _partial(folder: Path, settings: Simulation) -> Iterator[Path]:
    """A hidden folder in `folder`, gone afterwards, with every folder made in vain."""
    home, made = Path(os.path.realpath(folder)), []
    try:
        _check(folder, settings)
        made = [place for place in (home, *home.parents) if not place.exists()]
        home.mkdir(parents=True, exist_ok=True)
        for killed in home.glob(f"{_PARTIAL}????????"):
            shutil.rmtree(killed, ignore_errors=True)
        partial = Path(tempfile.mkdtemp(prefix=_PARTIAL, dir=home))
        try:
            yield partial
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    except OSError as error:
        reason = error.strerror or error
        raise ValueError(f"{folder}: cannot be written ({reason}).") from None
    finally:
        for place in made:
            with contextlib.suppress(OSError):
                place.rmdir()


def _check(folder: Path, settings: Simulation) -> None:
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder}: a file; expected a folder to write.")
    if not folder.exists():
        return
    earlier = _earlier(folder)
    if earlier is None:
        if any(not entry.name.startswith(_PARTIAL) for entry in folder.iterdir()):
            raise ValueError(
                f"{folder}: not empty and not a simulation; choose another."
            )
    elif settings.render and not earlier.get("render") and (folder / _FILM).exists():
        raise ValueError(
            f"{folder}: has {_FILM}, which no simulation wrote; choose another folder."
        )


def _earlier(folder: Path) -> dict[str, Any] | None:
    """Settings of the simulation in a folder; `None` if there is none."""
    if not (folder / _MARK).exists():
        return None
    try:
        found = json.loads((folder / _MARK).read_text())
    except ValueError:
        return {}
    return found if isinstance(found, dict) else {}


def _move(partial: Path, folder: Path, settings: Simulation) -> None:
    """Puts what is in `partial` in the place of an earlier simulation."""
    earlier = _earlier(folder) or {}
    was_rendered = bool(earlier.get("render"))
    # Whoever is interrupted from here on leaves a simulation of no settings.
    mark = {"unfinished": True, "render": was_rendered or settings.render}
    (partial / "mark").write_text(json.dumps(mark))
    os.replace(partial / "mark", folder / _MARK)
    for name in ("keypoints", "groundtruth"):
        if (folder / name).is_symlink():  # to files that are somebody's
            (folder / name).unlink()
    for pattern in reversed(_OWN):
        if pattern != _FILM or was_rendered:
            for old in folder.glob(pattern):
                old.unlink()
    for pattern in _OWN:
        for new in sorted(partial.glob(pattern)):
            place = folder / new.relative_to(partial)
            place.parent.mkdir(exist_ok=True)
            os.replace(new, place)
    os.replace(partial / _MARK, folder / _MARK)


def _write(folder: Path, simulated: SimulatedSequence, tracks: bool) -> None:
    width, height = simulated.size
    camera = {
        "model": "PINHOLE",
        "width": width,
        "height": height,
        "params": simulated.intrinsics.tolist(),
        "fps": FPS,
    }
    (folder / "camera.json").write_text(json.dumps(camera))
    _write_keypoints(folder / "keypoints", simulated)
    bodies = simulated.bodies
    np.savez_compressed(
        folder / "bodies.npz",
        frame=bodies.frame,
        poses=bodies.poses,
        betas=bodies.shapes,
        trans=bodies.trans,
        shapes_regressed=np.array(_shapes_regressed(simulated)),
    )
    np.savez_compressed(
        folder / "bodies_weak_perspective.npz",
        frame=bodies.frame,
        poses=bodies.poses_crop,
        betas=bodies.shapes,
        camera=bodies.camera,
        bbox=bodies.box,
        shapes_regressed=np.array(_shapes_regressed(simulated)),
    )
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
    np.savez_compressed(
        truth / "body.npz",
        poses=simulated.poses,
        trans=simulated.trans,
        betas=simulated.person.shape,
        joints=simulated.joints,
        mocap_framerate=np.array(FPS),
        gender=np.array("neutral"),
    )
    if simulated.settings.render:
        write_video(folder / _FILM, render(simulated), FPS, simulated.size)
    settings = dataclasses.asdict(simulated.settings)
    (folder / _MARK).write_text(json.dumps(settings, indent=1))


def _write_keypoints(folder: Path, simulated: SimulatedSequence) -> None:
    """One file per frame in OpenPose's layout, without a person where none is found."""
    folder.mkdir()
    uv, confidence = simulated.keypoints
    for k in range(simulated.num_frames):
        rows: Float[np.ndarray, "25 3"] = np.column_stack([uv[k], confidence[k]])
        flat = [round(float(x), 3) for x in rows.ravel()]
        people = [{"person_id": [-1], "pose_keypoints_2d": flat}]
        content = {"version": 1.3, "people": people if confidence[k].any() else []}
        path = folder / f"{simulated.name}_{k:012d}_keypoints.json"
        path.write_text(json.dumps(content))
