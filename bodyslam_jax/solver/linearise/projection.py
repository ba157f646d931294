"""Residuals and derivatives of landmark observations, in the camera frame.

With `P` a weighted pixel's derivative by the point in the camera frame, every block of
an observation follows from `P^T P`, since

    dp_C/dl = C^T,  dp_C/dr' = -C^T,  dp_C/dω = [p_C]x  for C Exp(ω).

Vectors here are lists of three arrays `u b g`, and a 3 x 3 matrix is the list of its
columns: parts of one stacked array would be copied before they are used.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.geometry.camera import project
from bodyslam_jax.graph import CHUNK, Problem, Reprojection, State
from bodyslam_jax.solver.blocks import Observations, Sizes

Vector = list[Array]
Square = list[Vector]


class Pixels(NamedTuple):
    """Sums over the two coordinates of each observation. All are in the state's
    precision except `square` and `by_intrinsics`, which have that of blocks."""

    C: Square
    """`C_WC`; arrays `u b 1`."""
    point: Vector
    """p_C"""
    square: Square
    """`P^T P`"""
    by_point: list[Float[Array, "u b 2 g"]]
    """Derivative by the point in the world, by coordinates."""
    slope: Vector
    """`P^T e`"""
    by_intrinsics: list[Vector]
    """`P^T Q` by columns, with Q the pixel's derivative by intrinsics."""
    intrinsics: Float[Array, "i i"]
    """`Q^T Q`, summed over all observations."""
    intrinsics_slope: Float[Array, " i"]
    cost: Float[Array, ""]


def see(
    problem: Problem,
    factor: Reprojection,
    seen: Observations,
    state: State,
    sizes: Sizes,
) -> Pixels:
    """Evaluates all observations at a state, weighted; derivatives by held intrinsics
    are 0."""
    camera = state.cameras.reshape(-1, CHUNK, 4, 4)[seen.chunk][..., :3, :, None]
    C, centre = camera[:, :, :, :3], camera[:, :, :, 3]
    point = jnp.moveaxis(state.landmarks[seen.landmark], 2, 1)[:, None]
    offset = point - centre
    # p_C = C^T (l - r'), one row of C after another
    p_C = add(C[:, :, i] * offset[:, :, i, None] for i in range(3))
    pixels = lambda i, p: jnp.moveaxis(project(i, jnp.moveaxis(p, 2, -1)), -1, 2)
    pixel, push = jax.linearize(lambda p: pixels(state.intrinsics, p), p_C)
    basis = jnp.eye(3, dtype=p_C.dtype)[:, None, None, :, None]
    P = jax.vmap(push)(jnp.broadcast_to(basis, (3, *p_C.shape)))
    error = (pixel - seen.pixel) * seen.weight[:, :, None]
    s = error[:, :, 0] ** 2 + error[:, :, 1] ** 2
    root_weight = jnp.sqrt(factor.loss.weight(s))[:, :, None]
    weight = seen.weight[:, :, None] * root_weight
    P, error = P * weight, error * root_weight
    Q = jnp.zeros((0, *error.shape), error.dtype)
    if sizes.intrinsics:
        by_i = jax.jacfwd(lambda i: pixels(i, p_C))(state.intrinsics)
        Q = jnp.moveaxis(by_i * problem.free.intrinsics, -1, 0) * weight
    low_P = [pair(x.astype(sizes.dtype)) for x in P]
    return Pixels(
        C=[[C[:, :, i, j] for i in range(3)] for j in range(3)],
        point=[p_C[:, :, i] for i in range(3)],
        square=symmetric(lambda i, j: dot(low_P[i], low_P[j])),
        by_point=[
            add(P[i] * C[:, :, j, i, :, None] for i in range(3)) for j in range(3)
        ],
        slope=[dot(pair(x), pair(error)) for x in P],
        by_intrinsics=[[dot(x, pair(q.astype(sizes.dtype))) for x in low_P] for q in Q],
        intrinsics=jnp.einsum("iubcg,jubcg->ij", Q, Q),
        intrinsics_slope=jnp.einsum("iubcg,ubcg->i", Q, error),
        cost=0.5 * jnp.sum(factor.loss.rho(s)),
    )


def pair(x: Float[Array, "u b 2 g"]) -> Vector:
    return [x[:, :, 0], x[:, :, 1]]


def add(terms) -> Array:
    return functools.reduce(jnp.add, terms)


def dot(a: Sequence[Array], b: Sequence[Array]) -> Array:
    return add(x * y for x, y in zip(a, b, strict=True))


def cross(a: Vector, b: Vector) -> Vector:
    """Returns `a x b`, in the precision of `a`."""
    b = [x.astype(a[0].dtype) for x in b]
    ahead, behind = (1, 2, 0), (2, 0, 1)
    return [a[i] * b[j] - a[j] * b[i] for i, j in zip(ahead, behind, strict=True)]


def times(columns: Square, x: Vector) -> Vector:
    return [dot(row, x) for row in transposed(columns)]


def transposed(columns: Square) -> Square:
    return [list(row) for row in zip(*columns, strict=True)]


def symmetric(entry: Callable[[int, int], Array]) -> Square:
    """Returns a symmetric 3 x 3 matrix, with each entry computed once."""
    known = {(i, j): entry(i, j) for i in range(3) for j in range(i, 3)}
    return [[known[min(i, j), max(i, j)] for i in range(3)] for j in range(3)]
