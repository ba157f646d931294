"""The curvature that `J^T J` leaves out, for the last steps and for covariances.

Where a limb turns towards the camera keypoints hardly show it, and `J^T J` at an
estimate, whose errors make up some of that turn, takes them to say more than they do.
The observed information has what residuals bend, too (Efron and Hinkley, 1978). Here it
has that of keypoints, in which turns are large; weights of robust losses stay as they
are.

Steps of `J^T J` alone are too short there, for dozens of iterations that gain next to
nothing each. So once they gain little, steps know a share of the curvature as well. At
first there may be limbs about to turn over, where all of it has no minimum: then the
share is halved, and it grows again with each step that is accepted. One share serves
all: each chunk of frames has a minimum by itself, as limbs lean over for seconds.
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from bodyslam_jax.graph import TURNS, KeypointReprojection, Problem, State
from bodyslam_jax.solver.blocks import Linearisation, Sizes, cast, mask_of
from bodyslam_jax.solver.posture import to_coordinates

_LITTLE = 1e-3
"""Share of the cost: after a step that gains no more, curvature comes in."""
_FIRST, _MORE, _LESS = 0.3, 1.2, 0.5
"""The share of it then, and its factors after a step that was accepted, or not."""


class Curvature(eqx.Module):
    """What keypoints add to some of the blocks of `J^T J`."""

    blocks: dict[tuple[str, str, int], Array]


def next_share(
    share: Float[Array, ""],
    accepted: Bool[Array, ""],
    gained: Float[Array, ""],
    cost: float | Float[Array, ""],
) -> Float[Array, ""]:
    """How much of the curvature the next step knows.

    Args:
        share: that the step before knew.
        gained: decrease of the cost in it, if it was accepted.
        cost: before it.
    """
    more = jnp.where(share > 0, jnp.minimum(_MORE * share, 1.0), _FIRST)
    more = jnp.where((share > 0) | (gained < _LITTLE * cost), more, 0.0)
    return jnp.where(accepted, more, _LESS * share).astype(share.dtype)


def curvature_if(
    needed: Bool[Array, ""],
    problem: Problem,
    lin: Linearisation,
    state: State,
    sizes: Sizes,
) -> Curvature:
    """`curvature_of`, or zeros."""
    some = lambda _: curvature_of(problem, lin, state, sizes)
    like = eqx.filter_eval_shape(some, None)
    none = lambda _: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    return jax.lax.cond(needed, some, none, None)


def curvature_of(
    problem: Problem, lin: Linearisation, state: State, sizes: Sizes
) -> Curvature:
    """Of keypoints, for those blocks that there are: of groups that are all held there
    are none."""
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
    """The same equations with a share of the curvature."""
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
        ("root", "root", 0): jnp.pad(root, (*_NONE, (0, 3), (0, 3))),
        ("pose", "root", 0): jnp.pad(with_root, (*_NONE, (0, 0), (0, 3))),
        ("pose", "pose", 0): by_posture(by_posture(pose)),
    }
    if "shapes" in problem.variables:
        before = (sizes.common, 0)
        wide = lambda x, rows: jnp.pad(x, (*_NONE, (0, rows), before))
        blocks["root", "globals", 0] = wide(by_shape[..., :3, :], 3)
        of_postures = by_posture(by_shape[..., 3:, :]).swapaxes(-1, -2)
        blocks["pose", "globals", 0] = wide(of_postures, 0)
    return Curvature(cast(blocks, sizes.dtype))


_NONE = ((0, 0), (0, 0))
"""Padding of people and frames."""
