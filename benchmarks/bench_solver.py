"""How fast is the solver, and at the same cost as whom?

    python benchmarks/bench_solver.py landmarks --frames 100 300 1000
    python benchmarks/bench_solver.py joint --frames 300 1000
    python benchmarks/bench_solver.py joint --frames 300 --cache FOLDER  # twice
    python benchmarks/bench_solver.py joint --frames 1000 --mixed
    python benchmarks/bench_solver.py breakdown --frames 1000
    python benchmarks/bench_solver.py landmarks --frames 1000 --tracks long
    python benchmarks/bench_solver.py landmarks --frames 300 --tracks deep --mixed
    python benchmarks/bench_solver.py peers --peers ceres jaxls --peer-python PYTHON
    python benchmarks/bench_solver.py baselines --frames 100 --baselines 1e-2x10 cg
    python benchmarks/bench_solver.py baselines --baselines jaxls --peer-python PYTHON
    python benchmarks/bench_solver.py scales --frames 300
    python benchmarks/bench_solver.py growth
    python benchmarks/bench_solver.py calibration --frames 20 --repeats 60
    python benchmarks/bench_solver.py marginalise --frames 60

Compilation is outside the clock and given by itself; all solvers' results are judged by
one cost function. With `--cache` a second run tells what loading the program takes in
place of compiling it. Processor time is beside wall time, which on a shared machine
says little.
"""

import argparse
import functools
import resource
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import solver_joint_peers
import solver_peers
from solver_calibration import calibration
from solver_clock import timed
from solver_scene import SECOND, make

import bodyslam_jax.graph as g
from bodyslam_jax.solver import Stage, marginalise, solve, vmap_over_devices
from bodyslam_jax.solver.block_cholesky import factorise
from bodyslam_jax.solver.blocks import cast, sizes_of
from bodyslam_jax.solver.elimination.person import eliminate_people
from bodyslam_jax.solver.elimination.schur import eliminate_landmarks, half_inverses
from bodyslam_jax.solver.front import window_of
from bodyslam_jax.solver.linear_system import Eliminated, damped, diagonals, solve_step
from bodyslam_jax.solver.linearise import linearise
from bodyslam_jax.solver.linearise.landmark import gather
from bodyslam_jax.solver.padding import pad
from bodyslam_jax.solver.reduced_system import assemble
from bodyslam_jax.solver.second_order import curvature_of


def report(name, problem, truth, start, schedule, mixed, repeats):
    run = lambda: solve(problem, start, schedule=schedule, mixed_precision=mixed)
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


def breakdown(problem, state, mixed, repeats):
    """Where an iteration spends its time: each part compiled and timed by itself."""
    problem, state = pad(problem, state)
    sizes = sizes_of(problem, state, np.dtype(np.float32) if mixed else None)
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
    lin = part("residuals and Jacobians", linearise, problem, seen, state, sizes.dtype)
    bent = lambda p, lin, s: curvature_of(p, lin, s, sizes)
    part("what keypoints bend", bent, problem, lin, state)
    damping = damped(diagonals(lin, sizes), jnp.asarray(1e-4, state.scale.dtype))
    lin, damping = cast((lin, damping), sizes.dtype)
    halves = half_inverses(lin.landmarks, damping["landmarks"])
    given = problem, lin.landmarks, halves, damping["landmarks"], sizes
    reduced = part("landmarks", eliminate_landmarks, *given)
    people, window = None, window_of(lin, sizes)
    if sizes.people:
        people = part("people", eliminate_people, lin, sizes, window, damping)
    kept = None if people is None else people.kept
    given = lin, sizes, reduced, kept, window, damping, problem.layout.order
    chunks = part("assembly", assemble, *given)
    factor = part("factorisation", factorise, chunks, sizes, problem.layout)
    whole = Eliminated(halves, window, people, factor)
    part("back-substitution", solve_step, problem, state, lin, sizes, whole)


def scales(frames, rtol, repeats, factors=(0.4, 0.63, 0.79, 1.26, 1.59, 2.5)):
    """Starts with other scales, in one program and one after another."""
    problem, _, start = make(frames, 1)
    starts = [eqx.tree_at(lambda s: s.scale, start, start.scale * f) for f in factors]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *starts)
    one = lambda problem, s: solve(problem, s, schedule=(Stage(rtol=rtol),))
    mapped = vmap_over_devices(one, (None, 0))
    found, _, (wall, cpu) = timed(lambda: mapped(problem, batch), repeats)
    sequential_vmap = lambda: [one(problem, s) for s in starts]
    turn, _, (turn_wall, turn_cpu) = timed(sequential_vmap, repeats)
    alone = [float(s.cost) for s in turn]
    print(
        f"{frames} frames, {len(factors)} scales: on {len(jax.devices())} devices "
        f"{wall:.2f} s (processor {cpu:.2f}), {found.num_steps[0]} steps, costs "
        f"{found.cost}; in turn {turn_wall:.2f} s (processor {turn_cpu:.2f}), "
        f"{[int(s.num_steps[0]) for s in turn]} steps, costs {alone}; ratio "
        f"{wall / turn_wall:.2f} (processor {cpu / turn_cpu:.2f})",
        flush=True,
    )


def growth(sizes, steps, mixed):
    """Time of an iteration and peak memory of the joint problem, each size in a process
    of its own."""
    for frames in sizes:
        command = [sys.executable, __file__, "one", "--frames", str(frames)]
        options = ["--steps", str(steps), *["--mixed"] * mixed]
        subprocess.run([*command, *options], check=True)


