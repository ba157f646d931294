"""A camera on a tripod: how well people alone determine gravity, floor and sizes.

    python benchmarks/bench_static.py [E1 M2 D1 ...] [--people 1 2 3] [--frames 150]
        [--height 1.5] [--pixels] [--keep FOLDER]

Simulated walkers of different statures before a camera that does not move: without a
map, the only measurements of the floor are people's feet. Input are simulated keypoints
or, with `--pixels`, the rendered video alone. Errors are in the camera's frame, without
any alignment. With `--keep`, films and the stages before the joint estimate are kept.
"""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from bodyslam_jax import evaluation, io, pipeline, simulation
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.diagnostics.figures import floors_apart
from bodyslam_jax.pipeline.stage_cache import Cache
from bodyslam_jax.simulation import sequences
from bodyslam_jax.simulation.room import furnish
from bodyslam_jax.types import Result, Sequence

UP = np.array([0.0, 1.0, 0.0])
CONFIG = Config(static_camera=True, overlay=False).for_simulated_people()


def static_scene(
    name: str, people: int, frames: int, height: float
) -> sequences.SimulatedSequence:
    """Walkers in a room, seen from where the moving camera of the sequence is in the
    mean, at another height."""
    settings = Simulation(
        sequence=name,  # pyright: ignore[reportArgumentType]
        length=frames,
        people=people,
        render=True,
    )
    flat = simulation.simulate(settings, load_body_model())
    walkers = [(actor.person, actor.walk) for actor in flat.actors]
    pelvis = np.concatenate([walk.pelvis for _, walk in walkers])
    eye = flat.T_WC[:, :3, 3].mean(axis=0)
    eye[1] = height
    T_WC = np.tile(looking(eye, pelvis.mean(axis=0)), (frames, 1, 1))
    truth, *streams = np.random.default_rng(flat.seed).spawn(4)
    room = furnish(pelvis, np.tile(eye, (len(pelvis), 1)), truth, is_hall=False)
    (person, walk), *others = walkers
    return sequences.measure(
        settings, f"{name}-static", person, walk, T_WC, room, tuple(streams), others  # pyright: ignore
    )  # fmt: skip


def looking(
    eye: Float[np.ndarray, "3"], at: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "4 4"]:
    """A camera's pose, level, aimed at a point."""
    z = (at - eye) / np.linalg.norm(at - eye)
    x = np.cross(z, UP)
    x = x / np.linalg.norm(x)
    found = np.eye(4)
    found[:3] = np.stack([x, np.cross(z, x), z, eye], axis=1)
    return found


def input_of(
    scene: sequences.SimulatedSequence, pixels: bool, cache: Cache, film: Path | None
) -> Sequence:
    """What the pipeline is given."""
    if not pixels:
        measured = simulation.as_sequence(scene)
        return dataclasses.replace(measured, bodies=None)
    assert film is not None, "--pixels needs --keep"
    sequence = io.read_sequence(simulation.film_scene(film, scene))
    return pipeline.find_people(sequence, CONFIG, cache)


def figures(scene: sequences.SimulatedSequence, result: Result) -> dict[str, Any]:
    """Errors: degrees, %, mm, m/s."""
    body = load_body_model()
    truth = simulation.as_truth(scene)
    mine, theirs = evaluation.associate(result, truth, body)
    found = evaluation.evaluate(mine, theirs)
    present = np.asarray(mine.present & theirs.present)
    in_camera = lambda side: np.einsum(
        "tji,htkj->htki",
        np.asarray(side.T_WC[:, :3, :3]),
        np.asarray(side.joints) - np.asarray(side.T_WC[:, None, :3, 3]),
    )
    x, y = in_camera(mine), in_camera(theirs)
    leg = lambda p: np.array(
        [
            np.median(np.linalg.norm(p[h, f][:, [4, 5]] - p[h, f][:, [1, 2]], axis=-1))
            for h, f in enumerate(present)
        ]
    )
    size = 100 * (leg(x) / leg(y) - 1)
    pelvis = np.linalg.norm(x[:, :, 0] - y[:, :, 0], axis=-1)
    scaled = x[:, :, 0] / (1 + size.mean() / 100)
    pelvis_scaled = np.linalg.norm(scaled - y[:, :, 0], axis=-1)
    degrees = lambda name: float(np.degrees(found[name]))
    return {
        "up": degrees("gravity_error"),
        "size": float(size.mean()),
        "sizes_apart": float(np.std(size)),
        "floors_apart": 1e3 * floors_apart(result.joints, result.present, 30.0),
        "pelvis": 1e3 * float(pelvis[present].mean()),
        "pelvis_scaled": 1e3 * float(pelvis_scaled[present].mean()),
        "low": 1e3 * float(found["feet_low"] - found["feet_low_of_truth"]),
        "high": 1e3 * float(found["feet_high"] - found["feet_high_of_truth"]),
        "pa_mpjpe": 1e3 * float(found["pa_mpjpe"]),
        "straighter_knee": degrees("straighter_knee")
        - degrees("straighter_knee_of_truth"),
        "foot": float(found["foot_speed"]),
        "status": result.summary["status"],
    }


def row(name: str, people: int, frames: int, height: float) -> dict[str, Any]:
    """`figures` of one scene, from simulated keypoints."""
    scene = static_scene(name, people, frames, height)
    return figures(
        scene, pipeline.run(input_of(scene, False, Cache(None), None), CONFIG)
    )


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", default=["E1", "M2", "D1"])
    parser.add_argument("--people", type=int, nargs="*", default=[1, 2, 3])
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--height", type=float, default=1.5)
    parser.add_argument("--pixels", action="store_true")
    parser.add_argument("--keep", type=Path)
    options = parser.parse_args()
    rows = []
    for people in options.people:
        for name in options.names:
            scene = static_scene(name, people, options.frames, options.height)
            label = f"{name}-{people}-{options.frames}-{options.height:g}"
            folder = None if options.keep is None else options.keep / label
            cache = Cache(None if folder is None else folder / "stages")
            sequence = input_of(
                scene, options.pixels, cache, folder and folder / "film"
            )
            result = pipeline.run(sequence, CONFIG, cache=cache)
            row = figures(scene, result)
            rows.append(row)
            show = lambda x: f"{x:.3g}" if isinstance(x, float) else x
            values = ", ".join(f"{key} {show(value)}" for key, value in row.items())
            print(f"{name} {people}: {values}", flush=True)
    for key in rows[0]:
        if key != "status":
            values = np.array([row[key] for row in rows])
            values = values[np.isfinite(values)]
            rms = np.sqrt((values**2).mean())
            print(f"{key}: mean {values.mean():.3g}, rms {rms:.3g}")


if __name__ == "__main__":
    main()
