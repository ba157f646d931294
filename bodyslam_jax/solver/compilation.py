"""Compiler options and precision of the solver's programs."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

F = TypeVar("F", bound=Callable[..., Any])

_XLA_CPU_OPTIONS = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_llvm_disable_expensive_passes": True,
}
"""Options select the older of XLA's two code generators for fused operations on a CPU,
and LLVM without its expensive passes: the solver's program compiles in half the time
with the first and in 0.7 of that with both, and runs as fast."""


def compiled(function: F) -> F:
    """Returns `eqx.filter_jit` with `quick_options`, which are read at the first call.

    Options belong to whole programs: inside a larger `jit` use `eqx.filter_jit`.
    """
    program = functools.cache(lambda: quick_jit(function))

    @functools.wraps(function)
    def call(*args, **kwargs):
        return program()(*args, **kwargs)

    return call  # pyright: ignore[reportReturnType]


def quick_jit(function: Callable[..., Any]) -> Any:
    """Returns `eqx.filter_jit` with `quick_options`, which has `lower` as well."""
    filter_jit: Any = eqx.filter_jit  # its annotation leaves JAX's own options out
    return filter_jit(function, compiler_options=quick_options())


def in_full_precision(function: F) -> F:
    """Returns the function with matrix products in full precision, not TF32."""

    @functools.wraps(function)
    def call(*args, **kwargs):
        with jax.default_matmul_precision("highest"):
            return function(*args, **kwargs)

    return call  # pyright: ignore[reportReturnType]


@functools.cache
def quick_options() -> Mapping[str, bool] | None:
    """Returns the options that shorten compilation for a CPU, as far as this version of
    XLA knows them; `None` if it knows none, and on other devices."""
    if jax.default_backend() != "cpu":
        return None
    return {
        name: x for name, x in _XLA_CPU_OPTIONS.items() if _is_known(name, x)
    } or None


def _is_known(name: str, value: bool) -> bool:
    try:
        jax.jit(jnp.negative, compiler_options={name: value}).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True
