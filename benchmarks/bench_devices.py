"""How fast is the solver on JAX's default device, in which precision, for how many?

    python benchmarks/bench_devices.py --out results.jsonl
    python benchmarks/bench_devices.py --cases joint-300-float64 batch8-100-float32
    JAX_PLATFORMS=cpu python benchmarks/bench_devices.py --cases joint-300-float64

A case is `WHAT-FRAMES-PRECISION`. `joint` is the problem of one person, cameras and
landmarks, `landmarks` the same without the person, and `batchN` the joint problem from
N starts at once, `jit(vmap(solve))`, which a CPU computes one after another. A
precision is `float64`, `float32`, or `mixed` (double, but for steps).

Solves take a fixed number of steps. Tracing, lowering and XLA's compilation are timed
apart, and without a cache of compiled programs. Each case has a process of its own and
a limit of time; its result is printed, and a line of `--out`, as soon as it is known.
With `--jobs` cases compile beside one another, but solve in turn.
"""

import argparse
import concurrent.futures
import contextlib
import fcntl
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from solver_scene import make

from bodyslam_jax.solver import Stage, solve
from bodyslam_jax.solver.compilation import quick_jit

CASES = (
    "joint-300-float64",
    "joint-300-float32",
    "batch8-100-float32",
    "batch1-100-float32",
    "batch64-100-float32",
    "batch1-100-float64",
    "batch8-100-float64",
    "batch64-100-float64",
    "joint-1000-float64",
    "joint-1000-float32",
    "landmarks-300-float64",
    "landmarks-300-float32",
    "landmarks-1000-float64",
    "landmarks-1000-float32",
    "batch8-300-float32",
    "batch64-300-float32",
    "joint-300-mixed",
    "joint-1000-mixed",
)
LOCK = "BENCH_DEVICES_LOCK"
"""Environment variable: the file whose lock a process holds while it measures."""


def starts_of(start, count):
    """That many starts of one problem, with scales from 0.7 to 1.4 of the first's."""
    factors = np.geomspace(0.7, 1.4, count) if count > 1 else np.ones(1)
    starts = [eqx.tree_at(lambda s: s.scale, start, start.scale * f) for f in factors]
    return jax.tree.map(lambda *x: jnp.stack(x), *starts)


def on_device(tree, device):
    put = lambda x: jax.device_put(x, device) if eqx.is_array(x) else x
    return jax.tree.map(put, tree)


