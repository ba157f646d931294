"""How often what is true would be doubted: the figures behind `CHECKS`.

    python tools/plausibility_thresholds.py CMU.npz ... [--simulations 10]

Motion capture is cut in pieces of 3 and 5 s; simulated sequences give their true
people and cameras, and the keypoints that are measured of them. Prints, figure by
figure, on how many pieces it applies, percentiles, and how many pieces the threshold
of `bodyslam_jax.diagnostics.thresholds` would doubt; then how many are doubted at
all. The tables stand in `benchmarks/plausibility.md`.
"""

import argparse
import dataclasses
from collections.abc import Iterator
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from bodyslam_jax import body as body_
from bodyslam_jax import graph, initialisation, motion, people, simulation
from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.diagnostics import figures
from bodyslam_jax.diagnostics.thresholds import PERSON_CHECKS, WORLD_CHECKS
from bodyslam_jax.geometry import camera
from bodyslam_jax.pipeline.motion_prediction import motion_predictor, predict

SECONDS = (3.0, 5.0)
SHORTEST = 0.7
"""s; runs of the archive are hardly longer."""
SEQUENCES = ("E1", "M1", "D1", "E2", "M2", "D2", "E3", "M3", "D3", "M4")


def pieces(path: Path, seconds: float) -> Iterator[tuple[str, dict[str, float]]]:
    """Name and figures of each piece of the clips of one archive."""
    for clip in motion.read_motion(path):
        if clip.phase:
            continue
        joints = place(clip)
        size = round(seconds * clip.fps)
        for start in range(0, max(1, len(joints) - size // 2), size):
            part = joints[start : start + size]
            if len(part) >= SHORTEST * clip.fps:
                here = np.ones(len(part), bool)
                found = figures.person_figures(part, here, clip.fps)
                if "trunk_lean" in found:
                    every = part[None], here[None]
                    found["lean_of_walkers"] = figures.lean_of_walkers(*every)
                yield clip.name, found


def place(clip: motion.Clip) -> np.ndarray:
    """The clip's joints in the world, m, by forward kinematics of its own bones."""
    t = len(clip.poses)
    turn = Rotation.from_rotvec(clip.poses.reshape(-1, 3)).as_matrix()
    turn = turn.reshape(t, 24, 3, 3)
    joints = np.zeros((t, 24, 3))
    joints[:, 0] = clip.trans
    for k, parent in list(enumerate(body_.PARENTS))[1:]:
        joints[:, k] = joints[:, parent] + turn[:, parent] @ clip.offsets[k]
        turn[:, k] = turn[:, parent] @ turn[:, k]
    return joints


def simulated(number: int) -> Iterator[tuple[str, dict[str, float]]]:
    """Figures of true people, true cameras and measured keypoints."""
    body = body_.load_body_model()
    for i in range(number):
        settings = Simulation(
            sequence=SEQUENCES[i % 10],
            family=("room", "follow")[i // 10 % 2 if number > 10 else i % 2],
            length=240,
            seed=1000 + i,
        )
        made = simulation.simulate(settings, body)
        truth, sequence = simulation.as_truth(made), simulation.as_sequence(made)
        found = figures.camera_figures(truth.T_WC, sequence.fps)
        uv = project(body, truth, sequence)
        error = np.linalg.norm(uv - sequence.keypoints.uv, axis=-1)
        error = np.where(sequence.keypoints.confidence > 0.3, error, np.nan)
        size = np.linalg.norm(np.ptp(uv, axis=2), axis=-1)
        for h, joints in enumerate(truth.joints):
            found |= figures.person_figures(joints, truth.present[h], sequence.fps)
            found["keypoint_misfit"] = figures.worst_misfit(
                error[h], size[h], sequence.fps
            )[0]
            yield f"{settings.sequence}-{settings.family}", found


def carried_of(paths: list[Path], frames: int = 90) -> tuple[int, list[str]]:
    """Of how many pieces of motion capture, filmed by a camera that stands still, and
    of which the motion model's steps would be left out."""
    body = body_.load_body_model()
    made = simulation.as_sequence(simulation.simulate(Simulation(length=frames), body))
    there = np.ones((1, frames), bool)
    roots = people.roots_from_bodies(made.bodies, body)
    roots = dataclasses.replace(roots, present=there)
    predictor = motion_predictor(made, roots, body, Config())
    still = jnp.asarray(np.tile(np.eye(4), (frames, 1, 1)))
    number, found = 0, []
    clips = (clip for path in paths for clip in motion.read_motion(path))
    for clip in (clip for clip in clips if not clip.phase):
        joints, poses = place(clip), np.reshape(clip.poses, (-1, 24, 3)).astype(float)
        at = np.round(np.arange(frames) * clip.fps / made.fps).astype(int)
        for start in range(0, len(joints) - at[-1], at[-1] + 1):
            T_WH = np.tile(np.eye(4), (1, frames, 1, 1))
            rows = start + at
            T_WH[0, :, :3, :3] = Rotation.from_rotvec(poses[rows, 0]).as_matrix()
            T_WH[0, :, :3, 3] = joints[rows, 0]
            state = graph.State(
                scale=jnp.asarray(1.0),
                cameras=still,
                roots=jnp.asarray(T_WH),
                poses=jnp.asarray(poses[None, rows, 1:]),
                shapes=jnp.zeros((1, 10)),
                landmarks=jnp.zeros((1, 3)),
                intrinsics=jnp.asarray(made.intrinsics.params),
            )
            seen = predict(predictor, state)
            number += 1
            if initialisation.carried(state, seen, there, 1.0, made.fps):
                found.append(clip.name)
    return number, found


def project(body, truth, sequence) -> np.ndarray:
    """The true body's keypoints in the images, px."""
    p_W = body_.keypoints(
        body,
        jnp.asarray(truth.poses),
        jnp.asarray(truth.betas)[:, None],
        jnp.asarray(truth.trans),
        "body25",
    )
    R_WC, r_WC = truth.T_WC[:, :3, :3], truth.T_WC[:, :3, 3]
    p_C = np.einsum("tji,htkj->htki", R_WC, np.asarray(p_W) - r_WC[:, None])
    intrinsics = jnp.asarray(sequence.intrinsics.params)
    return np.asarray(camera.project(intrinsics, jnp.asarray(p_C)))


def table(rows: list[tuple[str, dict[str, float]]]) -> str:
    """Markdown: percentiles of each figure, and what its threshold doubts."""
    lines = [
        "| figure | pieces | 1 % | 50 % | 99 % | worst | threshold | doubted |",
        "|---|---|---|---|---|---|---|---|",
    ]
    doubted = set()
    for check in (*PERSON_CHECKS, *WORLD_CHECKS):
        values = np.array([figure.get(check.name, np.nan) for _, figure in rows])
        known = values[np.isfinite(values)]
        if not len(known):
            continue
        failing = [i for i, value in enumerate(values) if check.fails(value)]
        doubted |= set(failing)
        low, middle, high = np.percentile(known, [1, 50, 99])
        worst = known.min() if check.below else known.max()
        lines.append(
            f"| {check.name} | {len(known)} | {low:.3g} | {middle:.3g} | {high:.3g} | "
            f"{worst:.3g} | {check.limit:g} | {len(failing)} |"
        )
    names = sorted({rows[i][0] for i in doubted})
    share = 100 * len(doubted) / len(rows)
    lines.append(f"\nDoubted: {len(doubted)} of {len(rows)} ({share:.1f} %) {names}")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("clips", type=Path, nargs="*")
    parser.add_argument("--simulations", type=int, default=10)
    parser.add_argument("--steps", action="store_true", help="also who is carried")
    options = parser.parse_args()
    for seconds in SECONDS:
        rows = [row for path in options.clips for row in pieces(path, seconds)]
        if rows:
            print(f"## Motion capture, pieces of {seconds:g} s\n\n{table(rows)}\n")
    if options.steps:
        number, names = carried_of(options.clips)
        print(f"Steps left out: {len(names)} of {number} pieces {names}\n")
    if options.simulations:
        rows = list(simulated(options.simulations))
        print(f"## Simulated sequences\n\n{table(rows)}")


if __name__ == "__main__":
    main()
