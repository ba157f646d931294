"""People who jump: what the ground does to scale and feet while nobody stands on it.

    python benchmarks/bench_jumps.py --motion cmu_other.npz [02_04 13_11 ...]
        [--inputs bodies keypoints] [--cameras moving static] [--frames 240]

Recorded jumps (CMU, in the format of `motion.read_motion`) of a person of random shape
on level ground, seen by a camera in the hand or on a tripod at 4 m, with simulated
measurements. Of the truth are: `height`, the greatest height of both feet over the
ground; `share`, the share of frames in which they are above 5 cm; `found` and `false`,
the shares of these and of the other frames that are free fall by the pelvis.
"""

import argparse
import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np
from bench_static import UP, looking

from bodyslam_jax import evaluation, motion, pipeline, simulation
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.ground.stances import in_free_fall
from bodyslam_jax.simulation import sequences
from bodyslam_jax.simulation.camera_paths import FPS, HANDLING, film_room
from bodyslam_jax.simulation.gait_synthesis import Soles
from bodyslam_jax.simulation.posing import Person
from bodyslam_jax.simulation.room import furnish
from bodyslam_jax.simulation.sequences import play

JUMPS = ("02_04", "13_11", "13_39")
DISTANCE = 4.0
"""m"""


def scene(
    clip: motion.Clip, frames: int, static: bool
) -> tuple[sequences.SimulatedSequence, dict[str, Any]]:
    """The clip as filmed, and how high it goes."""
    seed = int(clip.name.replace("_", ""))
    truth, key, bodies, points = np.random.default_rng(seed).spawn(4)
    person = Person(load_body_model(), np.clip(truth.standard_normal(10), -2, 2))
    walk = play(person, clip, frames, None)
    middle = walk.pelvis.mean(axis=0)
    away = DISTANCE + np.ptp(walk.pelvis[:, [0, 2]], axis=0).max() / 2
    turn = truth.uniform(0, 2 * np.pi)
    place = middle[[0, 2]] + away * np.array([np.cos(turn), np.sin(turn)])
    T_WC = film_room(walk.pelvis, place, HANDLING["M"], truth)
    if static:
        eye = np.array([place[0], 1.5, place[1]])
        T_WC = np.tile(looking(eye, middle), (len(T_WC), 1, 1))
    room = furnish(walk.pelvis, T_WC[:, :3, 3], truth)
    settings = Simulation(sequence="M2", seed=seed, length=len(T_WC))
    simulated = sequences.measure(
        settings, clip.name, person, walk, T_WC, room, (key, bodies, points)
    )
    feet = Soles(person)(walk.poses, walk.pelvis)[..., 1].min(axis=1)
    air = feet > 0.05
    falls = in_free_fall(walk.pelvis, np.ones(len(air), bool), UP, FPS)
    return simulated, {
        "height": feet.max(),
        "share": air.mean(),
        "found": falls[air].mean(),
        "false": falls[~air].mean(),
    }


def figures(
    simulated: sequences.SimulatedSequence, which: str, static: bool
) -> dict[str, Any]:
    """Errors of the result: scale and its claimed error in %, mm, m/s."""
    config = Config(static_camera=static, overlay=False).for_simulated_people()
    sequence = simulation.as_sequence(simulated)
    if which == "keypoints":
        sequence = dataclasses.replace(sequence, bodies=None)
    result = pipeline.run(sequence, config)
    truth = simulation.as_truth(simulated)
    pair = evaluation.associate(result, truth, load_body_model())
    found = evaluation.evaluate(*pair)
    summary = result.summary
    mm = lambda name: 1e3 * float(found[name])
    claimed = summary.get("scale_sigma") or np.nan
    return {
        "scale": 100 * (1 / float(found["scale"]) - 1),
        "claimed": 100 * claimed / result.scale,
        "h_ate_sim3": mm("h_ate_sim3"),
        "pa_mpjpe": mm("pa_mpjpe"),
        "low": mm("feet_low") - mm("feet_low_of_truth"),
        "high": mm("feet_high") - mm("feet_high_of_truth"),
        "foot": float(found["foot_speed"]),
        "foot_true": float(found["foot_speed_of_truth"]),
        "up": float(np.degrees(found["gravity_error"])),
        "status": summary["status"],
        "reasons": " ".join(r["name"] for r in summary.get("reasons", [])),
    }


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("names", nargs="*", default=list(JUMPS))
    parser.add_argument("--motion", type=Path, required=True)
    parser.add_argument("--inputs", nargs="*", default=["bodies", "keypoints"])
    parser.add_argument("--cameras", nargs="*", default=["moving", "static"])
    parser.add_argument("--frames", type=int, default=240)
    options = parser.parse_args()
    clips = {clip.name: clip for clip in motion.read_motion(options.motion)}
    for name in options.names:
        for camera in options.cameras:
            static = camera == "static"
            simulated, jump = scene(clips[name], options.frames, static)
            for which in options.inputs:
                row = jump | figures(simulated, which, static)
                show = lambda x: x if isinstance(x, str) else f"{x:.3g}"
                values = ", ".join(f"{key} {show(value)}" for key, value in row.items())
                print(f"{name} {camera} {which}: {values}", flush=True)


if __name__ == "__main__":
    main()
