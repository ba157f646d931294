"""Cameras and landmarks by jaxls: a peer of the solver.

    python peer_jaxls.py problem.npz result.npz

Run by `bench_solver.py peers --peer-python PYTHON`, where PYTHON has `jaxls` (the
solver, not the language server of that name) and NumPy. Its conjugate gradients with
block-Jacobi preconditioning, float64; the gauge is left to its damping. jaxls has no
robust losses: residuals are lifted, so that their squared norm is the Cauchy cost.
"""

import importlib.metadata
import sys
import time

import jax
import jax.numpy as jnp
import jaxlie
import jaxls
import numpy as np

DAMPING = 1.0
"""At the start. With its default, 5e-4, it is 7 % above the least cost after 100 steps
at 100 frames, with 1 it is 0.1 % above."""


class Point(jaxls.Var[jax.Array], default_factory=lambda: jnp.zeros(3)):
    """A landmark in the world."""


@jaxls.Cost.factory
def reprojection(values, camera, point, pixel, intrinsics, loss, min_depth):
    """The lifted residual: `[sqrt(w) r, sqrt(rho - w s)]`, `w = rho'(s)` held."""
    p_C = values[camera] @ values[point]
    xy = p_C[:2] / jnp.maximum(p_C[2], min_depth)
    residual = intrinsics[:2] * xy + intrinsics[2:] - pixel
    s, c2 = jax.lax.stop_gradient(residual @ residual), loss**2
    weight = 1 / (1 + s / c2)
    rest = jnp.sqrt(jnp.maximum(c2 * jnp.log1p(s / c2) - weight * s, 0))
    return jnp.append(jnp.sqrt(weight) * residual, rest)


def main(source, target):
    with np.load(source) as archive:
        data = dict(archive)
    limit, rtol = int(data.pop("steps")), float(data.pop("rtol"))
    data = {name: jnp.asarray(array) for name, array in data.items()}
    camera = jaxls.SE3Var(jnp.arange(len(data["cameras"])))
    seen = jnp.unique(data["landmark"])
    point = Point(seen)
    given = [data[name][None] for name in ("intrinsics", "loss", "min_depth")]
    cost = reprojection(
        jaxls.SE3Var(data["frame"]), Point(data["landmark"]), data["pixel"], *given
    )
    start = [
        camera.with_value(jaxlie.SE3.from_matrix(data["cameras"]).inverse()),
        point.with_value(data["points"][seen]),
    ]
    found, measured = solve([cost], start, limit, rtol)
    np.savez(
        target,
        cameras=found[camera].inverse().as_matrix(),
        points=data["points"].at[seen].set(found[point]),
        **measured,
    )


def solve(costs, start, limit, rtol):
    """The values found, and what `bench_solver.py` asks of a peer: seconds of it all,
    cost by time, steps, versions."""
    variables = [known.variable for known in start]
    problem = jaxls.LeastSquaresProblem(costs, variables).analyze()
    start = jaxls.VarValues.make(start)

    def run(rtol):
        clock = lambda: np.array([time.perf_counter(), time.process_time()])
        before = clock()
        result = problem.solve(
            start,
            verbose=False,
            return_summary=True,
            trust_region=jaxls.TrustRegionConfig(lambda_initial=DAMPING),
            termination=jaxls.TerminationConfig(
                max_iterations=limit,
                cost_tolerance=rtol,
                gradient_tolerance=0.0,
                parameter_tolerance=0.0,
            ),
        )
        jax.block_until_ready(result)
        return result, clock() - before

    # Stops after one step: compilation, and little else.
    _, first = run(np.inf)
    (found, summary), spent = run(rtol)
    steps = int(summary.iterations)
    # Its history has rejected trials too (damping rises after one), not the last cost.
    trials, damping = np.asarray(summary.cost_history), summary.lambda_history
    kept = damping[2:steps] <= damping[1 : steps - 1]
    last = np.sum(problem.compute_residual_vector(found) ** 2)
    costs = np.where(kept, trials[1 : steps - 1], np.inf)
    costs = 0.5 * np.minimum.accumulate([trials[0], *costs, np.inf, last])
    seconds = spent[0] * np.arange(len(costs)) / steps
    return found, {
        "seconds": spent[0],
        "processor": spent[1],
        "compilation": first,
        "rows": np.stack([seconds, costs], axis=1),
        "solves": steps,
        "capped": steps >= limit,
        "versions": f"{release()}, jax {jax.__version__}",
    }


def release():
    """Which distribution the module `jaxls` is from: there are forks."""
    names = set(importlib.metadata.packages_distributions()["jaxls"]) - {"jaxls"}
    name = next(iter(names), "jaxls")
    return f"{name} {importlib.metadata.version(name)}"


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    # Compilation is timed, so must take place.
    jax.config.update("jax_enable_compilation_cache", False)
    main(*sys.argv[1:])
