"""Whether code runs by itself or is traced: part of a larger `jit`, `vmap`, `grad`."""

from typing import Any

import jax
import jax.core
import jax.numpy as jnp


def is_alone() -> bool:
    """Whether what is called now is not part of a larger `jit`."""
    return not isinstance(jnp.zeros(()) + 1, jax.core.Tracer)


def is_traced(tree: Any) -> bool:
    """Whether any array of a tree is a tracer: mapped, differentiated or compiled."""
    return any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(tree))