@contextlib.contextmanager
def alone():
    """Nobody else measures meanwhile."""
    path = os.environ.get(LOCK)
    if path is None:
        yield
        return
    with open(path, "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def measure(case, steps, repeats):
    """One case in this process; a dictionary of what was found."""
    what, frames, precision = case.split("-")
    size = int(what.removeprefix("batch")) if what.startswith("batch") else 0
    dtype: type = np.float32 if precision == "float32" else np.float64
    jax.config.update("jax_enable_x64", dtype == np.float64)
    jax.config.update("jax_enable_compilation_cache", False)
    device = jax.devices()[0]
    # A scene is many small programs, which a CPU compiles sooner.
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        people = 0 if what == "landmarks" else 1
        problem, _, start = make(int(frames), people, dtype=dtype)
        start = starts_of(start, size) if size else start
    problem, start = on_device((problem, start), device)
    schedule = (Stage(max_steps=steps, rtol=0.0),)
    mixed = precision == "mixed"
    one = lambda p, s: solve(p, s, schedule=schedule, mixed_precision=mixed)
    program = quick_jit(jax.vmap(one, (None, 0)) if size else one)
    clock = time.perf_counter()
    lowered = program.lower(problem, start)
    lower = time.perf_counter() - clock
    clock = time.perf_counter()
    compiled = lowered.compile()
    compilation = time.perf_counter() - clock
    run = lambda: jax.block_until_ready(compiled(problem, start))
    walls = []
    with alone():
        solution = run()
        for _ in range(repeats):
            clock = time.perf_counter()
            solution = run()
            walls.append(time.perf_counter() - clock)
    wall = float(np.median(walls))
    cost = np.asarray(solution.cost, float)
    taken = np.asarray(solution.num_steps[0])
    memory = device.memory_stats() or {}
    return {
        "case": case,
        "device": device.device_kind,
        "jax": jax.__version__,
        "trace_and_lower_s": lower,
        "compile_s": compilation,
        "wall_s": wall,
        "wall_min_s": min(walls),
        "wall_max_s": max(walls),
        "steps": [int(taken.min()), int(taken.max())],
        # A batch takes as many steps as the longest of its problems.
        "iteration_s": wall / max(int(taken.max()), 1),
        "problems": max(size, 1),
        "problem_s": wall / max(size, 1),
        "first_cost": float(np.mean(np.asarray(solution.first_cost, float))),
        "cost": [float(cost.min()), float(cost.max())],
        "peak_GiB": memory.get("peak_bytes_in_use", 0) / 2**30 or None,
    }


def text_of(found):
    if "error" in found:
        return f"{found['case']:22s} {found['error']}"
    steps, cost = found["steps"], found["cost"]
    peak = found["peak_GiB"]
    return (
        f"{found['case']:22s} {found['iteration_s'] * 1e3:9.2f} ms/it, "
        f"{found['problem_s']:8.4f} s a problem ({steps[0]}-{steps[1]} it, wall "
        f"{found['wall_min_s']:.3f}-{found['wall_max_s']:.3f} s), cost "
        f"{found['first_cost']:.5g} -> {cost[0]:.9g} to {cost[1]:.9g}; trace and lower "
        f"{found['trace_and_lower_s']:.1f} s, compile {found['compile_s']:.1f} s"
        + (f"; peak {peak:.2f} GiB" if peak else "")
        + f"; {found['device']}, jax {found['jax']}"
    )


def in_process(case, options, until):
    """`measure` in a process of its own, ended after the limit."""
    left = min(options.limit, until - time.monotonic())
    if left < 5:
        return {"case": case, "error": "not begun: no time left"}
    command = [sys.executable, __file__, "--one", case, "--steps", str(options.steps)]
    command += ["--repeats", str(options.repeats)]
    try:
        ended = subprocess.run(command, capture_output=True, text=True, timeout=left)
    except subprocess.TimeoutExpired:
        return {"case": case, "error": f"not done after {left:.0f} s"}
    lines = ended.stdout.strip().splitlines()
    if ended.returncode or not lines:
        last = ended.stderr.strip()[-1500:] or f"exit status {ended.returncode}"
        return {"case": case, "error": last}
    return json.loads(lines[-1])


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", nargs="+", default=CASES)
    parser.add_argument("--steps", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--jobs", type=int, default=1, help="cases at the same time")
    parser.add_argument("--limit", type=float, default=240, help="of a case, s")
    parser.add_argument("--total", type=float, default=3600, help="of all cases, s")
    parser.add_argument("--out", type=Path, help="one JSON object a line is added")
    parser.add_argument("--one", metavar="CASE", help="in this process")
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measure(options.one, options.steps, options.repeats)))
        return
    until = time.monotonic() + options.total
    with (
        tempfile.NamedTemporaryFile() as lock,
        concurrent.futures.ThreadPoolExecutor(options.jobs) as pool,
    ):
        os.environ[LOCK] = lock.name
        waiting = [pool.submit(in_process, c, options, until) for c in options.cases]
        alone_s = {}
        for done in concurrent.futures.as_completed(waiting):
            found = done.result()
            print(text_of(found), flush=True)
            if options.out:
                with options.out.open("a") as file:
                    file.write(json.dumps(found) + "\n")
            if "error" not in found and found["case"].startswith("batch"):
                what, rest = found["case"].split("-", 1)
                alone_s.setdefault(rest, {})[int(what[5:])] = found["problem_s"]
    for rest, rows in alone_s.items():
        if 1 in rows:
            rates = ", ".join(f"{n}: {rows[1] / rows[n]:.2f}" for n in sorted(rows))
            print(f"throughput of {rest} per start, of one start by itself: {rates}")


if __name__ == "__main__":
    main()
