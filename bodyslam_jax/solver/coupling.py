"""The motion model's derivative in the normal equations, where it is asked for.

A prediction depends on a window of frames, far more than two neighbours, so that its
Jacobian would fill the blocks that make the solver fast. Its share of the gradient is
one product with a vector, `(∂r̃/∂x)^T ∂cost/∂r̃`, by reverse differentiation through all
frames at once. So the gradient is exact and `J^T J` is that of frozen predictions:
steps end where the coupled cost is least, by a few steps more than with all of `J`.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp

from bodyslam_jax.graph import Problem, State, Step
from bodyslam_jax.solver.apart import split_poses
from bodyslam_jax.solver.blocks import Linearisation, mask_of


def with_coupling(problem: Problem, lin: Linearisation, state: State) -> Linearisation:
    """The same blocks, with the predictions' share in the gradient.

    The problem holds the predictions at `state`; it moves only those that are coupled.
    """
    if not problem.coupled:
        return lin
    cost = lambda step: problem.follow(state.retract(step)).cost(state)
    share = jax.grad(cost)(state.zero_step())
    free = jax.tree.map(lambda m, g: m * g, mask_of(problem), share)
    more = with_gradient(problem, lin, free)
    add = lambda a, b: a + b
    return dataclasses.replace(
        lin,
        gradient=jax.tree.map(add, lin.gradient, more.gradient),
        globals_gradient=lin.globals_gradient + more.globals_gradient,
    )


def with_gradient(problem: Problem, lin: Linearisation, step: Step) -> Linearisation:
    """The same blocks with another gradient."""
    count = lin.globals.shape[0] - 1 - step.shapes.size
    poses = split_poses(step.poses, problem.layout.joints)
    gradient = {}
    for name, known in lin.gradient.items():
        if name in poses:
            gradient[name] = poses[name]
        elif name == "root":
            gradient[name] = step.roots
        else:
            gradient[name] = jnp.zeros_like(known)
    if "camera_alone" in gradient:
        gradient["camera_alone"] = step.cameras
    elif "camera" in gradient:
        gradient["camera"] = gradient["camera"].at[0].set(step.cameras)
    common = jnp.concatenate(
        [step.scale[None], step.intrinsics[:count], step.shapes.reshape(-1)]
    )
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
