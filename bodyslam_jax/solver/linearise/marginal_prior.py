"""The blocks of a marginal prior: one dense matrix over the first chunks.

All variables that it couples are in the reduced system of chunks (`reduced_system.py`):
the last postures and roots of the first chunk, cameras, globals. So it stays one matrix
until that system is assembled; only blocks of globals are added at once.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bodyslam_jax.geometry import so3
from bodyslam_jax.graph import CHUNK, MarginalPrior, Problem, State
from bodyslam_jax.graph.factors.marginal_prior import coordinates
from bodyslam_jax.solver.blocks import (
    PriorBlocks,
    Sizes,
    Sums,
    from_turns,
    mask_of,
    to_coordinates,
)


def linearise_marginal_prior(
    problem: Problem, prior: MarginalPrior, state: State, sums: Sums
) -> PriorBlocks:
    """Returns the dense `J^T J` of a prior, and adds gradients
    and globals to `sums`."""
    sizes = sums.sizes
    first = prior.first_frames(state)
    zero = first.zero_step()
    free = coordinates(prior.first_frames(mask_of(problem)), prior.reach)
    index = indices(prior, sizes)
    there = prior.moved(first)
    residual = prior.root @ there + prior.offset
    sums.costs.append(0.5 * jnp.sum(prior.loss.rho(residual @ residual)))
    jacobian = _jacobian(prior, first, there, index) * free
    slope = residual @ jacobian

    down = _step_of(prior, zero, slope)
    after = len(state.cameras) - prior.frames
    longer = lambda x, axis: jnp.pad(
        x, [(0, after if a == axis else 0) for a in range(x.ndim)]
    )
    sums.add_gradient("camera_alone", longer(down.cameras, 0))
    if "roots" in sizes.variables:
        sums.add_gradient("root", longer(down.roots, 1))
    if "poses" in sizes.variables:
        sums.add_gradient("pose", from_turns(problem, longer(down.poses, 1)))
    at = index.globals
    by_globals = jacobian[:, at]
    sums.add_all_globals(by_globals.T @ by_globals, slope[at])
    by_people = jacobian[:, index.roots]
    if "poses" in sizes.variables:
        postures = to_coordinates(problem, jacobian[:, index.postures])
        by_people = jnp.concatenate([postures, by_people], axis=-1)
    # Cameras of frames up to the end of the last chunk that are not in the prior have
    # zeros.
    missing = jnp.zeros((len(jacobian), -prior.frames % CHUNK * 6), jacobian.dtype)
    flat = by_people.reshape(len(jacobian), -1)
    parts = flat, jacobian[:, index.cameras], missing, by_globals
    columns = jnp.concatenate(parts, axis=1)
    matrix = (columns.T @ columns).astype(sizes.dtype)
    return PriorBlocks(matrix, by_people.shape[-1], prior.reach)


def _jacobian(
    prior: MarginalPrior, first: State, there: Float[Array, " n"], index: "Indices"
) -> Float[Array, "n n"]:
    """Returns the derivative of the residual by the prior's coordinates at a state,
    where `there` is `x ⊖ x̂`."""
    # The alignment couples all cameras; rotations of people are independent.
    nobody = {"roots": first.roots[:0], "poses": first.poses[:0]}
    nobody |= {"shapes": first.shapes[:0]}
    estimate = dataclasses.replace(prior.estimate, **nobody)
    map_alone = dataclasses.replace(prior, estimate=estimate)
    alone = dataclasses.replace(first, **nobody)
    zero = alone.zero_step()

    def moved(step):
        return map_alone.moved(alone.retract(_step_of(map_alone, zero, step)))

    at = index.alone
    by_step = jax.jacfwd(moved)(jnp.zeros(len(at), there.dtype))
    jacobian = prior.root.at[:, at].set(prior.root[:, at] @ by_step)
    turns = index.turns
    by_turn = so3.inverse_right_jacobian(there[turns])
    rows = jnp.einsum("nka,kab->nkb", prior.root[:, turns], by_turn)
    return jacobian.at[:, turns].set(rows)


def diagonal_of_prior(
    prior: PriorBlocks, sizes: Sizes, frames: int
) -> tuple[Array, Array, Array]:
    """Returns the diagonals of cameras, roots and (coupled) postures, of all frames."""
    h, t, r = sizes.people, frames, 6 * prior.reach
    diagonal = jnp.diagonal(prior.matrix)
    head = h * prior.person
    people = diagonal[:head].reshape(h, prior.person)
    pose = prior.person - r
    camera = diagonal[head : len(diagonal) - sizes.globals].reshape(-1, 6)
    root = jnp.zeros((h, t, 6), diagonal.dtype)
    root = root.at[:, CHUNK - prior.reach : CHUNK].set(
        people[:, pose:].reshape(h, prior.reach, 6)
    )
    poses = jnp.zeros((h, t, pose), diagonal.dtype)
    poses = poses.at[:, CHUNK - 1].set(people[:, :pose])
    return jnp.pad(camera, ((0, t - len(camera)), (0, 0))), root, poses


@dataclasses.dataclass(frozen=True)
class Indices:
    """Indices of the solver's variables among a prior's coordinates."""

    roots: Int[np.ndarray, "h r"]
    postures: Int[np.ndarray, "h 69"]
    cameras: Int[np.ndarray, " c6"]
    globals: Int[np.ndarray, " g"]
    alone: Int[np.ndarray, " m"]
    """Scale, all intrinsics, all named globals, and cameras."""
    turns: Int[np.ndarray, "k 3"]
    """Rotations of people."""


def indices(prior: MarginalPrior, sizes: Sizes) -> Indices:
    """Returns the indices of a prior; globals that are held, and people who are, have
    none."""
    first = prior.estimate
    h, i, g = sizes.people, len(first.intrinsics), len(first.globals)
    start = np.cumsum([0, 1, i, g, 10 * h, 6 * prior.frames, 6 * prior.reach * h])
    named = start[2] + np.arange(sizes.named)
    intrinsics = start[1] + np.arange(sizes.intrinsics)
    shapes, cameras = start[3] + np.arange(10 * h), np.arange(6 * prior.frames)
    roots = start[5] + np.arange(6 * prior.reach * h).reshape(h, 6 * prior.reach)
    postures = start[6] + np.arange(69 * h).reshape(h, 69)
    return Indices(
        roots=roots,
        postures=postures,
        cameras=start[4] + cameras,
        globals=np.concatenate([[0], intrinsics, named, shapes]),
        alone=np.concatenate([np.arange(start[3]), start[4] + cameras]),
        turns=np.concatenate([roots.reshape(-1, 6)[:, :3], postures.reshape(-1, 3)]),
    )


def _step_of(prior: MarginalPrior, zero, vector):
    """Returns the step of the first frames with these `coordinates`, 0 elsewhere."""
    take = jax.linear_transpose(lambda s: coordinates(s, prior.reach), zero)
    return take(vector)[0]
