"""How many bodies a second: ours, `smplx` (PyTorch) and `smplfitter` (JAX, Numba).

    python benchmarks/bench_body.py [--peer-python PYTHON] [--batch 1 64 1024]

All compute the same body, the default one in SMPL's layout, in float32. The peers are
no dependencies: name an interpreter that has them (or set BODYSLAM_PEER_PYTHON); one
that is missing is left out with a line. Every program runs alone in a process of its
own, one after another, `--rounds` times; the best time of each case is kept,
because a shared machine only ever adds time. Compilation is outside the clock and
reported. "Forward+backward" is the gradient of a sum of squares by pose, β and
translation. Prints a Markdown table.
"""

import argparse
import json
import os
import pickle
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

PROGRAMS = {
    "ours": "ours",
    "ours, with pose blend shapes": "ours_pose_dirs",
    "smplx": "smplx",
    "smplfitter (JAX)": "smplfitter_jax",
    "smplfitter (Numba)": "smplfitter_numba",
}
TASKS = ("joints", "vertices, one β", "vertices, β per frame")


def bodies(batch):
    rng = np.random.default_rng(0)
    draw = lambda n, s: (s * rng.normal(size=(batch, n))).astype(np.float32)
    return draw(72, 0.4), draw(10, 1.0), draw(3, 1.0)


def clock(call):
    """Seconds of the first call, and of the fastest of several more."""
    start = time.perf_counter()
    call()
    first, times = time.perf_counter() - start, []
    while len(times) < 3 or (sum(times) < 1.5 and len(times) < 50):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return first, min(times)


def jax_cases(functions, batches):
    """Times of `{task: function(pose, beta, trans)}`, jitted here."""
    import jax

    for task, function in functions.items():
        for batch in batches:
            pose, beta, trans = map(jax.numpy.asarray, bodies(batch))
            args = (pose, beta[0] if "one β" in task else beta, trans)
            loss = lambda *a, f=function: (f(*a) ** 2).sum()
            for name, f in (
                ("forward", jax.jit(function)),
                ("forward+backward", jax.jit(jax.grad(loss, (0, 1, 2)))),
            ):
                first, best = clock(lambda f=f, a=args: jax.block_until_ready(f(*a)))
                yield task, batch, name, best, first - best


def ours(folder, batches, file="SMPL_NEUTRAL.npz"):
    from bodyslam_jax import body

    model = body.load_body_model(folder / file, dtype="float32")
    vertices = lambda *a: body.vertices(model, *a)
    joints = lambda *a: body.joints(model, *a)
    yield from jax_cases(dict(zip(TASKS, (joints, vertices, vertices))), batches)


def ours_pose_dirs(folder, batches):
    cases = ours(folder, batches, "SMPL_FEMALE.npz")
    yield from (case for case in cases if case[0] != "joints")


def smplfitter_jax(folder, batches):
    from smplfitter.jax import BodyModel

    model = BodyModel("smpl", "neutral", model_root=str(folder))
    joints = lambda *a: model(*a, return_vertices=False)["joints"]
    vertices = lambda *a: model(*a)["vertices"]
    yield from jax_cases({TASKS[0]: joints, TASKS[2]: vertices}, batches)


def smplfitter_numba(folder, batches):
    from smplfitter.nb import BodyModel

    model = BodyModel("smpl", "neutral", model_root=str(folder))
    for task, with_vertices in ((TASKS[0], False), (TASKS[2], True)):
        for batch in batches:
            a = bodies(batch)
            call = lambda a=a, v=with_vertices: model(*a, return_vertices=v)
            first, best = clock(call)
            yield task, batch, "forward", best, first - best


def smplx(folder, batches):
    import torch
    from smplx import lbs

    torch.set_num_threads(os.cpu_count() or 1)
    raw = dict(np.load(folder / "SMPL_NEUTRAL.npz"))
    tensor = lambda x: torch.tensor(np.asarray(x, np.float32))
    parents = torch.tensor(raw["kintree_table"][0].astype(np.int64))
    parents[0] = -1
    template, shape_dirs = tensor(raw["v_template"]), tensor(raw["shapedirs"])
    pose_dirs = tensor(raw["posedirs"].reshape(-1, 207).T)
    regressor, weights = tensor(raw["J_regressor"]), tensor(raw["weights"])
    J_0 = regressor @ template
    J_s = torch.einsum("jv,vcs->jcs", regressor, shape_dirs)

    def vertices(pose, beta, trans):
        v, _ = lbs.lbs(
            *(beta, pose, template, shape_dirs, pose_dirs, regressor, parents, weights)
        )
        return v + trans[:, None]

    def joints(pose, beta, trans):
        R = lbs.batch_rodrigues(pose.reshape(-1, 3)).reshape(len(pose), 24, 3, 3)
        rest = J_0 + torch.einsum("jcs,bs->bjc", J_s, beta)
        posed, _ = lbs.batch_rigid_transform(R, rest, parents)
        return posed + trans[:, None]

    for task, function in ((TASKS[0], joints), (TASKS[2], vertices)):
        for batch in batches:
            args = [torch.tensor(x, requires_grad=True) for x in bodies(batch)]

            def forward(function=function, args=args):
                with torch.no_grad():
                    function(*args)

            def backward(function=function, args=args):
                torch.autograd.grad((function(*args) ** 2).sum(), args)

            for name, call in (("forward", forward), ("forward+backward", backward)):
                first, best = clock(call)
                yield task, batch, name, best, first - best


