"""The blocks of a prior that marginalisation left: dense, over the first chunks.

All that it couples is in the reduced system of chunks (`reduced_system.py`): the last
postures and roots of the first chunk, cameras, globals. So it stays one matrix until
that system is put together. Joints that are chains by themselves have blocks of their
own in it, and globals go to theirs at once.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bodyslam_jax.geometry import so3
from bodyslam_jax.graph import CHUNK, MarginalPrior, Problem, State
from bodyslam_jax.graph.factors.marginal_prior import coordinates
from bodyslam_jax.solver.apart import groups_of, split_poses
from bodyslam_jax.solver.blocks import PriorBlocks, Sizes, Sums, mask_of


def linearise_marginal_prior(
    problem: Problem, prior: MarginalPrior, state: State, sums: Sums
) -> PriorBlocks:
    """Its dense matrix; gradients, globals and joints by themselves go to `sums`."""
    sizes = sums.sizes
    first = prior.first_frames(state)
    zero = first.zero_step()
    free = coordinates(prior.first_frames(mask_of(problem)), prior.reach)
    index = indices(prior, sizes)
    there = prior.moved(first)
    residual = prior.root @ there + prior.offset
    sums.costs.append(0.5 * jnp.sum(prior.loss.rho(residual @ residual)))
    jacobian = _jacobian(prior, first, there, index) * free
    gram, slope = jacobian.T @ jacobian, residual @ jacobian

    down = _step_of(prior, zero, slope)
    after = len(state.cameras) - prior.frames
    longer = lambda x, axis: jnp.pad(
        x, [(0, after if a == axis else 0) for a in range(x.ndim)]
    )
    sums.add_gradient("camera_alone", longer(down.cameras, 0))
    if "roots" in sizes.variables:
        sums.add_gradient("root", longer(down.roots, 1))
    if "poses" in sizes.variables:
        for name, part in split_poses(longer(down.poses, 1), sizes.joints).items():
            sums.add_gradient(name, part)
    at = index.globals
    sums.globals = sums.globals + gram[at[:, None], at]
    sums.globals_gradient = sums.globals_gradient + slope[at]
    if "poses" in sizes.variables and (apart := groups_of(sizes.joints).get("apart")):
        frames, joints = len(state.cameras), len(apart)
        rows = index.postures.reshape(-1, 23, 3)[:, np.array(apart)]
        block = gram[rows[..., :, None], rows[..., None, :]]
        whole = jnp.zeros((sizes.people, frames, joints, 3, 3), gram.dtype)
        sums.add(("apart", "apart", 0), whole.at[:, CHUNK - 1].set(block))
    # Cameras of frames up to the end of the last chunk that are not in the prior: a row
    # of zeros behind all others.
    missing = np.full(-prior.frames % CHUNK * 6, len(gram))
    parts = index.people.reshape(-1), index.cameras, missing, index.globals
    order = np.concatenate(parts)
    matrix = jnp.pad(gram, (0, 1))[order[:, None], order].astype(sizes.dtype)
    return PriorBlocks(matrix, index.people.shape[1], prior.reach)


def _jacobian(
    prior: MarginalPrior, first: State, there: Float[Array, " n"], index: "Indices"
) -> Float[Array, "n n"]:
    """Of the residual, by the prior's coordinates at a state; `there` is `x ⊖ x̂`."""
    # Cameras move together; what else turns does so by itself.
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
    """The diagonal by cameras, roots and (coupled) postures, of all frames."""
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
    """Where the solver's variables stand in a prior's coordinates."""

    people: Int[np.ndarray, "h p"]
    """Coupled joints of the posture, in the solver's order, then roots."""
    postures: Int[np.ndarray, "h 69"]
    cameras: Int[np.ndarray, " c6"]
    globals: Int[np.ndarray, " g"]
    alone: Int[np.ndarray, " m"]
    """Scale, all intrinsics, all named globals, and cameras."""
    turns: Int[np.ndarray, "k 3"]
    """Rotations of people."""


def indices(prior: MarginalPrior, sizes: Sizes) -> Indices:
    """Groups that are held have no place in the solver's globals, and people none."""
    first = prior.estimate
    h, i, g = sizes.people, len(first.intrinsics), len(first.globals)
    start = np.cumsum([0, 1, i, g, 10 * h, 6 * prior.frames, 6 * prior.reach * h])
    named = start[2] + np.arange(sizes.named)
    intrinsics = start[1] + np.arange(sizes.intrinsics)
    shapes, cameras = start[3] + np.arange(10 * h), np.arange(6 * prior.frames)
    roots = start[5] + np.arange(6 * prior.reach * h).reshape(h, 6 * prior.reach)
    postures = start[6] + np.arange(69 * h).reshape(h, 69)
    joints = sizes.joints if "poses" in sizes.variables else ()
    coupled = 3 * np.repeat(np.array(joints, int), 3) + np.tile([0, 1, 2], len(joints))
    return Indices(
        people=np.concatenate([postures[:, coupled], roots], axis=1),
        postures=postures,
        cameras=start[4] + cameras,
        globals=np.concatenate([[0], intrinsics, named, shapes]),
        alone=np.concatenate([np.arange(start[3]), start[4] + cameras]),
        turns=np.concatenate([roots.reshape(-1, 6)[:, :3], postures.reshape(-1, 3)]),
    )


def _step_of(prior: MarginalPrior, zero, vector):
    """The step of the first frames with these `coordinates`, 0 elsewhere."""
    take = jax.linear_transpose(lambda s: coordinates(s, prior.reach), zero)
    return take(vector)[0]
