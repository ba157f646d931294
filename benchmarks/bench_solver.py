"""How fast is the solver, and at the same cost as whom?

    python benchmarks/bench_solver.py landmarks --frames 100 300 1000
    python benchmarks/bench_solver.py joint --frames 300 1000
    python benchmarks/bench_solver.py breakdown --frames 1000
    python benchmarks/bench_solver.py peers --peer-python PYTHON

The generator is the project's own and seeded. Compilation is outside the clock and
given by itself; all solvers' results are judged by one cost function. Set
`OPENBLAS_NUM_THREADS=1`: its threads and XLA's get in each other's way. Processor time
is beside wall time, which on a shared machine says little.
"""

import argparse
import functools
import subprocess
import tempfile
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import bodyslam_jax.graph as g
from bodyslam_jax.body import load_body_model, local_keypoints
from bodyslam_jax.camera import project
from bodyslam_jax.solver import Stage, marginals, solve
from bodyslam_jax.solver._assembly import assemble
from bodyslam_jax.solver._blocks import sizes_of
from bodyslam_jax.solver._chunks import factorise
from bodyslam_jax.solver._landmarks import eliminate_landmarks
from bodyslam_jax.solver._linearise import linearise
from bodyslam_jax.solver._normal import Eliminated, damped, diagonals, solve_step
from bodyslam_jax.solver._padding import pad
from bodyslam_jax.solver._people import border_of, eliminate_postures
from bodyslam_jax.solver._tables import gather

INTRINSICS = np.array([900.0, 900.0, 640.0, 360.0])
TRACK = 16.0
"""Mean length of a track, frames."""


