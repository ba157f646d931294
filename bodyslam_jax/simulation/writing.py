"""Simulated sequences as folders, films and the objects that the pipeline takes."""

import contextlib
import dataclasses
import functools
import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8

from bodyslam_jax.config import Simulation
from bodyslam_jax.io import atomic, write_body, write_tum
from bodyslam_jax.simulation.camera_paths import FPS
from bodyslam_jax.simulation.outfit import dress
from bodyslam_jax.simulation.renderer import Renderer, write_video
from bodyslam_jax.simulation.sensor_noise import Regressed
from bodyslam_jax.simulation.sequences import SimulatedSequence, simulate
from bodyslam_jax.simulation.shutter import Shutter, around
from bodyslam_jax.types import Bodies, Intrinsics, Keypoints, Result, Sequence

_MARK = "simulation.json"
"""Settings of the simulation; a folder with it may be written again."""
_PARTIAL = ".simulation-"
_FILM = "video.mp4"
_OWN = (
    "groundtruth/camera.txt",
    "groundtruth/landmarks.npy",
    "groundtruth/body.npz",
    "groundtruth/body_[0-9].npz",
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
    folder: Path,
    simulated: SimulatedSequence,
    *,
    tracks: bool = True,
    people: bool = True,
) -> Path:
    """Writes a sequence folder with its ground truth, whole or not at all.

    A video is rendered if the settings say so. `bodies_weak_perspective.npz` holds the
    same bodies as `bodies.npz`, as weak perspective in the crops they were seen in.

    **Arguments:**

    - `folder`: new, empty, or with an earlier simulation, whose files are replaced;
        others, such as a run in a folder below, are kept.
    - `tracks`: whether `tracks.npz` is written; without it tracks come from the video.
    - `people`: whether keypoints and bodies are written; without them people are found
        in the video.

    **Raises:** `ValueError` if `folder` holds something else or cannot be written.
    """
    folder = Path(folder)
    with _partial(folder, simulated.settings) as partial:
        _write(partial, simulated, tracks, people)
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
    folder: Path,
    seed: int = 0,
    simulated: SimulatedSequence | None = None,
    *,
    people: bool = True,
) -> Path:
    """Renders the walker whom a camera goes along with.

    Writes a sequence folder without tracks, so that they come from the video. What is
    there of the same seed is kept. `simulated` is the demo's scene of that seed, if
    there is one already. Without `people` there are neither keypoints nor bodies, so
    that people come from the video, too.
    """
    settings = demo_settings(seed)
    if _earlier(Path(folder)) == _mark(settings, False, people):
        return Path(folder)
    if simulated is None:
        simulated = simulate(settings)
    return write_sequence(folder, simulated, tracks=False, people=people)


def film_scene(folder: Path, simulated: SimulatedSequence) -> Path:
    """Renders a sequence to a folder with the video and the camera's calibration only,
    so that people and tracks have to be found in the images; with the ground truth.

    A film of the same settings that is there is kept.

    **Raises:** as `write_sequence`.
    """
    settings = dataclasses.replace(simulated.settings, render=True)
    if _earlier(Path(folder)) == _mark(settings, False, False):
        return Path(folder)
    simulated = dataclasses.replace(simulated, settings=settings)
    return write_sequence(folder, simulated, tracks=False, people=False)


def render(simulated: SimulatedSequence) -> Iterator[UInt8[np.ndarray, "rows cols 3"]]:
    """The frames (BGR) of a simulated sequence, one after the other."""
    for image, _ in render_people(simulated):
        yield image


def render_people(
    simulated: SimulatedSequence,
) -> Iterator[tuple[UInt8[np.ndarray, "rows cols 3"], Int[np.ndarray, "rows cols"]]]:
    """The frames (BGR), and which person is seen where: 0 for none, h + 1 for h."""
    rng = np.random.default_rng([simulated.seed, 1])
    actors = simulated.actors
    figures = [
        dress(a.person, one)
        for a, one in zip(actors, rng.spawn(len(actors)), strict=True)
    ]
    renderer = Renderer(
        simulated.room, figures, simulated.intrinsics, simulated.size, rng,
        Shutter(simulated.settings.exposure, simulated.settings.readout),
    )  # fmt: skip
    posed = [
        f.person.joints(a.walk.poses, a.walk.pelvis)
        for f, a in zip(figures, actors, strict=True)
    ]
    last = simulated.num_frames - 1

    @functools.lru_cache(maxsize=4)
    def skins(k: int) -> list[Float[np.ndarray, "v 3"]]:
        return [
            f.person.vertices(G[k], x[k])
            for f, (G, x) in zip(figures, posed, strict=True)
        ]

    for k in range(last + 1):
        window = [skins(i) for i in range(max(k - 1, 0), min(k + 1, last) + 1)]
        moving = [around(np.stack(one), min(k, 1)) for one in zip(*window, strict=True)]
        yield renderer.frame(simulated.T_WC, k, moving)


