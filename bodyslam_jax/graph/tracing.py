"""Tells concrete calls from those traced in a `jit`, `vmap` or `grad`."""

from typing import Any

import jax
import jax.core
import jax.numpy as jnp


def is_alone() -> bool:
    """Returns True if the current call is not being traced in a larger `jit`."""
    return not isinstance(jnp.zeros(()) + 1, jax.core.Tracer)


def is_traced(tree: Any) -> bool:
    """Returns True if any array of a tree is a tracer (`jit`, `vmap`, `grad`)."""
    return any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(tree))
