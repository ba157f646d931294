"""The curvature that `J^T J` leaves out, for covariances.

Where a limb turns towards the camera keypoints hardly show it, and `J^T J` at an
estimate, whose errors make up some of that turn, takes them to say more than they do.
The observed information has what residuals bend, too (Efron and Hinkley, 1978). Here it
has that of keypoints, in which turns are large; weights of robust losses stay as they
are.
"""

import dataclasses

import jax.numpy as jnp

from bodyslam_jax.graph import JointReprojection, Problem, State
from bodyslam_jax.solver._apart import pick
from bodyslam_jax.solver._blocks import Linearisation, Sizes, cast, mask_of
from bodyslam_jax.solver._limbs import diagonal


def with_curvature(
    problem: Problem, lin: Linearisation, state: State, sizes: Sizes
) -> Linearisation:
    """The same equations with the curvature of keypoints in their blocks."""
    for factor in problem.factors:
        if isinstance(factor, JointReprojection):
            lin = _with_curvature_of(factor, problem, lin, state, sizes)
    return lin


def _with_curvature_of(factor, problem, lin, state, sizes):
    turns, by_shape = factor.curvature(state)
    free = mask_of(problem)
    poses = free.poses.reshape(*free.poses.shape[:2], 69)
    turning = jnp.concatenate([free.roots[..., :3], poses], axis=-1)
    turns = turns * turning[..., :, None] * turning[..., None, :]
    by_shape = by_shape * turning[..., None] * free.shapes[:, None, None]
    limbs = lambda x, axis: pick(x, sizes.joints, axis=axis, width=3)
    pose, root = limbs(turns[..., 3:, :], 2), turns[..., :3, :3]
    more = {
        ("root", "root", 0): jnp.pad(root, (*_NONE, (0, 3), (0, 3))),
        ("pose", "root", 0): jnp.pad(pose[..., :3], (*_NONE, (0, 0), (0, 3))),
    }
    if "shapes" in problem.variables:
        before = (1 + sizes.intrinsics, 0)
        wide = lambda x, rows: jnp.pad(x, (*_NONE, (0, rows), before))
        more["root", "globals", 0] = wide(by_shape[..., :3, :], 3)
        more["pose", "globals", 0] = wide(limbs(by_shape[..., 3:, :], 2), 0)
    more, own = cast(
        (more, diagonal(sizes.widths, limbs(pose[..., 3:], 3))), sizes.dtype
    )
    # Of groups that are all held there are no blocks.
    blocks = {
        key: block + more[key] if key in more else block
        for key, block in lin.blocks.items()
    }
    known = dict(lin.limbs)
    if 0 in known:
        known[0] = [a + b for a, b in zip(known[0], own, strict=True)]
    return dataclasses.replace(lin, blocks=blocks, limbs=known)


_NONE = ((0, 0), (0, 0))
"""Padding of people and frames."""
