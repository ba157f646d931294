"""Coordinates of postures in a step: those of the problem's basis, or every turn.

A step turns joint j by `Exp((B z)_j)` on its right, with `p` coordinates z for each
person and frame, and B the columns of `Problem.basis`, or the identity. Turns that are
held have rows of zeros in B.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph import TURNS, Problem


def posture_width(problem: Problem) -> int:
    """Returns the number p of coordinates of one posture in a step."""
    return TURNS if problem.basis is None else problem.basis.shape[1]


def basis_of(problem: Problem, dtype) -> Float[Array, "69 p"]:
    """Returns the matrix B from coordinates to turns (rad), with no turn held."""
    if problem.basis is None:
        return jnp.eye(TURNS, dtype=dtype)
    return problem.basis.astype(dtype)


def to_coordinates(
    problem: Problem, columns: Float[Array, "*b 69"]
) -> Float[Array, "*b p"]:
    """Converts derivatives by turns, of which none is held, into derivatives by
    coordinates: columns `J B`."""
    return columns if problem.basis is None else columns @ problem.basis


def from_turns(
    problem: Problem, slope: Float[Array, "h t 23 3"]
) -> Float[Array, "h t p"]:
    """Converts a gradient by turns, 0 where they are held, into one by coordinates:
    `B^T slope`."""
    held = problem.free.poses * slope
    return to_coordinates(problem, held.reshape(*slope.shape[:2], TURNS))


def to_turns(
    problem: Problem, moved: Float[Array, "h t p"]
) -> Float[Array, "h t 23 3"]:
    """Returns the turns `B z` (rad) of a step, 0 where they are held."""
    free = problem.free.poses
    if problem.basis is not None:
        moved = moved @ problem.basis.T.astype(moved.dtype)
    return free.astype(moved.dtype) * moved.reshape(free.shape)
