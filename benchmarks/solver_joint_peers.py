"""The solver beside first-order steps, jaxls and stock optimistix on the joint problem.

Costs are by one function.
"""

import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from solver_clock import reached, timed
from solver_peers import LIMIT, NEAR, cost_of, note_of
from solver_scene import make

from bodyslam_jax.solver import Stage, baselines, restrict, solve

CG_STEPS = 50
"""Of optimistix with conjugate gradients, at most."""


def joint(frames, rtol, names, python, steps):
    """Each named peer, and when this solver is at the cost that the peer gets to.

    Of the names, `1e-2` is Adam at that rate for the paper's 200 + 100 steps, `1e-2x10`
    for ten times as many with a rate that falls to 0, `cg` optimistix.
    """
    problem, _, start = make(frames, 1)
    run = lambda: solve(problem, start, schedule=(Stage(rtol=rtol),))
    solution, _, (wall, cpu) = timed(run, 1)
    taken = int(solution.num_steps[0])
    curve = np.asarray(solution.histories[0].cost[: taken + 1])
    best = float(solution.cost)
    near = reached(curve, NEAR * best) / taken
    print(
        f"{frames} frames, joint: structured {float(solution.first_cost):.6g} -> "
        f"{best:.8g} in {taken} steps, {wall:.2f} s (processor {cpu:.2f}), within "
        f"0.1 % after {near * taken:.0f}: {near * wall:.2f} s ({near * cpu:.2f})",
        flush=True,
    )
    for name in names:
        if name == "jaxls":
            ask = lambda: joint_jaxls(frames, problem, start, python, rtol, steps)
        elif name == "cg":
            ask = lambda: joint_cg(problem, start, rtol)
        else:
            ask = lambda name=name: joint_adam(problem, start, name)
        try:
            label, costs, (its_wall, its_cpu) = ask()
        except subprocess.TimeoutExpired:
            print(f"  {name}: not done after {LIMIT} s", flush=True)
            continue
        cost, its = costs[-1], reached(costs, NEAR * best)
        at = reached(curve, cost)
        share = at / taken if at is not None else np.nan
        gets = "never" if its is None else f"after {its} steps"
        print(
            f"  {label}: cost {cost:.8g} ({cost / best - 1:+.2%}), {its_wall:.2f} s "
            f"(processor {its_cpu:.2f}), within 0.1 % {gets}; structured is there "
            f"after {at} steps, {share * wall:.2f} s (processor {share * cpu:.2f})",
            flush=True,
        )


def joint_cg(problem, start, rtol):
    """optimistix with conjugate gradients: its name, costs, and seconds."""
    stage = Stage(max_steps=CG_STEPS, rtol=rtol)

    def run():
        state, *_ = _optimistix_cg(problem, start, stage)
        return float(cost_of(problem, state))

    cost, _, seconds = timed(run, 1)
    return f"optimistix LM with CG, {CG_STEPS} steps at most", [cost], seconds


def _optimistix_cg(problem, state, stage, inner_steps=500):
    """Runs the Levenberg-Marquardt of optimistix with conjugate gradients on the normal
    equations, which converge only for unknowns scaled to columns of unit length."""
    flat, zero = baselines.flat_problem(problem, state)
    unit = _units(flat, zero)
    inner = lx.Normal(lx.CG(rtol=1e-6, atol=1e-6, max_steps=inner_steps))
    method = optx.LevenbergMarquardt(
        rtol=stage.rtol, atol=stage.rtol, linear_solver=inner
    )
    found = optx.least_squares(
        _scaled_rows, method, zero, (flat, unit), max_steps=stage.max_steps, throw=False
    )
    step = jax.tree.map(jnp.multiply, unit, found.value)
    return flat.retract(step), found.stats["num_steps"], found.result


def _scaled_rows(step, given):
    flat, unit = given
    return baselines.held_rows(jax.tree.map(jnp.multiply, unit, step), flat)


NUM_SIGN_PROBES = 64
"""Random sign vectors that estimate the lengths of columns: to about a tenth."""


@eqx.filter_jit
def _units(flat, zero):
    """One over the lengths of the columns of the Jacobian, by random signs."""
    residual, pull = jax.vjp(flat.residual, zero)
    keys = jax.random.split(jax.random.key(0), NUM_SIGN_PROBES)
    signs = lambda key: jax.random.rademacher(key, residual.shape, residual.dtype)
    squares = jax.lax.map(
        lambda key: jax.tree.map(jnp.square, pull(signs(key))[0]), keys
    )
    unit = lambda s: jnp.where(s.mean(0) > 0, jax.lax.rsqrt(s.mean(0)), 1.0)
    return jax.tree.map(unit, squares)


def joint_adam(problem, start, name):
    """First-order steps, the same."""
    rate, _, times = name.partition("x")
    times, decays = int(times or 1), bool(times)
    first_stage = ("scale", "cameras", "roots", "landmarks")
    stages = Stage(first_stage, 200 * times), Stage(max_steps=100 * times)

    def run():
        state, curves = start, []
        for stage in stages:
            held = restrict(problem, stage.free)
            state, costs = baselines.adam_curve(
                held, state, stage, float(rate), decays=decays
            )
            curves.append(np.asarray(costs))
        cost = float(cost_of(problem, state))
        return np.append(np.concatenate(curves), cost)

    costs, _, seconds = timed(run, 1)
    label = f"Adam {stages[0].max_steps} + {stages[1].max_steps}, rate {rate}"
    return label + " that falls" * decays, costs, seconds


def joint_jaxls(frames, problem, start, python, rtol, steps):
    """jaxls, the same."""
    script = Path(__file__).with_name("peer_jaxls_joint.py")
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "result.npz"
        given = [str(frames), str(steps), str(rtol), str(target)]
        subprocess.run([python, str(script), *given], check=True, timeout=LIMIT)
        with np.load(target) as archive:
            result = dict(archive)
    there = {n: jnp.asarray(result[n]) for n in vars(start) if n in result}
    cost = float(cost_of(problem, replace(start, **there)))
    costs = np.append(result["rows"][:, 1], cost)
    label = f"jaxls ({note_of(result, cost)})"
    return label, costs, (float(result["seconds"]), float(result["processor"]))
