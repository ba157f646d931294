"""Pads a problem to the sizes of its layout, so that videos share compiled programs.

What is added has no weight: measurements with `sigma = inf`, variables that may not
move.
"""

import dataclasses

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
    pad_factor,
)


def pad(problem: Problem, state: State) -> tuple[Problem, State]:
    """The same problem with `num_chunks * CHUNK` frames and more landmark slots."""
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


def _typed(tree):
    """The same numbers, none of them weakly typed: that alone would compile anew."""
    strong = lambda x: jnp.asarray(x, x.dtype) if eqx.is_array(x) else x
    return jax.tree.map(strong, tree)


def unpad(state: State, num_frames: int, num_landmarks: int) -> State:
    """Drops what `pad` added."""
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
    """The first entries of an axis; outside of `jit` nothing is compiled for that."""
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