def write_models(folder):
    """The default body for everyone; once more with pose blend shapes that act."""
    from bodyslam_jax import body

    model = body.load_body_model(dtype="float32")
    body.write_npz(model, folder / "SMPL_NEUTRAL.npz")
    raw = dict(np.load(folder / "SMPL_NEUTRAL.npz"))
    np.save(folder / "kid_template.npy", np.zeros_like(raw["v_template"]))
    name = "basicmodel_neutral_lbs_10_207_0_v1.1.0.pkl"
    root = raw["kintree_table"].astype(np.int64)
    root[0, 0] = -1
    (folder / name).write_bytes(pickle.dumps(dict(raw, kintree_table=root)))
    rng = np.random.default_rng(0)
    raw["posedirs"] = 0.001 * rng.normal(size=raw["posedirs"].shape).astype(np.float32)
    np.savez(folder / "SMPL_FEMALE.npz", **raw)


def rate(seconds, batch):
    value = batch / seconds
    return f"{value:,.0f}" if value >= 10 else f"{value:.1f}"


def table(best, batches):
    names = [n for n in PROGRAMS if any(key[0] == n for key in best)]
    direction = ("forward", "forward+backward")
    lines = ["| bodies a second | batch | |" + "".join(f" {n} |" for n in names)]
    lines.append("|---|---|---|" + "---|" * len(names))
    for task in TASKS:
        for batch in batches:
            for way in direction:
                cells = []
                for n in names:
                    # The peers compute a β per frame, whether it is one or not.
                    own = best.get((n, task, batch, way))
                    found = own or best.get((n, TASKS[2], batch, way))
                    if task == TASKS[0] and own is None:
                        found = None
                    cells.append("–" if found is None else rate(found[0], batch))
                row = "".join(f" {c} |" for c in cells)
                lines.append(f"| {task} | {batch:,} | {way} |" + row)
    longest = {
        n: max(v[1] for k, v in best.items() if k[0] == n and v[1] is not None)
        for n in names
    }
    row = "".join(f" {longest[n]:.1f} |" for n in names)
    return "\n".join([*lines, "| longest compilation, s | | |" + row])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--batch", type=int, nargs="+", default=[1, 64, 1024])
    parser.add_argument("--rounds", type=int, default=2)
    peer = os.environ.get("BODYSLAM_PEER_PYTHON", sys.executable)
    parser.add_argument("--peer-python", default=peer)
    parser.add_argument("--only", nargs="+", default=list(PROGRAMS))
    parser.add_argument("--worker", nargs=2, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        program, folder = args.worker
        for case in globals()[program](Path(folder), args.batch):
            print(json.dumps(case), flush=True)
        return
    best = {}
    with tempfile.TemporaryDirectory() as folder:
        write_models(Path(folder))
        for _ in range(args.rounds):
            for name in args.only:
                is_ours = name.startswith("ours")
                command = [sys.executable if is_ours else args.peer_python, __file__]
                command += ["--worker", PROGRAMS[name], folder, "--batch"]
                command += map(str, args.batch)
                run = subprocess.run(command, capture_output=True, text=True)
                for line in run.stdout.splitlines():
                    task, batch, way, seconds, compilation = json.loads(line)
                    key = (name, task, batch, way)
                    old = best.get(key, (np.inf, np.inf))
                    best[key] = (min(old[0], seconds), min(old[1], compilation))
                if run.returncode:
                    reason = (run.stderr.strip().splitlines() or ["no reason"])[-1]
                    print(f"{name}: left out ({reason})", file=sys.stderr)
    print(f"{os.cpu_count()} CPU cores, {platform.machine()}, Python ", end="")
    print(f"{platform.python_version()}, load {os.getloadavg()[0]:.1f}\n")
    print(table(best, args.batch))


if __name__ == "__main__":
    main()
