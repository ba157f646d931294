"""One damped step of the joint problem, by elimination.

`(H + λ diag H) δ = -J^T r`: landmarks first, then inner postures, then the chunks of
cameras and people from one end to the other, globals and lasting landmarks at the end;
and back. A coordinate that no measurement sees has a zero row, gets 1 on its diagonal,
and stays where it is.
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.graph import Problem, State, Step
from bodyslam_jax.solver.block_cholesky import Factor, back_substitute, factorise
from bodyslam_jax.solver.blocks import (
    CAMERAS,
    Linearisation,
    Sizes,
    cast,
    globals_of,
    own_to_global,
    to_turns,
)
from bodyslam_jax.solver.elimination.person import (
    People,
    eliminate_people,
    substitute_people,
)
from bodyslam_jax.solver.elimination.schur import (
    Halves,
    eliminate_landmarks,
    half_inverses,
    move_lasting,
    substitute_landmarks,
)
from bodyslam_jax.solver.front import Window, window_of
from bodyslam_jax.solver.linearise.marginal_prior import diagonal_of_prior
from bodyslam_jax.solver.reduced_system import Chunks, add_marginal_prior, assemble


class Eliminated(eqx.Module):
    """The factorised equations, with all that back-substitution needs."""

    landmarks: tuple[Halves, ...]
    window: Window
    people: People | None
    factor: Factor


def diagonals(lin: Linearisation, sizes: Sizes) -> dict:
    """Returns the diagonal of `J^T J` by group; landmarks as in the tables."""
    dtype = lin.globals.dtype
    t = sizes.chunks * CAMERAS // 6
    diagonal = lambda x: jnp.diagonal(x, axis1=-2, axis2=-1).astype(dtype)
    camera = jnp.zeros((t, 6), dtype)
    for key in (("alone", "alone", 0), ("camera", "camera", 0)):
        if key in lin.blocks:
            camera = camera + diagonal(lin.blocks[key]).reshape(-1, t, 6).sum(axis=0)
    root = jnp.zeros((sizes.people, t, 6), dtype)
    if ("root", "root", 0) in lin.blocks:
        root = diagonal(lin.blocks["root", "root", 0])
    of_prior = None
    if lin.prior is not None:
        of_prior = [x.astype(dtype) for x in diagonal_of_prior(lin.prior, sizes, t)]
        camera, root = camera + of_prior[0], root + of_prior[1]
    result = {
        "globals": diagonal(lin.globals),
        "camera": camera,
        "root": root,
        "landmarks": tuple(
            jnp.moveaxis(jnp.diagonal(table.own, axis1=1, axis2=2), 2, 1).astype(dtype)
            for table in lin.landmarks
        ),
    }
    if "pose" in lin.gradient:
        pose = jnp.zeros_like(lin.gradient["pose"])
        if ("pose", "pose", 0) in lin.blocks:
            pose = diagonal(lin.blocks["pose", "pose", 0])
        result["pose"] = pose if of_prior is None else pose + of_prior[2]
    return result


UNOBSERVED_DIAGONAL = 1e-12
"""Diagonal entry of a coordinate that no measurement observes, for covariances."""


def damped(
    diagonal: dict,
    damping: Float[Array, ""],
    unseen: float | Float[Array, ""] = 1.0,
) -> dict:
    """Returns the damping of each coordinate; `unseen` where its diagonal is 0."""
    tiny = jnp.finfo(damping.dtype).tiny ** 0.5
    add = lambda d: jnp.where(d > tiny, damping * d, unseen)
    return jax.tree.map(add, diagonal)


@eqx.filter_jit
def eliminate(
    problem: Problem, lin: Linearisation, sizes: Sizes, damping: dict
) -> Eliminated:
    """Factorises the damped normal equations, in the precision of `sizes`."""
    lin, of_landmarks = _low(lin, sizes), damping["landmarks"]
    damping = {**cast(damping, sizes.dtype), "landmarks": of_landmarks}
    halves = half_inverses(lin.landmarks, of_landmarks)
    chunks, window, people = reduce_to_chunks(problem, lin, sizes, damping, halves)
    factor = factorise(chunks, sizes, problem.layout)
    return Eliminated(halves, window, people, factor)


def reduce_to_chunks(
    problem: Problem,
    lin: Linearisation,
    sizes: Sizes,
    damping: dict,
    halves: tuple[Halves, ...],
) -> tuple[Chunks, Window, People | None]:
    """Eliminates landmarks, of which `halves` are the factors (`half_inverses`), inner
    postures and inner roots.

    Returns the reduced system of chunks, the sizes of its groups, and what
    back-substitution needs of people.
    """
    given = lin.landmarks, halves, damping["landmarks"]
    reduced = eliminate_landmarks(problem, *given, sizes)
    window = window_of(lin, sizes)
    people = None
    if sizes.people:
        people = eliminate_people(lin, sizes, window, damping)
    kept = None if people is None else people.kept
    layout = problem.layout
    chunks = assemble(lin, sizes, reduced, kept, window, damping, layout.order)
    if lin.prior is not None:
        chunks = add_marginal_prior(chunks, lin.prior, sizes, window)
    return chunks, window, people


def _low(lin: Linearisation, sizes: Sizes) -> Linearisation:
    """Returns the blocks in the precision of `sizes`; landmarks' own 3 x 3 blocks and
    gradients stay as they are.

    What many frames see under a small angle bends so little along its depth that
    rounding in single precision hides it: a damping that hides the rounding would then
    hold back all others.
    """
    tables = tuple(
        dataclasses.replace(cast(t, sizes.dtype), own=t.own, gradient=t.gradient)
        for t in lin.landmarks
    )
    return dataclasses.replace(cast(lin, sizes.dtype), landmarks=tables)


class Move(NamedTuple):
    """A step, and the coordinates of its postures (`blocks.py`)."""

    step: Step
    postures: Float[Array, "h t p"]


@eqx.filter_jit
def solve_step(
    problem: Problem,
    state: State,
    lin: Linearisation,
    sizes: Sizes,
    eliminated: Eliminated,
) -> Move:
    """Solves the factorised equations for a step, in the state's own precision."""
    h, n = sizes.people, sizes.chunks
    lin, zero = _low(lin, sizes), cast(state.zero_step(), sizes.dtype)
    steps, common = back_substitute(eliminated.factor, sizes)
    head = steps.shape[1] - CAMERAS
    of_cameras = lambda x: x[:, head:].reshape(n * CAMERAS // 6, 6)
    as_they_stand = of_cameras(steps)
    if problem.layout.order is not None:
        steps = steps[jnp.argsort(problem.layout.order)]
    cameras = of_cameras(steps)
    roots = zero.roots
    postures = jnp.zeros((h, len(zero.cameras), sizes.posture), sizes.dtype)
    if eliminated.people is not None:
        steps = steps[:, :head].reshape(n, h, -1).swapaxes(0, 1)
        own = jnp.stack([common[own_to_global(sizes, p)] for p in range(h)])
        roots, moved = substitute_people(
            eliminated.people, sizes, eliminated.window, steps, cameras, own
        )
        postures = postures if moved is None else moved
    i = sizes.intrinsics
    intrinsics = common[1 : 1 + i] if i else zero.intrinsics
    landmarks = substitute_landmarks(
        problem,
        lin.landmarks,
        eliminated.landmarks,
        as_they_stand,
        common[1 : 1 + i],
        move_lasting(problem, common[sizes.globals :], zero.landmarks),
    )
    step = Step(
        scale=common[0],
        cameras=cameras,
        roots=roots,
        poses=to_turns(problem, postures),
        shapes=common[sizes.common : sizes.globals].reshape(h, 10),
        landmarks=landmarks,
        intrinsics=intrinsics,
        globals=common[1 + i : sizes.common] if sizes.named else zero.globals,
    )
    return cast(Move(step, postures), state.scale.dtype)


def along(problem: Problem, sizes: Sizes, move: Move) -> Float[Array, " d"]:
    """Returns all coordinates of a step in one vector, in the order of `in_line`."""
    step = move.step
    landmarks = [
        jnp.moveaxis(step.landmarks[bucket.landmark], 2, 1)
        for bucket in problem.layout.buckets
    ]
    parts = [step.cameras, step.roots, globals_of(step, sizes), move.postures]
    return _line(step.scale.dtype, [*parts, *landmarks])


def in_line(
    diagonal: dict, dtype: np.dtype, postures: Float[Array, "h t p"]
) -> Float[Array, " d"]:
    """Returns a diagonal in one vector; 0 for `postures` that no factor sees."""
    pose = diagonal.get("pose", jnp.zeros_like(postures))
    parts = [diagonal["camera"], diagonal["root"], diagonal["globals"], pose]
    return _line(dtype, [*parts, *diagonal["landmarks"]])


def gradient_in_line(lin: Linearisation, move: Move) -> Float[Array, " d"]:
    """Returns the gradient in one vector, in the order of `in_line`."""
    step, gradient = move.step, lin.gradient
    camera = gradient.get("camera_alone", jnp.zeros_like(step.cameras))
    if "camera" in gradient:
        camera = camera + jnp.sum(gradient["camera"], axis=0)
    root = gradient.get("root", jnp.zeros_like(step.roots))
    pose = gradient.get("pose", jnp.zeros_like(move.postures))
    landmarks = [table.gradient for table in lin.landmarks]
    parts = [camera, root, lin.globals_gradient, pose, *landmarks]
    return _line(step.scale.dtype, parts)


def _line(dtype: np.dtype, parts: list[Array]) -> Float[Array, " d"]:
    return jnp.concatenate([x.astype(dtype).reshape(-1) for x in parts])
