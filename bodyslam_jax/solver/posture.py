"""Coordinates of postures in a step: those of the problem's basis, or every turn.

A step turns joint j by `Exp((B z)_j)` on its right, with `p` coordinates z for each
person and frame, and B the columns of `Problem.basis`, or the identity. Turns that are
held have rows of zeros in B.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph import TURNS, Problem


def posture_width(problem: Problem) -> int:
    """p"""
    return TURNS if problem.basis is None else problem.basis.shape[1]


def basis_of(problem: Problem, dtype) -> Float[Array, "69 p"]:
    """B, nothing held."""
    if problem.basis is None:
        return jnp.eye(TURNS, dtype=dtype)
    return problem.basis.astype(dtype)


def to_coordinates(
    problem: Problem, columns: Float[Array, "*b 69"]
) -> Float[Array, "*b p"]:
    """Derivatives by coordinates from those by turns, of which none is held."""
    return columns if problem.basis is None else columns @ problem.basis


def from_turns(
    problem: Problem, slope: Float[Array, "h t 23 3"]
) -> Float[Array, "h t p"]:
    """A gradient by coordinates from one by turns: `B^T slope`."""
    held = problem.free.poses * slope
    return to_coordinates(problem, held.reshape(*slope.shape[:2], TURNS))


def to_turns(
    problem: Problem, moved: Float[Array, "h t p"]
) -> Float[Array, "h t 23 3"]:
    """The turns of a step: `B z`."""
    free = problem.free.poses
    if problem.basis is not None:
        moved = moved @ problem.basis.T.astype(moved.dtype)
    return free.astype(moved.dtype) * moved.reshape(free.shape)
