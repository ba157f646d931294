"""Factorisations, loops and access to rows that compile and run well in XLA.

Cholesky factors and their inverses are made without LAPACK's batches: on a CPU two of
jaxlib's batched factorisations or solves at the same time (0.10.2, on two cores), of
two threads or two devices, wait for each other's threads for ever.

Loops run over the used rows of padded tables. `jax.lax.dynamic_index_in_dim` adds a
function to the program for each shape, and handles negative indices, which are not used
here.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

MAX_LEAF_WIDTH = 12
"""Maximum width of the blocks that are inverted by substitution."""
Index = int | Int[Array, ""]


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


def row_of(x: Array, k: Index, axis: int = 0) -> Array:
    """Returns row `k`, from 0, of an axis, which is dropped."""
    sizes = [1 if a == axis else n for a, n in enumerate(x.shape)]
    row = jax.lax.dynamic_slice(
        x, _start(x, k, axis), sizes, allow_negative_indices=False
    )
    return row.reshape(x.shape[:axis] + x.shape[axis + 1 :])


def with_row(x: Array, row: Array, k: Index, axis: int = 0) -> Array:
    """Returns `x` with row `k` of an axis replaced."""
    wide = jnp.expand_dims(row, axis)
    start = _start(x, k, axis)
    return jax.lax.dynamic_update_slice(x, wide, start, allow_negative_indices=False)


def _start(x, k, axis):
    k = jnp.asarray(k)
    return [k if a == axis else jnp.zeros((), k.dtype) for a in range(x.ndim)]


def scan_used(
    step: Callable[..., Any], carry: Any, rows: Any, used: Int[Array, ""] | None
) -> tuple[Any, Any]:
    """Runs `jax.lax.scan` over the first `used` rows; results of the other rows are 0.

    The unused rows take no time. `None` is for all rows; only then is the loop
    differentiable in reverse mode.
    """
    if used is None:
        return jax.lax.scan(step, carry, rows)
    at = lambda i: jax.tree.map(lambda x: row_of(x, i), rows)
    _, struct = jax.eval_shape(step, carry, at(0))
    count = len(jax.tree.leaves(rows)[0])
    empty = jax.tree.map(lambda s: jnp.zeros((count, *s.shape), s.dtype), struct)

    def one(i, known):
        carry, found = step(known[0], at(i))
        put = lambda whole, row: with_row(whole, row, i)
        return carry, jax.tree.map(put, known[1], found)

    return jax.lax.fori_loop(0, used, one, (carry, empty))
