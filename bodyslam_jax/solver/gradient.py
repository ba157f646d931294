"""A linearisation whose right-hand side is another gradient.

The implicit derivative solves the solver's own normal equations for right-hand sides
that no factor has.
"""

import equinox as eqx
import jax.numpy as jnp

from bodyslam_jax.graph import Problem
from bodyslam_jax.solver.blocks import Linearisation, Sizes, globals_of
from bodyslam_jax.solver.linear_system import Move


def with_gradient(
    problem: Problem, lin: Linearisation, sizes: Sizes, move: Move
) -> Linearisation:
    """The same blocks of `J^T J`, with the gradient `move`."""
    step, gradient = move.step, {}
    for name, known in lin.gradient.items():
        if name == "pose":
            gradient[name] = move.postures
        elif name == "root":
            gradient[name] = step.roots
        else:
            gradient[name] = jnp.zeros_like(known)
    if "camera_alone" in gradient:
        gradient["camera_alone"] = step.cameras
    elif "camera" in gradient:
        gradient["camera"] = gradient["camera"].at[0].set(step.cameras)
    common = globals_of(step, sizes)
    # Padding points at a row of zeros, so that groups are filled by plain gathering.
    tables = tuple(
        eqx.tree_at(
            lambda t: t.gradient,
            table,
            jnp.moveaxis(step.landmarks[bucket.landmark], 1, 2),
        )
        for bucket, table in zip(problem.layout.buckets, lin.landmarks, strict=True)
    )
    names = "gradient", "globals_gradient", "landmarks"
    return eqx.tree_at(
        lambda lin: [getattr(lin, name) for name in names],
        lin,
        [gradient, common, tables],
    )
