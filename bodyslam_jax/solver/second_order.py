"""The second-order term of the Hessian, for the last steps and for covariances.

Keypoints hardly observe a limb that turns towards the camera, and `J^T J` at an
estimate, whose errors contain some of that turn, overstates their information. The
observed information includes the term Σ rᵢ ∇²rᵢ of the residuals (Efron and Hinkley,
1978). Here it is that of keypoints, in which turns are large; weights of robust losses
are constant.

Steps of `J^T J` alone are too short there, for dozens of iterations of little gain. So
near convergence the Hessian includes a share of the term. With all of it, limbs that
are about to turn over may leave the Hessian indefinite: then the share is halved, and
it grows again with each accepted step. One share serves all frames, although each chunk
has a minimum of its own, as limbs lean over for seconds.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from bodyslam_jax.graph import TURNS, KeypointReprojection, Problem, State
from bodyslam_jax.solver.blocks import (
    Linearisation,
    Sizes,
    cast,
    mask_of,
    to_coordinates,
)

_CURVATURE_RTOL = 1e-3
"""Relative decrease of the cost below which a step adds the second-order term."""
_INITIAL_SHARE, _SHARE_GROWTH, _SHARE_REDUCTION = 0.3, 1.2, 0.5
"""First share of the term, and its factors after an accepted and a rejected step."""


class Curvature(eqx.Module):
    """The second-order term Σ rᵢ ∇²rᵢ of the keypoint factors, by blocks of `J^T J`."""

    blocks: dict[tuple[str, str, int], Array]


def next_share(
    share: Float[Array, ""],
    accepted: Bool[Array, ""],
    gained: Float[Array, ""],
    cost: float | Float[Array, ""],
) -> Float[Array, ""]:
    """Returns the share of the second-order term in the next step.

    Args:
        share: that in the step before.
        gained: decrease of the cost by that step, if it was accepted.
        cost: cost before that step.
    """
    more = jnp.where(share > 0, jnp.minimum(_SHARE_GROWTH * share, 1.0), _INITIAL_SHARE)
    more = jnp.where((share > 0) | (gained < _CURVATURE_RTOL * cost), more, 0.0)
    return jnp.where(accepted, more, _SHARE_REDUCTION * share).astype(share.dtype)


def curvature_if(
    needed: Bool[Array, ""],
    problem: Problem,
    lin: Linearisation,
    state: State,
    sizes: Sizes,
) -> Curvature:
    """Returns `curvature_of` where it is needed, else zeros."""
    some = lambda _: curvature_of(problem, lin, state, sizes)
    like = eqx.filter_eval_shape(some, None)
    none = lambda _: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    return jax.lax.cond(needed, some, none, None)


def curvature_of(
    problem: Problem, lin: Linearisation, state: State, sizes: Sizes
) -> Curvature:
    """Returns the second-order term of all keypoint factors, for the blocks that `lin`
    has."""
    each = [
        _blocks_of(factor, problem, state, sizes)
        for factor in problem.factors
        if isinstance(factor, KeypointReprojection)
    ]
    if not each:
        return Curvature({})
    found = jax.tree.map(lambda *x: sum(x[1:], x[0]), *each)
    blocks = {key: found.blocks[key] for key in lin.blocks if key in found.blocks}
    return Curvature(blocks)


def add_second_order(
    lin: Linearisation, curvature: Curvature, share: float | Float[Array, ""] = 1.0
) -> Linearisation:
    """Returns the normal equations with a share of the second-order term added."""
    some = lambda more: jnp.asarray(share, more.dtype) * more
    add = lambda x, more: x + jnp.where(share > 0, some(more), 0)
    blocks = {
        key: add(block, curvature.blocks[key]) if key in curvature.blocks else block
        for key, block in lin.blocks.items()
    }
    return dataclasses.replace(lin, blocks=blocks)


def _blocks_of(factor, problem, state, sizes):
    turns, by_shape = factor.curvature(state)
    free = mask_of(problem)
    poses = free.poses.reshape(*free.poses.shape[:2], TURNS)
    turning = jnp.concatenate([free.roots[..., :3], poses], axis=-1)
    turns = turns * turning[..., :, None] * turning[..., None, :]
    by_shape = by_shape * turning[..., None] * free.shapes[:, None, None]
    by_posture = lambda x: to_coordinates(problem, x.swapaxes(-1, -2))
    root, pose = turns[..., :3, :3], turns[..., 3:, 3:]
    with_root = by_posture(turns[..., 3:, :3]).swapaxes(-1, -2)
    blocks = {
        ("root", "root", 0): jnp.pad(root, (*_NO_PADDING, (0, 3), (0, 3))),
        ("pose", "root", 0): jnp.pad(with_root, (*_NO_PADDING, (0, 0), (0, 3))),
        ("pose", "pose", 0): by_posture(by_posture(pose)),
    }
    if "shapes" in problem.variables:
        before = (sizes.common, 0)
        wide = lambda x, rows: jnp.pad(x, (*_NO_PADDING, (0, rows), before))
        blocks["root", "globals", 0] = wide(by_shape[..., :3, :], 3)
        of_postures = by_posture(by_shape[..., 3:, :]).swapaxes(-1, -2)
        blocks["pose", "globals", 0] = wide(of_postures, 0)
    return Curvature(cast(blocks, sizes.dtype))


_NO_PADDING = ((0, 0), (0, 0))
"""No padding of the axes of people and frames."""
