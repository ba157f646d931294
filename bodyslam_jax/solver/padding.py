"""Pads a problem to the sizes of its layout, so that videos share compiled programs.

Padding has no effect: its measurements have `sigma = inf`, its variables are held.
"""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from bodyslam_jax.geometry.lengths import put
from bodyslam_jax.graph import (
    CHUNK,
    LandmarkPrior,
    MarginalPrior,
    Problem,
    Reprojection,
    State,
    extend,
    extend_state,
    in_one_layout,
    pad_factor,
)


def pad(problem: Problem, state: State) -> tuple[Problem, State]:
    """Pads to `num_chunks * CHUNK` frames and the layout's number of landmarks."""
    layout = problem.layout
    frames = layout.num_chunks * CHUNK - len(state.cameras)
    landmarks = layout.num_landmarks - len(state.landmarks)
    factors = tuple(
        _pad_factor(factor, state, frames, landmarks, layout.num_observations)
        for factor in problem.factors
    )
    motion = problem.motion
    if motion is not None:
        motion = motion.lengthened(layout.num_chunks * CHUNK)
    free = problem.free
    free = dataclasses.replace(
        free,
        cameras=extend(free.cameras, 0, frames, 0.0),
        roots=extend(free.roots, 1, frames, 0.0),
        poses=extend(free.poses, 1, frames, 0.0),
        landmarks=extend(free.landmarks, 0, landmarks, 0.0),
    )
    padded = dataclasses.replace(
        extend_state(state, frames),
        landmarks=extend(state.landmarks, 0, landmarks, 0.0),
    )
    padded_problem = dataclasses.replace(
        problem, factors=factors, free=free, motion=motion
    )
    return _typed((padded_problem, padded))


def stack(cases: Sequence[tuple[Problem, State]]) -> tuple[Problem, State]:
    """Problems and states of equal structure as one of each, with a leading axis.

    All are padded to the frames, landmarks and observations of the least common size
    (`graph/layout.py`) that holds each of them.

    **Raises:** `ValueError` that names the first case which differs from the one before
    it, and in what, or if there is no case, or no common size.
    """
    if not cases:
        raise ValueError("cases: found none, expected one or more.")
    problems = in_one_layout(cases)
    padded = []
    for problem, (_, state) in zip(problems, cases, strict=True):
        as_array = lambda x: _as_array(x, state.scale.dtype)
        padded.append(jax.tree.map(as_array, pad(problem, state)))
    for k in range(1, len(padded)):
        if (what := _difference(padded[k - 1], padded[k])) is not None:
            raise ValueError(f"cases: {k - 1} and {k} have {what}, expected the same.")
    # On the host: nothing is compiled for a number of cases.
    one = lambda *x: jnp.asarray(np.stack([np.asarray(each) for each in x]))
    arrays = [eqx.filter(case, eqx.is_array) for case in padded]
    _, static = eqx.partition(padded[0], eqx.is_array)
    return eqx.combine(jax.tree.map(one, *arrays), static)


def _as_array(leaf, dtype):
    """Returns a number of a factor as an array, so that `jax.vmap` can map it; other
    leaves are returned as they are."""
    return jnp.asarray(leaf, dtype) if isinstance(leaf, float) else leaf


def _difference(first, second) -> str | None:
    """Returns a text that says what differs in the structure of two problems with their
    states; `None` if nothing does."""
    (problem, state), (other, other_state) = first, second
    pairs = {
        "terms": (problem.names, other.names),
        "people": (len(state.shapes), len(other_state.shapes)),
        "variables": (problem.variables, other.variables),
        "named globals": (problem.globals, other.globals),
    }
    for what, (a, b) in pairs.items():
        if a != b:
            return f"{what} {a} and {b}"
    for factor, one in zip(problem.factors, other.factors, strict=True):
        if jax.tree.structure(factor) != jax.tree.structure(one):
            return f"a {type(factor).__name__} of different settings"
    if jax.tree.structure(first) != jax.tree.structure(second):
        return "different motion models or settings"
    leaves = jax.tree_util.tree_leaves_with_path(first)
    for (path, a), b in zip(leaves, jax.tree.leaves(second), strict=True):
        if not eqx.is_array(a):
            if a is not b and a != b:
                return f"{jax.tree_util.keystr(path)} {a} and {b}"
        elif (a.shape, a.dtype) != (b.shape, b.dtype):
            shapes = f"{a.dtype}{a.shape} and {b.dtype}{b.shape}"
            return f"{jax.tree_util.keystr(path)} of {shapes}"
    return None


def _typed(tree):
    """Returns the tree without weak types, which would make JAX compile anew."""
    strong = lambda x: jnp.asarray(x, x.dtype) if eqx.is_array(x) else x
    return jax.tree.map(strong, tree)


def unpad(state: State, num_frames: int, num_landmarks: int) -> State:
    """Removes the frames and landmarks that `pad` added."""
    return State(
        scale=state.scale,
        cameras=first_rows(state.cameras, num_frames),
        roots=first_rows(state.roots, num_frames, axis=1),
        poses=first_rows(state.poses, num_frames, axis=1),
        shapes=state.shapes,
        landmarks=first_rows(state.landmarks, num_landmarks),
        intrinsics=state.intrinsics,
        globals=state.globals,
    )


def first_rows(x: Array, count: int, axis: int = 0) -> Array:
    """Returns the first entries along an axis, outside of `jit` without compiling a
    program."""
    at = (slice(None),) * axis + (slice(count),)
    return x[at] if isinstance(x, jax.core.Tracer) else put(np.asarray(x)[at])


def _pad_factor(factor, state, frames, landmarks, observations):
    if isinstance(factor, LandmarkPrior):
        return LandmarkPrior(
            position=extend(factor.position, 0, landmarks, 0.0),
            whitening=extend(factor.whitening, 0, landmarks, 0.0),
            loss=factor.loss,
        )
    if isinstance(factor, Reprojection):
        rows = observations - len(factor.frame)
        return Reprojection(
            frame=extend(factor.frame, 0, rows, 0),
            landmark=extend(factor.landmark, 0, rows, 0),
            pixel=extend(factor.pixel, 0, rows, 0.0),
            sigma=extend(factor.sigma, 0, rows, jnp.inf),
            loss=factor.loss,
        )
    if isinstance(factor, MarginalPrior):
        return factor
    return pad_factor(factor, state, frames)
