"""Hundreds of (result, truth) pairs in one jitted, vmapped call.

Copy this to evaluate many runs at once: read the pairs, associate, pad and stack them
on the host (`stack_pairs`), and call `evaluate` under `vmap` and `jit`. Without
arguments the pairs are made up, and the pairs per second are measured:

    python benchmarks/evaluate_batch.py [--pairs 300] [--frames 300]
    python benchmarks/evaluate_batch.py RUN GROUNDTRUTH [RUN GROUNDTRUTH ...]
"""

import argparse
import dataclasses
import time
from pathlib import Path

import jax
import numpy as np

from bodyslam_jax import evaluation
from bodyslam_jax.types import Result


def evaluate_pairs(pairs: list[tuple[Result, Result]]) -> evaluation.Evaluation:
    """Every error of every pair; each value has one entry per pair."""
    return evaluate_stacked(*evaluation.stack_pairs(pairs))


evaluate_stacked = jax.jit(jax.vmap(evaluation.evaluate))


def made_up_pair(rng: np.random.Generator, num_frames: int) -> tuple[Result, Result]:
    """A walk beside a camera, and an estimate that is centimetres off."""
    t = np.arange(num_frames) / 30
    root = np.stack([1.2 * t, 0.02 * np.sin(12 * t), np.sin(t)], -1)
    joints = root[:, None] + rng.normal(0, 0.4, (24, 3))
    T_WC = np.tile(np.eye(4), (num_frames, 1, 1))
    T_WC[:, :3, 3] = root + [0.3, 0.2, -3.0]
    truth = Result(
        timestamps=t,
        T_WC=T_WC,
        scale=1.0,
        intrinsics=np.ones(4),
        landmarks=np.zeros((0, 3)),
        poses=np.zeros((1, num_frames, 72)),
        trans=root[None],
        betas=np.zeros((1, 10)),
        joints=joints[None],
        present=np.ones((1, num_frames), bool),
    )
    moved = T_WC.copy()
    moved[:, :3, 3] += rng.normal(0, 0.03, (num_frames, 3))
    noisy = truth.joints + rng.normal(0, 0.05, truth.joints.shape)
    return dataclasses.replace(truth, T_WC=moved, joints=noisy), truth


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="*", type=Path, help="RUN GROUNDTRUTH ...")
    parser.add_argument("--pairs", type=int, default=300)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--single", action="store_true", help="32 bit instead of 64")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", not arguments.single)
    if arguments.folders:
        if len(arguments.folders) % 2:
            parser.error("a run and its ground truth, in turn: one folder is left over")
        runs, truths = arguments.folders[::2], arguments.folders[1::2]
        pairs = [
            (evaluation.read_result(run), evaluation.read_truth(truth))
            for run, truth in zip(runs, truths, strict=True)
        ]
    else:
        rng = np.random.default_rng(0)
        pairs = [made_up_pair(rng, arguments.frames) for _ in range(arguments.pairs)]

    start = time.perf_counter()
    found = jax.block_until_ready(evaluate_pairs(pairs))
    print(
        f"{len(pairs)} pairs, with association and compilation: "
        f"{time.perf_counter() - start:.1f} s on {jax.devices()[0].device_kind}"
    )
    for name in ("c_ate_se3", "h_ate_se3", "j_ate_se3", "scale", "w_mpjpe", "rte"):
        # NaN is where a truth lacks what the error is about.
        known = np.asarray(found[name])[~np.isnan(found[name])]
        if len(known):
            print(
                f"{name:>12}  mean {np.mean(known):.4f}  max {np.max(known):.4f}"
                f"  of {len(known)}"
            )

    estimates, truths = evaluation.stack_pairs(pairs)
    longest = truths.camera_valid.shape[1]
    times = []
    for _ in range(5):
        start = time.perf_counter()
        jax.block_until_ready(evaluate_stacked(estimates, truths))
        times.append(time.perf_counter() - start)
    rate = len(pairs) / np.median(times)
    print(f"the call alone: {rate:.0f} pairs/s of {longest} frames")


if __name__ == "__main__":
    main()
