"""How the solver's program is compiled."""

import functools

import jax
import jax.core
import jax.numpy as jnp

_OPTIONS = {"xla_cpu_use_fusion_emitters": False}
"""Of XLA's two ways to make code of fused operations on a CPU, the older one: this
program compiles in half the time with it, and runs as fast."""


def is_alone() -> bool:
    """Whether what is called now is not part of a larger `jit`: only a whole program
    may have options of its own."""
    return not isinstance(jnp.zeros(()) + 1, jax.core.Tracer)


@functools.cache
def quick_options() -> dict[str, bool] | None:
    """Options that shorten compilation; `None` where this version of XLA knows none."""
    try:
        jax.jit(jnp.negative, compiler_options=_OPTIONS).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return None
    return _OPTIONS
