"""The initial state: people placed relative to cameras, with the scale unknown."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bodyslam_jax import graph
from bodyslam_jax.people import PersonState


def first_state(
    cameras: Float[np.ndarray, "t 4 4"],
    landmarks: Float[np.ndarray, "l 3"],
    roots: PersonState,
    intrinsics: Float[np.ndarray, " i"],
) -> graph.State:
    """The state before the scale is known: s = 1."""
    return graph.State(
        scale=jnp.ones(()),
        cameras=jnp.asarray(cameras),
        roots=jnp.asarray(roots.T_CH),
        poses=jnp.asarray(roots.body_pose),
        shapes=jnp.asarray(roots.shape),
        landmarks=jnp.asarray(landmarks),
        intrinsics=jnp.asarray(intrinsics, float),
    )


def no_people(num_frames: int) -> PersonState:
    """An empty list of people, for cameras alone."""
    return PersonState(
        np.zeros((0, num_frames), bool),
        np.zeros((0, num_frames, 4, 4)),
        np.zeros((0, num_frames, 23, 3)),
        np.zeros((0, 10)),
    )


def free_people(state: graph.State) -> graph.Step:
    """Only people are free: for a static camera, or one that only rotates."""
    free = jax.tree.map(jnp.zeros_like, state.zero_step())
    ones = lambda x: jnp.ones_like(x)
    return dataclasses.replace(
        free,
        roots=ones(free.roots),
        poses=ones(free.poses),
        shapes=ones(free.shapes),
    )