def turn(axis, angle):
    """Rotation matrices about a coordinate axis."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.zeros((len(angle), 3, 3))
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    R[:, axis, axis] = 1
    R[:, i, i], R[:, j, j], R[:, i, j], R[:, j, i] = c, c, -s, s
    return R


def make_scene(frames, people, rng, scale=1.3):
    """A hand-held camera that follows people who walk, points all along the way."""
    k = np.arange(frames)
    wave = lambda size, period, phase: size * np.sin(2 * np.pi * k / period + phase)
    yaw, pitch = wave(0.2, 170, 0.3) + wave(0.03, 23, 1), wave(0.06, 61, 2)
    cameras = np.tile(np.eye(4), (frames, 1, 1))
    cameras[:, :3, :3] = turn(1, yaw) @ turn(0, pitch) @ turn(2, wave(0.03, 41, 0))
    step = 0.03
    cameras[:, 0, 3] = wave(0.4, 140, 0)
    cameras[:, 1, 3] = wave(0.03, 15, 0)
    cameras[:, 2, 3] = step * k + wave(0.1, 90, 1)
    roots = np.tile(np.eye(4), (people, frames, 1, 1))
    poses = np.zeros((people, frames, 23, 3))
    for h in range(people):
        swing = 2 * np.pi * k / 32 + h
        poses[h, :, 0, 0], poses[h, :, 1, 0] = 0.4 * np.sin(swing), -0.4 * np.sin(swing)
        poses[h, :, 3, 0] = 0.5 * (1 + np.sin(swing - 1.5)) * 0.7
        poses[h, :, 4, 0] = 0.5 * (1 - np.sin(swing - 1.5)) * 0.7
        poses[h, :, 15, 2], poses[h, :, 16, 2] = -1.2, 1.2
        poses[h] += 0.05 * rng.standard_normal((1, 23, 3))
        place = np.stack([0.7 * h + wave(0.3, 200, h), 0.1 + 0 * k, 4.5 + step * k], 1)
        world = turn(1, wave(0.3, 150, h)) @ np.diag([-1.0, -1.0, 1.0])
        C = cameras[:, :3, :3].transpose(0, 2, 1)
        roots[h, :, :3, :3] = C @ world
        away = place - cameras[:, :3, 3]
        roots[h, :, :3, 3] = np.einsum("tij,tj->ti", C, away)
    cameras[:, :3, 3] /= scale
    return scale, cameras, roots, poses


def make_tracks(frames, cameras, scale, rng, per_frame=9.6):
    """Points seen in a run of frames each; about 10 new ones a frame."""
    count = int(per_frame * frames)
    start = rng.integers(-int(TRACK) // 2, frames - 2, count)
    length = np.clip(rng.gamma(4.0, TRACK / 4, count), 4, 3 * TRACK).astype(int)
    stop = np.minimum(start + length, frames)
    start = np.maximum(start, 0)
    keep = stop - start >= 3
    start, stop = start[keep], stop[keep]
    middle = (start + stop) // 2
    u = rng.uniform([40, 40], [1240, 680], (len(start), 2))
    depth = rng.uniform(3.0, 14.0, len(start)) / scale
    ray = np.concatenate(
        [(u - INTRINSICS[2:]) / INTRINSICS[:2], np.ones((len(u), 1))], 1
    )
    camera = cameras[middle]
    points = camera[:, :3, 3] + np.einsum(
        "mij,mj->mi", camera[:, :3, :3], ray * depth[:, None]
    )
    landmark = np.repeat(np.arange(len(start)), stop - start)
    frame = np.concatenate([np.arange(a, b) for a, b in zip(start, stop, strict=True)])
    return points, frame, landmark


def make(
    frames,
    people=1,
    seed=0,
    dtype=np.float64,
    outliers=0.03,
    loss=None,
    draw=0,
    noise=1.0,
):
    """A problem, its true state, and a start; `draw` numbers the noise on one scene,
    and `noise` multiplies it, with the sigmas."""
    rng = np.random.default_rng(seed)
    scale, cameras, roots, poses = make_scene(frames, people, rng)
    points, frame, landmark = make_tracks(frames, cameras, scale, rng)
    array = lambda x: jnp.asarray(np.asarray(x, dtype))
    truth = g.State(
        scale=array(scale),
        cameras=array(cameras),
        roots=array(roots),
        poses=array(poses),
        shapes=array(0.5 * rng.standard_normal((people, 10))),
        landmarks=array(points),
        intrinsics=array(INTRINSICS),
    )
    camera = cameras[frame]
    p_C = np.einsum(
        "mji,mj->mi", camera[:, :3, :3], points[landmark] - camera[:, :3, 3]
    )
    pixel = np.array(project(truth.intrinsics, array(p_C)), float)
    seen = p_C[:, 2] > 0.3
    missing = rng.random((people, frames, 25)) < 0.1
    rng = np.random.default_rng((seed, draw))
    pixel += noise * rng.standard_normal(pixel.shape)
    wrong = rng.random(len(pixel)) < outliers
    pixel[wrong] += rng.uniform(-80, 80, (wrong.sum(), 2))
    frame, landmark, pixel = frame[seen], landmark[seen], pixel[seen]
    factors: list = [
        g.Reprojection(
            frame=jnp.asarray(frame),
            landmark=jnp.asarray(landmark),
            pixel=array(pixel),
            sigma=array(np.full(len(frame), noise)),
            loss=g.Cauchy(1.5) if loss is None else loss,
        )
    ]
    if people:
        factors += person(truth, missing, rng, array, loss, noise)
    problem = g.make_problem(factors, truth)
    return problem, truth, start_of(problem, truth, rng, array)


def person(truth, missing, rng, array, loss, noise):
    h, t = truth.roots.shape[:2]
    body = load_body_model(dtype=truth.scale.dtype)
    p_H = local_keypoints(body, truth.poses, truth.shapes[:, None], "body25")
    p_C = jnp.einsum("htij,htkj->htki", truth.roots[..., :3, :3], p_H)
    pixel = project(truth.intrinsics, p_C + truth.roots[..., None, :3, 3])
    pixel = np.asarray(pixel, float) + 4.0 * noise * rng.standard_normal(pixel.shape)
    sigma = np.where(missing, np.inf, 4.0 * noise)
    blank = g.HumanMotion(
        translation=array(np.zeros((h, t, 3))),
        whitening=array(np.zeros((h, t, 3, 3))),
        correlation=array(np.zeros((h, t))),
    )
    moved = blank.map_frames(
        lambda d, w, s, _: g.displacement(w[1], w[0], s.scale), truth
    )
    slow = lambda size, rho, shape: noise * size * drift(rng, shape, rho)
    valid = jnp.ones((h, t), bool).at[:, 0].set(False)
    covariance = array(np.tile(np.diag(3 * [0.01 * noise]) ** 2, (h, t, 1, 1)))
    posture = g.retract_rotation(truth.poses, array(slow(0.17, 0.96, (h, t, 23, 3))))
    shape_sigma = np.full((h, t, 10), np.inf)
    shape_sigma[:, 0] = 0.5 * noise
    measured = truth.shapes[:, None] + array(
        shape_sigma[0, 0, 0] * rng.standard_normal((h, 1, 10))
    )
    return [
        g.JointReprojection(
            body=body,
            pixel=array(pixel),
            sigma=array(sigma),
            loss=g.GemanMcClure(16.0) if loss is None else loss,
        ),
        g.HumanMotion(
            translation=moved + array(slow(0.01, 0.8, (h, t, 3))),
            whitening=g.whitening_of(covariance, valid),
            correlation=g.runs(valid, 0.8).astype(truth.scale.dtype),
        ),
        g.Posture(
            rotation=posture,
            sigma=array(np.full((h, t, 23), 0.17 * noise)),
            correlation=g.runs(jnp.ones((h, t), bool), 0.96).astype(truth.scale.dtype),
        ),
        g.Shape(shape=measured + array(np.zeros((h, t, 10))), sigma=array(shape_sigma)),
    ]


def drift(rng, shape, rho):
    """AR(1) along axis 1, stationary variance 1."""
    white = rng.standard_normal(shape)
    out = np.empty(shape)
    out[:, 0] = white[:, 0]
    for k in range(1, shape[1]):
        out[:, k] = rho * out[:, k - 1] + np.sqrt(1 - rho**2) * white[:, k]
    return out


def start_of(problem, truth, rng, array):
    """What initialisation leaves: drifting cameras, points off, regressed bodies."""
    t = len(truth.cameras)
    wander = np.cumsum(rng.standard_normal((t, 6)), axis=0) * 3e-4
    zero = truth.zero_step()
    step = g.Step(
        scale=zero.scale,
        cameras=array(wander + 2e-3 * rng.standard_normal((t, 6))),
        roots=array(0.05 * rng.standard_normal(zero.roots.shape)),
        poses=zero.poses,
        shapes=array(0.5 * rng.standard_normal(zero.shapes.shape)),
        landmarks=array(0.1 * rng.standard_normal(zero.landmarks.shape)),
        intrinsics=zero.intrinsics,
    )
    moved = truth.retract(jax.tree.map(lambda s, m: s * m, step, problem.free))
    for factor in problem.factors:
        if isinstance(factor, g.Posture):
            moved = eqx.tree_at(lambda s: s.poses, moved, factor.rotation)
    return moved


def timed(run, repeats):
    """Result; wall and processor seconds of the first call (with compilation), and
    medians of `repeats` more."""
    rows = []
    for _ in range(1 + repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        result = jax.block_until_ready(run())
        rows.append((time.perf_counter() - wall, time.process_time() - cpu))
    return result, rows[0], np.median(rows[1:], axis=0)


def report(name, problem, truth, start, schedule, repeats):
    run = lambda: solve(problem, start, schedule=schedule)
    solution, first, (wall, cpu) = timed(run, repeats)
    steps = sum(int(n) for n in solution.num_steps)
    cost_of = eqx.filter_jit(lambda p, s: p.cost(s))
    cost = float(cost_of(problem, solution.state))
    print(
        f"{name:28s} {wall:7.2f} s (processor {cpu:.2f}) {wall / steps:6.3f} s/it "
        f"({cpu / steps:.3f}) {steps:3d} it  "
        f"cost {float(cost_of(problem, start)):.4g} -> {cost:.8g} "
        f"(truth {float(cost_of(problem, truth)):.6g}) "
        f"s {float(solution.state.scale):.4f}/{float(truth.scale):.4f} "
        f"{solution.status}; compile {first[0] - wall:.1f} s "
        f"(processor {first[1] - cpu:.1f})",
        flush=True,
    )
    return solution


def peers(frames, python, repeats, rtol):
    """Ceres and this solver, in turn, on one problem; costs by one function."""
    problem, truth, start = make(frames, 0)
    (factor,) = (f for f in problem.factors if isinstance(f, g.Reprojection))
    assert isinstance(factor.loss, g.Cauchy)
    cost_of = eqx.filter_jit(lambda s: problem.cost(s))
    with tempfile.TemporaryDirectory() as folder:
        given, found = Path(folder) / "problem.npz", Path(folder) / "result.npz"
        np.savez(
            given,
            cameras=start.cameras,
            points=start.landmarks,
            intrinsics=start.intrinsics,
            frame=factor.frame,
            landmark=factor.landmark,
            pixel=factor.pixel,
            loss=factor.loss.scale,
            rtol=rtol,
        )
        script = Path(__file__).with_name("peer_ceres.py")
        times = []
        for _ in range(repeats):
            subprocess.run([python, str(script), str(given), str(found)], check=True)
            with np.load(found) as archive:
                result = dict(archive)
            times.append((float(result["seconds"]), float(result["processor"])))
    fields = lambda s: (s.cameras, s.landmarks)
    there = jnp.asarray(result["cameras"]), jnp.asarray(result["points"])
    cost = float(cost_of(eqx.tree_at(fields, start, there)))
    wall, cpu = np.median(times, axis=0)
    solves = int(result["solves"])
    print(
        f"{frames:5d} Ceres ({result['versions']}) {wall:7.2f} s (processor {cpu:.2f}) "
        f"{solves} solves, {wall / solves:.3f} s each; cost {cost:.8g}",
        flush=True,
    )
    for dtype in (np.float64, np.float32):
        half = lambda tree, dtype=dtype: jax.tree.map(
            lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, tree
        )
        run = lambda: solve(half(problem), half(start), schedule=(Stage(rtol=rtol),))
        solution, first, (wall, cpu) = timed(run, repeats)
        steps = int(solution.num_steps[0])
        mine = float(cost_of(half(solution.state, np.float64)))
        print(
            f"{frames:5d} structured {np.dtype(dtype).name} {wall:7.2f} s "
            f"(processor {cpu:.2f}) {steps} steps, {wall / steps:.3f} s each; "
            f"cost {mine:.8g} ({mine / cost - 1:+.2%}); {solution.status}; "
            f"compile {first[0] - wall:.1f} s (processor {first[1] - cpu:.1f})",
            flush=True,
        )


def calibration(frames, draws, noise=1.0):
    """Errors over what the covariances say, on simulated noise that is as the weights
    have it: per group the mean normalised error squared (1 is right) and the share of
    coordinates within 1.96 standard deviations (0.95 is right)."""
    squares, inside = {}, {}
    for draw in range(draws):
        scene = make(frames, outliers=0.0, loss=g.Squared(), draw=draw, noise=noise)
        problem, truth, _ = scene
        found = solve(problem, truth, schedule=(Stage(rtol=1e-9),)).state
        spread = marginals(problem, found)
        place = lambda s: g.world_from_root(s)[..., :3, 3]
        rows = {
            "scale": (found.scale - truth.scale, spread.scale[None]),
            "cameras": (
                metric(found, "cameras") - metric(truth, "cameras"),
                spread.cameras,
            ),
            "people": (place(found) - place(truth), spread.people),
            "shape": (found.shapes - truth.shapes, spread.shapes),
            "landmarks": (
                metric(found, "landmarks") - metric(truth, "landmarks"),
                spread.landmarks,
            ),
        }
        for name, (error, covariance) in rows.items():
            error, covariance = np.atleast_1d(error), np.asarray(covariance)
            d = error.shape[-1]
            error = error.reshape(-1, d)
            covariance = covariance.reshape(-1, d, d)
            deviation = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
            # The gauge is exact, and what is not seen is not known at all.
            known = (deviation > 1e-9).all(axis=1) & (deviation < 1.0).all(axis=1)
            solved = np.linalg.solve(covariance[known], error[known][..., None])[..., 0]
            squares.setdefault(name, []).extend(np.sum(error[known] * solved, 1) / d)
            share = abs(error[known]) < 1.96 * deviation[known]
            inside.setdefault(name, []).extend(share.ravel())
    print(f"{frames} frames, {draws} draws of the noise")
    for name, values in squares.items():
        print(f"  {name:10s} {np.mean(values):6.3f} {np.mean(inside[name]):6.3f}")
    return {name: (np.mean(v), np.mean(inside[name])) for name, v in squares.items()}


def metric(state, name):
    """Camera centres or landmarks in metres."""
    value = getattr(state, name)
    return state.scale * (value[:, :3, 3] if name == "cameras" else value)


def breakdown(problem, state, repeats):
    """Where an iteration spends its time: each part compiled and timed by itself."""
    problem, state = pad(problem, state)
    sizes = sizes_of(problem, state)
    rows = []

    def part(name, function, *arrays):
        result, _, (wall, cpu) = timed(
            functools.partial(eqx.filter_jit(function), *arrays), repeats
        )
        rows.append((name, wall, cpu))
        print(f"  {name:24s} {wall:7.4f} s (processor {cpu:.4f})", flush=True)
        return result

    seen = gather(problem)
    part("cost of a trial", lambda p, s: p.cost(s), problem, state)
    lin = part("residuals and Jacobians", linearise, problem, seen, state)
    damping = damped(diagonals(lin, sizes), jnp.asarray(1e-4, state.scale.dtype))
    reduced = part(
        "landmarks",
        eliminate_landmarks,
        problem,
        lin.landmarks,
        damping["landmarks"],
        sizes,
    )
    postures, border = None, border_of(lin, sizes)
    if "pose" in damping:
        postures = part("postures", eliminate_postures, lin, sizes, damping["pose"])
    chunks = part("assembly", assemble, lin, sizes, reduced, postures, border, damping)
    factor = part("factorisation", factorise, chunks, sizes)
    whole = Eliminated(damping, postures, border, factor)
    part("back-substitution", solve_step, problem, state, lin, sizes, whole)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "what", choices=["landmarks", "joint", "breakdown", "peers", "calibration"]
    )
    parser.add_argument("--frames", type=int, nargs="+", default=[100, 300, 1000])
    parser.add_argument("--float32", action="store_true")
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--rtol", type=float, default=1e-6)
    parser.add_argument("--peer-python", help="has pyceres and pycolmap")
    args = parser.parse_args()
    dtype = np.float32 if args.float32 else np.float64
    jax.config.update("jax_enable_x64", not args.float32)
    for frames in args.frames:
        if args.what == "calibration":
            calibration(frames, args.repeats)
            continue
        if args.what == "peers":
            peers(frames, args.peer_python, args.repeats, args.rtol)
            continue
        people = 0 if args.what == "landmarks" else 1
        problem, truth, start = make(frames, people, dtype=dtype)
        count = sum(
            len(f.frame) for f in problem.factors if isinstance(f, g.Reprojection)
        )
        name = f"{frames} / {len(truth.landmarks)} / {count} {np.dtype(dtype).name}"
        if args.what == "breakdown":
            print(name)
            breakdown(problem, start, args.repeats)
            continue
        schedule = (Stage(rtol=args.rtol),)
        report(name, problem, truth, start, schedule, args.repeats)


if __name__ == "__main__":
    main()
