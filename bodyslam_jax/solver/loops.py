"""Loops over the used rows of padded tables, and access to single rows.

`jax.lax.dynamic_index_in_dim` adds a function to the program for each shape, and
handles negative indices, which are not used here.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

Index = int | Int[Array, ""]


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