def as_sequence(simulated: SimulatedSequence) -> Sequence:
    """What is measured, as the readers would give it; without a video."""
    actors, t = simulated.actors, simulated.num_frames
    present = np.zeros((len(actors), t), bool)
    poses, shapes = np.zeros((len(actors), t, 72)), np.zeros((len(actors), t, 10))
    trans = np.zeros((len(actors), t, 3))
    for h, actor in enumerate(actors):
        bodies = actor.bodies
        present[h, bodies.frame] = True
        poses[h, bodies.frame] = bodies.poses
        shapes[h, bodies.frame] = bodies.shapes
        trans[h, bodies.frame] = bodies.trans
    uv, confidence = (np.stack([a.keypoints[i] for a in actors]) for i in range(2))
    return Sequence(
        name=simulated.name,
        frames=None,
        timestamps=simulated.timestamps,
        intrinsics=Intrinsics(simulated.intrinsics, *simulated.size),
        keypoints=Keypoints(uv, confidence),
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
        poses=np.stack([a.poses for a in simulated.actors]),
        trans=np.stack([a.trans for a in simulated.actors]),
        betas=np.stack([a.person.shape for a in simulated.actors]),
        joints=np.stack([a.joints for a in simulated.actors]),
        present=np.ones((len(simulated.actors), simulated.num_frames), bool),
    )


def _shapes_regressed(simulated: SimulatedSequence) -> bool:
    """Not where bodies are written as they truly are."""
    settings = simulated.settings
    return (settings.body_noise or settings.noise) != "none"


@contextlib.contextmanager
def _partial(folder: Path, settings: Simulation) -> Iterator[Path]:
    """A hidden folder in `folder`, gone afterwards, with every folder made in vain."""
    try:
        _check(folder, settings)
        home = Path(os.path.realpath(folder))
        for killed in home.glob(f"{_PARTIAL}????????"):
            shutil.rmtree(killed, ignore_errors=True)
        with atomic.hidden_folder(home, _PARTIAL) as partial:
            yield partial
    except OSError as error:
        reason = error.strerror or error
        raise ValueError(f"{folder}: cannot be written ({reason}).") from None


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
    with contextlib.suppress(OSError):  # there is none, or it holds what is not ours
        (folder / "keypoints").rmdir()
    for pattern in _OWN:
        for new in sorted(partial.glob(pattern)):
            place = folder / new.relative_to(partial)
            place.parent.mkdir(exist_ok=True)
            os.replace(new, place)
    os.replace(partial / _MARK, folder / _MARK)


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
        write_video(folder / _FILM, render(simulated), FPS, simulated.size)
    mark = _mark(simulated.settings, tracks, people)
    (folder / _MARK).write_text(json.dumps(mark, indent=1))


def _mark(settings: Simulation, tracks: bool, people: bool) -> dict[str, Any]:
    """What a folder is of: settings, and which measurements it holds."""
    measured = {"tracks": tracks, "people": people}
    return {**dataclasses.asdict(settings), "measured": measured}


def _write_people(folder: Path, simulated: SimulatedSequence) -> None:
    """Keypoints and bodies as they are measured."""
    _write_keypoints(folder / "keypoints", simulated)
    bodies, person = _stacked([actor.bodies for actor in simulated.actors])
    np.savez_compressed(
        folder / "bodies.npz",
        frame=bodies.frame,
        person=person,
        poses=bodies.poses,
        betas=bodies.shapes,
        trans=bodies.trans,
        shapes_regressed=np.array(_shapes_regressed(simulated)),
    )
    np.savez_compressed(
        folder / "bodies_weak_perspective.npz",
        frame=bodies.frame,
        person=person,
        poses=bodies.poses_crop,
        betas=bodies.shapes,
        camera=bodies.camera,
        bbox=bodies.box,
        shapes_regressed=np.array(_shapes_regressed(simulated)),
    )


def _stacked(
    people: list[Regressed],
) -> tuple[Regressed, Int[np.ndarray, " m"]]:
    """Bodies of all people one after the other, and whose each is."""
    names = [field.name for field in dataclasses.fields(Regressed)]
    joined = {n: np.concatenate([getattr(p, n) for p in people]) for n in names}
    count = [len(one.frame) for one in people]
    return Regressed(**joined), np.repeat(np.arange(len(people)), count)


def _write_keypoints(folder: Path, simulated: SimulatedSequence) -> None:
    """One file per frame in OpenPose's layout, without a person where none is found."""
    folder.mkdir()
    for k in range(simulated.num_frames):
        people = []
        for uv, confidence in (actor.keypoints for actor in simulated.actors):
            rows: Float[np.ndarray, "25 3"] = np.column_stack([uv[k], confidence[k]])
            flat = [round(float(x), 3) for x in rows.ravel()]
            if confidence[k].any():
                people.append({"person_id": [-1], "pose_keypoints_2d": flat})
        content = {"version": 1.3, "people": people}
        path = folder / f"{simulated.name}_{k:012d}_keypoints.json"
        path.write_text(json.dumps(content))
