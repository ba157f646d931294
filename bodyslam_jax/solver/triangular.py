"""Cholesky factors and their inverses, without LAPACK's batches.

On a CPU two of jaxlib's batched factorisations or solves at the same time (0.10.2, on
two cores), of two threads or two devices, wait for each other's threads for ever.
"""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.solver.loops import row_of

MAX_LEAF_WIDTH = 12
"""Maximum width of the blocks that are inverted by substitution."""


def half_of(matrix: Float[Array, "*b n n"]) -> Float[Array, "*b n n"]:
    """Returns `L^-1` of positive definite `L L^T`; NaN where one is not."""
    return invert_lower(cholesky(matrix))


def cholesky(matrix: Float[Array, "*b n n"]) -> Float[Array, "*b n n"]:
    """Returns `L` of positive definite matrices `L L^T`, from their lower triangles;
    NaN where one is not. On a CPU they are factorised in turn, as fast as a batch."""
    one = functools.partial(jnp.linalg.cholesky, symmetrize_input=False)
    if matrix.ndim == 2 or jax.default_backend() != "cpu":
        return one(matrix)
    each = matrix.reshape(-1, *matrix.shape[-2:])
    return jax.lax.map(one, each).reshape(matrix.shape)


def invert_lower(lower: Float[Array, "*b n n"]) -> Float[Array, "*b n n"]:
    """Returns the inverses of lower triangular matrices.

    On a CPU small diagonal blocks are inverted first, then two neighbours are merged at
    a time, as matrix products are ten times as fast as substitution. Elsewhere it is
    one
    solve: a GPU waits for each of many small operations.
    """
    n = lower.shape[-1]
    if jax.default_backend() != "cpu":
        eye = jnp.broadcast_to(jnp.eye(n, dtype=lower.dtype), lower.shape)
        return jax.lax.linalg.triangular_solve(lower, eye, left_side=True, lower=True)
    levels = max(0, math.ceil(math.log2(n / MAX_LEAF_WIDTH)))
    size = -(-n // 2**levels)
    more = size * 2**levels - n
    lower = jnp.pad(lower, [(0, 0)] * (lower.ndim - 2) + [(0, more)] * 2)
    lower = lower + jnp.diag(jnp.arange(n + more) >= n).astype(lower.dtype)

    def blocks(shift, step):
        """Returns every `step`-th block, `shift` below the diagonal; blocks first."""
        count = (n + more) // size
        tiles = lower.reshape(*lower.shape[:-2], count, size, count, size)
        column = np.arange(0, count - shift, step)
        return tiles[..., column + shift, :, column, :]

    inverse = _substitute(blocks(0, 1))
    while len(inverse) > 1:
        first, last = inverse[0::2], inverse[1::2]
        mixed = -last @ (blocks(1, 2) @ first)
        top = jnp.concatenate([first, jnp.zeros_like(mixed)], axis=-1)
        bottom = jnp.concatenate([mixed, last], axis=-1)
        inverse = jnp.concatenate([top, bottom], axis=-2)
        size *= 2
    return inverse[0, ..., :n, :n]


def _substitute(lower: Float[Array, "*b n n"]) -> Float[Array, "*b n n"]:
    """Inverts by substitution: each row in turn is subtracted from all below it."""
    index = jnp.arange(lower.shape[-1])

    def one(k, inverse):
        last = lower.ndim - 1
        column = row_of(lower, k, last)[..., None]
        pivot = row_of(column, k, last - 1)[..., None, :]
        row = row_of(inverse, k, last - 1)[..., None, :] / pivot
        below = jnp.where((index > k)[:, None], column, 0.0)
        return jnp.where((index == k)[:, None], row, inverse - below * row)

    eye = jnp.broadcast_to(jnp.eye(len(index), dtype=lower.dtype), lower.shape)
    return jax.lax.fori_loop(0, len(index), one, eye)