def first_chunk(frames, repeats):
    """Time to make a prior of the first ten frames, of cameras alone and with a person,
    and of a step on what is left, with the prior and without."""
    for people in (0, 1):
        problem, truth, _ = make(frames, people)
        run = functools.partial(marginalise, problem, truth, g.CHUNK)
        left, first, (wall, cpu) = timed(run, repeats)
        prior = left.problem.factors[-1]
        print(
            f"{frames} frames, {people} people: {int((prior.root != 0).any(0).sum())} "
            f"coordinates stay, {wall:.3f} s (processor {cpu:.3f}), compile "
            f"{first[0] - wall:.1f} s (processor {first[1] - cpu:.1f})",
            flush=True,
        )
        schedule = (Stage(max_steps=6, rtol=0.0),)
        for name, rest in (
            ("with it", left.problem),
            ("without", problem),
        ):
            state = left.state if name == "with it" else truth
            one = functools.partial(solve, rest, state, schedule=schedule)
            found, _, (wall, cpu) = timed(one, repeats)
            count = int(found.num_steps[0])
            print(
                f"  {name}: {wall / count:.4f} s a step (processor {cpu / count:.4f})",
                flush=True,
            )


def one(frames, steps, mixed):
    problem, _, start = make(frames, 1)
    peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    before = peak()
    schedule = (Stage(max_steps=steps, rtol=0.0),)
    run = lambda: solve(problem, start, schedule=schedule, mixed_precision=mixed)
    solution, _, (wall, cpu) = timed(run, 3)
    count = int(solution.num_steps[0])
    print(
        f"{frames} frames: {wall / count:.3f} s an iteration (processor "
        f"{cpu / count:.3f}, {count} iterations), peak {peak():.2f} GiB "
        f"({before:.2f} before the first solve)",
        flush=True,
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    subjects = "landmarks joint breakdown peers baselines scales growth one"
    subjects += " calibration marginalise"
    parser.add_argument("what", choices=subjects.split())
    parser.add_argument("--frames", type=int, nargs="+", default=[100, 300, 1000])
    parser.add_argument("--float32", action="store_true")
    parser.add_argument(
        "--mixed",
        action="store_true",
        help="in double precision, but for steps (landmarks, joint, breakdown, growth)",
    )
    parser.add_argument(
        "--tracks",
        choices=["short", "long", "again", "far", "corridor", *SECOND],
        default="short",
        help="some last long, or go on on the way back, or a few all the time; or of "
        "a second generator (landmarks, joint, breakdown, peers)",
    )
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument(
        "--draw", type=int, default=0, help="of the noise (landmarks, joint, breakdown)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the scene (peers)")
    parser.add_argument("--rtol", type=float, default=1e-6)
    parser.add_argument("--steps", type=int, default=8)
    parser.add_argument("--noise", type=float, default=1.0, help="of `calibration`")
    parser.add_argument(
        "--robust", action="store_true", help="`calibration` with outliers"
    )
    parser.add_argument(
        "--baselines",
        nargs="+",
        default=["1e-2", "1e-2x10", "cg"],
        help="rates of Adam (x10: for ten times as long), `cg`, `jaxls`",
    )
    parser.add_argument(
        "--peers", nargs="+", choices=solver_peers.PEERS, default=solver_peers.PEERS
    )
    parser.add_argument("--peer-python", help="has what `peer_*.py` ask for")
    parser.add_argument("--peer-steps", type=int, default=100, help="at most")
    parser.add_argument(
        "--devices", type=int, default=2, help="that the CPU is to JAX, for `scales`"
    )
    parser.add_argument("--cache", help="keep programs in this folder, as commands do")
    args = parser.parse_args()
    dtype = np.float32 if args.float32 else np.float64
    jax.config.update("jax_enable_x64", not args.float32)
    jax.config.update("jax_compilation_cache_dir", args.cache)
    if args.what == "scales":
        jax.config.update("jax_num_cpu_devices", args.devices)
    if args.what == "growth":
        growth(args.frames, args.steps, args.mixed)
        return
    others = {
        "calibration": lambda n: calibration(n, args.repeats, args.noise, args.robust),
        "peers": lambda n: solver_peers.peers(
            n,
            args.peers,
            args.peer_python,
            args.repeats,
            args.rtol,
            args.peer_steps,
            args.tracks,
            args.seed,
        ),
        "baselines": lambda n: solver_joint_peers.joint(
            n, args.rtol, args.baselines, args.peer_python, args.peer_steps
        ),
        "scales": lambda n: scales(n, args.rtol, args.repeats),
        "marginalise": lambda n: first_chunk(n, args.repeats),
        "one": lambda n: one(n, args.steps, args.mixed),
    }
    for frames in args.frames:
        if args.what in others:
            others[args.what](frames)
            continue
        people = 0 if args.what == "landmarks" else 1
        kind = dict(tracks=args.tracks, draw=args.draw)
        problem, truth, start = make(frames, people, dtype=dtype, **kind)
        count = sum(
            len(f.frame) for f in problem.factors if isinstance(f, g.Reprojection)
        )
        name = f"{frames} / {len(truth.landmarks)} / {count} {np.dtype(dtype).name}"
        name += ", mixed" if args.mixed else ""
        if args.what == "breakdown":
            print(name)
            breakdown(problem, start, args.mixed, args.repeats)
            continue
        schedule = (Stage(rtol=args.rtol),)
        report(name, problem, truth, start, schedule, args.mixed, args.repeats)


if __name__ == "__main__":
    main()
