"""How should the motion model's prediction follow the estimate?

    python benchmarks/bench_motion_coupling.py accuracy --sequences M2-room E2-follow
    python benchmarks/bench_motion_coupling.py drift --sequences E2-follow --hold-shape

`accuracy`: errors, steps and processor time of the two, on simulated sequences.
`drift`: are people bent to postures whose prediction fits a wrong scale? Cameras are
held, and so is a scale that is wrong by 20 %: how far do predicted steps follow it? And
with the scale free from there, where does it end? With `--hold-shape` the body cannot
shrink or grow with the world, and only postures can give way.

Compilation is outside the clock.
"""

import argparse
import dataclasses
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from bodyslam_jax import evaluation, graph, solver
from bodyslam_jax.config import Config, GraphWeights, Simulation
from bodyslam_jax.experiments import score_of
from bodyslam_jax.geometry import so3
from bodyslam_jax.pipeline.case import simulate_case, trajectories

WAYS = ("frozen", "refreshed")
WRONG = (0.8, 1.2)


def cases(names, frames, cache, config):
    for name in names:
        sequence, family = name.split("-")
        settings = Simulation(sequence=sequence, family=family, length=frames)
        yield name, simulate_case(settings, config=config, cache=cache)


def problem_for(prepared, way):
    """The same factors and start; `frozen` keeps the prediction that they hold."""
    problem = prepared.problem
    return dataclasses.replace(problem, motion=None) if way == "frozen" else problem


def run(problem, state, repeats=1):
    """The solution, its number of steps, and processor time of the last run, s."""
    for _ in range(1 + repeats):
        start = time.process_time()
        found = solver.solve(problem, state, schedule=solver.PAPER_SCHEDULE)
        jax.block_until_ready(found)
        taken = time.process_time() - start
    return found, sum(int(n) for n in found.num_steps), taken


def settled(problem, state, runs=6):
    """The state where the solver converges, however many runs it takes."""
    for _ in range(runs):
        found, _, _ = run(problem, state, 0)
        state = found.state
        if found.status == "converged":
            break
    return state, found.status


def accuracy(args, config):
    print("| sequence | prediction | s | C / H / J-ATE, mm | MPJPE, PA, mm | cost "
          "| steps | processor time, s | a step, ms |")  # fmt: skip
    for name, case in cases(args.sequences, args.frames, args.cache, config):
        prepared = case.prepare()
        for way in args.ways:
            problem = problem_for(prepared, way)
            found, steps, taken = run(problem, prepared.state)
            score = score_of(case, found.state, prepared.roots.present)
            seen = trajectories(
                found.state,
                case.body,
                prepared.roots.present,
                case.cameras.registered,
                case.truth.fps,
            )
            told = evaluation.evaluate_trajectories(seen, case.truth)
            mm = lambda *names: " / ".join(f"{1e3 * told[n]:.1f}" for n in names)
            path = mm("c_ate_se3", "h_ate_se3", "j_ate_se3")
            print(
                f"| {name} | {way} | {1 / score['scale']:.4f} | {path} "
                f"| {mm('mpjpe', 'pa_mpjpe')} | {float(found.cost):.2f} "
                f"| {steps}, {found.status} | {taken:.2f} "
                f"| {1e3 * taken / steps:.0f} |",
                flush=True,
            )


@eqx.filter_jit
def predicted(motion, state):
    return motion(state).translation


@eqx.filter_jit
def stretch_and_error(motion, state, reference, weight):
    """How much longer predicted steps are than `reference`, as a share; and the share
    by which the regressor's own error in posture would change them (one sigma)."""
    weights = GraphWeights()
    sigma, rho = weights.posture_sigma, weights.posture_correlation

    def length(poses):
        seen = motion(eqx.tree_at(lambda s: s.poses, state, poses)).translation
        return jnp.sum(weight * seen * reference) / jnp.sum(weight * reference**2)

    value, slope = jax.value_and_grad(length)(state.poses)
    lag = jnp.arange(state.poses.shape[1]).astype(state.poses.dtype)
    covariance = sigma**2 * rho ** jnp.abs(lag[:, None] - lag[None])
    variance = jnp.einsum("htji,tu,huji->", slope, covariance, slope)
    return value - 1, jnp.sqrt(variance)


def drift(args, config):
    print("| sequence | prediction | s held at, of the true | predicted steps change "
          "| of which posture | worth of the regressor's error | postures turned, deg "
          "| status | s from there, free |")  # fmt: skip
    for name, case in cases(args.sequences, args.frames, args.cache, config):
        prepared = case.prepare()
        true = case.map_scale
        motion = prepared.problem.motion
        at = lambda share: eqx.tree_at(
            lambda s: s.scale, prepared.state, jnp.asarray(share * true)
        )
        for way in args.ways:
            problem = problem_for(prepared, way)
            rest = ("shapes",) if args.hold_shape else ()
            cameras = graph.set_constant(problem.free, "cameras", "landmarks", *rest)
            free = dataclasses.replace(problem, free=cameras)
            held = dataclasses.replace(
                problem, free=graph.set_constant(cameras, "scale")
            )
            right, _ = settled(held, at(1.0))
            reference = predicted(motion, right)
            weight = prepared.roots.present[..., None].astype(float)
            weight[:, : motion.model[0].past + 1] = 0
            weight = jnp.asarray(weight)
            for share in WRONG:
                wrong, status = settled(held, at(share))
                bent = eqx.tree_at(lambda s: s.poses, right, wrong.poses)
                longer, _ = stretch_and_error(motion, wrong, reference, weight)
                posture, error = stretch_and_error(motion, bent, reference, weight)
                turned = so3.between(right.poses, wrong.poses)
                there = prepared.roots.present
                turned = np.degrees(np.sqrt(np.mean(np.asarray(turned)[there] ** 2)))
                end = settled(free, at(share))[0].scale / true
                print(
                    f"| {name} | {way} | {share} | {100 * longer:+.1f} % "
                    f"| {100 * posture:+.1f} % | {100 * error:.1f} % "
                    f"| {turned:.2f} | {status} | {float(end):.3f} |",
                    flush=True,
                )


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("accuracy", "drift"))
    parser.add_argument("--sequences", nargs="+", default=["M2-room", "E2-follow"])
    parser.add_argument("--frames", type=int, default=150)
    parser.add_argument("--ways", nargs="+", default=WAYS, choices=WAYS)
    parser.add_argument("--hold-shape", action="store_true", help="in `drift`")
    parser.add_argument("--cache", type=Path, help="keeps stages before the solve")
    parser.add_argument("--weights", choices=("default", "paper"), default="default")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    paper = GraphWeights.paper() if args.weights == "paper" else GraphWeights()
    config = Config(weights=paper)
    {"accuracy": accuracy, "drift": drift}[args.what](args, config)


if __name__ == "__main__":
    main()
