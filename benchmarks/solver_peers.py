"""The solver beside Ceres, GTSAM and jaxls on cameras and landmarks.

Costs are by one function.
"""

import subprocess
import tempfile
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from solver_clock import reached, timed
from solver_scene import make

import bodyslam_jax.graph as g
from bodyslam_jax.geometry.camera import MIN_DEPTH
from bodyslam_jax.solver import Stage, solve

NEAR = 1.001
"""Solvers are compared by the time to this multiple of the least cost of all."""

LIMIT = 600
"""Seconds that a peer's process may take."""

PEERS = ("ceres", "gtsam", "jaxls")
BLIND = ("ceres", "gtsam")
"""Those with a cost function of their own behind a camera."""


@eqx.filter_jit
def cost_of(problem, state):
    return problem.cost(state)


def peers(frames, names, python, repeats, rtol, steps, tracks, seed):
    """Peers and this solver, in turn, on one problem."""
    problem, _, start = make(frames, 0, seed, tracks=tracks)
    (factor,) = problem.factors
    assert isinstance(factor, g.Reprojection)
    count = len(np.unique(factor.landmark))
    run = lambda name, factor: run_peer(name, factor, start, python, rtol, steps)
    factor = without_lost(factor, start, [n for n in names if n in BLIND], run)
    left_out = count - len(np.unique(factor.landmark))
    problem = g.make_problem([factor], start)
    print(
        f"{frames} frames, seed {seed}, {count} landmarks less {left_out} that a peer "
        f"sends behind a camera, {len(factor.frame)} observations",
        flush=True,
    )
    found, curves, clocks, notes = {}, {}, {}, {}
    for name in names:
        try:
            runs = [run(name, factor)]
            # A run that was stopped at its cap is long, and once is enough.
            while len(runs) < repeats and not runs[0].get("capped", False):
                runs.append(run(name, factor))
        except subprocess.TimeoutExpired:
            print(f"  {name:20s} not done after {LIMIT} s", flush=True)
            continue
        result = runs[-1]
        wall, cpu = np.median([(r["seconds"], r["processor"]) for r in runs], axis=0)
        found[name] = float(cost_of(problem, state_of(result, start)))
        curves[name] = result["rows"][:, 1]
        share = result["rows"][:, 0] / result["rows"][-1, 0]
        clocks[name] = (wall * share, cpu * share)
        notes[name] = note_of(result, found[name])
    for label in ("float64", "mixed", "float32"):
        name, mixed = f"structured {label}", label == "mixed"
        p, s = cast((problem, start), np.float64 if mixed else np.dtype(label))
        ours = lambda p=p, s=s, mixed=mixed: solve(
            p, s, schedule=(Stage(rtol=rtol),), mixed_precision=mixed
        )
        solution, first, (wall, cpu) = timed(ours, repeats)
        taken = int(solution.num_steps[0])
        found[name] = float(cost_of(problem, cast(solution.state, np.float64)))
        curves[name] = np.asarray(solution.histories[0].cost[: taken + 1], float)
        share = np.arange(taken + 1) / taken
        clocks[name] = wall * share, cpu * share
        notes[name] = (
            f"{taken} steps, {solution.status}; first call "
            f"{first[0] - wall:.1f} s longer (processor {first[1] - cpu:.1f})"
        )
    table(found, curves, clocks, notes)


def note_of(result, cost):
    """Versions, solves, and whatever else is to be known of a peer's run."""
    note = f"{result['versions']}, {int(result['solves'])} linear solves"
    if result.get("capped", False):
        note += ", stopped at its cap"
    if "compilation" in result:
        wall, cpu = result["compilation"]
        note += f"; first call, of one step, {wall:.1f} s (processor {cpu:.1f})"
    own = result["rows"][-1, 1]
    if abs(own - cost) > 1e-6 * cost:
        note += f"; by its own reckoning {own:.8g}"
    return note


def table(found, curves, clocks, notes):
    """Prints costs, times in all, and times to nearly two of the costs: the least, and
    the greatest, to which all get."""
    best, worst = min(found.values()), max(found.values())
    for name, cost in found.items():
        wall, cpu = clocks[name]
        print(
            f"  {name:20s} cost {cost:.8g} ({cost / best - 1:+.2%} of the least), "
            f"{wall[-1]:.3f} s (processor {cpu[-1]:.3f}); within 0.1 %",
            end="",
        )
        for label, goal in (("the least", best), ("the greatest", worst)):
            at = reached(curves[name], NEAR * goal)
            if at is None:
                print(f" of {label} never", end=";")
            else:
                print(
                    f" of {label} after {at}: {wall[at]:.3f} s (processor "
                    f"{cpu[at]:.3f})",
                    end=";",
                )
        print(f" {notes[name]}", flush=True)


def without_lost(factor, start, names, run):
    """The factor without the landmarks that these peers send behind a camera.

    COLMAP's cost function calls such a point no error at all, and GTSAM's a constant
    one. Left out until there are none: then all minimise the same function.
    """
    while True:
        lost = []
        for name in names:
            there = state_of(run(name, factor), start)
            lost.append(np.asarray(factor.landmark)[behind(factor, there)])
        lost = np.unique(np.concatenate([*lost, np.zeros(0, int)]))
        if not len(lost):
            return factor
        factor = without(factor, lost)


def run_peer(name, factor, start, python, rtol, steps):
    """What `peer_<name>.py` finds, and how long it takes."""
    script = Path(__file__).with_name(f"peer_{name}.py")
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
            steps=steps,
            min_depth=MIN_DEPTH,
        )
        command = [python, str(script), str(given), str(found)]
        subprocess.run(command, check=True, timeout=LIMIT)
        with np.load(found) as archive:
            return dict(archive)


def state_of(result, start):
    there = jnp.asarray(result["cameras"]), jnp.asarray(result["points"])
    return eqx.tree_at(lambda s: (s.cameras, s.landmarks), start, there)


def behind(factor, state):
    """Which measurements are of points behind their camera."""
    camera = np.asarray(state.cameras)[np.asarray(factor.frame)]
    offset = np.asarray(state.landmarks)[np.asarray(factor.landmark)]
    return np.einsum("mi,mi->m", camera[:, :3, 2], offset - camera[:, :3, 3]) <= 0


def without(factor, landmarks):
    """The same factor without any measurement of these landmarks."""
    keep = ~np.isin(np.asarray(factor.landmark), landmarks)
    names = ("frame", "landmark", "pixel", "sigma")
    fields = lambda f: [getattr(f, name) for name in names]
    return eqx.tree_at(fields, factor, [x[keep] for x in fields(factor)])


def cast(tree, dtype):
    half = lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x
    return jax.tree.map(half, tree)
