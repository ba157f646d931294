"""How programs are compiled: with less effort where that takes longer than they run.

Only a whole program may have options of its own: what is called while a larger `jit` is
traced becomes a part of that.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp

from bodyslam_jax.kept import Options, kept

F = TypeVar("F", bound=Callable[..., Any])

_OPTIONS = {"xla_cpu_use_fusion_emitters": False}
"""Of XLA's two ways to make code of fused operations on a CPU, the older one: the
solver's program compiles in half the time with it, and runs as fast."""
_EFFORTLESS = {"xla_backend_optimization_level": 1}
"""On a CPU, machine code nearly as it comes: less time to compile, and more to run,
which is 0.1 s for 1,000 frames. Not level 0: with XLA's older emitters a `where` took
the wrong branch there (jaxlib 0.10.2)."""


def jit_once(function: F) -> F:
    """`eqx.filter_jit` for what runs a few times in a program's life, not in a loop."""
    plain = eqx.filter_jit(function)

    @functools.cache
    def effortless():
        return kept(function, effortless_options)

    @functools.wraps(function)
    def call(*args, **kwargs):
        # A derivative of a program becomes a part of one, too.
        inside = is_traced([args, kwargs]) or not is_alone()
        program = plain if inside else effortless()
        return program(*args, **kwargs)

    return call  # pyright: ignore[reportReturnType]


def in_full_precision(function: F) -> F:
    """The same with products of all bits, where float32 on a GPU would keep ten."""

    @functools.wraps(function)
    def call(*args, **kwargs):
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return call  # pyright: ignore[reportReturnType]


def is_alone() -> bool:
    """Whether what is called now is not part of a larger `jit`."""
    return not isinstance(jnp.zeros(()) + 1, jax.core.Tracer)


def is_traced(tree: Any) -> bool:
    """Whether any array in it stands for others: mapped, differentiated or compiled."""
    return any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(tree))


@functools.cache
def quick_options() -> Options | None:
    """Options that shorten compilation; `None` where this version of XLA knows none."""
    return _if_known(_OPTIONS)


@functools.cache
def effortless_options() -> Options | None:
    """Options that leave code as it comes; `None` where there is more than a CPU."""
    if jax.default_backend() != "cpu":
        return None
    return _if_known(_EFFORTLESS)


def _if_known(options: Options) -> Options | None:
    try:
        jax.jit(jnp.negative, compiler_options=dict(options)).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return None
    return options
