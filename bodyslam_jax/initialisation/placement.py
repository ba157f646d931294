"""Makes the initial state: people relative to cameras, before the scale is known."""

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
    """Returns the state before the scale is known, with s = 1 m per unit of the map."""
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
    """Returns the state of zero people, for problems of cameras alone."""
    return PersonState(
        np.zeros((0, num_frames), bool),
        np.zeros((0, num_frames, 4, 4)),
        np.zeros((0, num_frames, 23, 3)),
        np.zeros((0, 10)),
    )


def free_people(state: graph.State) -> graph.Step:
    """Returns the mask of free variables, people's only, for a camera that is static or
    only rotates."""
    free = jax.tree.map(jnp.zeros_like, state.zero_step())
    ones = lambda x: jnp.ones_like(x)
    return dataclasses.replace(
        free,
        roots=ones(free.roots),
        poses=ones(free.poses),
        shapes=ones(free.shapes),
    )
