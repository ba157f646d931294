"""Compiler options, precision and arguments of the solver's programs."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

from bodyslam_jax.body import BodyModel

F = TypeVar("F", bound=Callable[..., Any])
T = TypeVar("T")

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


class _Place(eqx.Module):
    """Stands for the body model with this index."""

    index: int = eqx.field(static=True)


def separate_bodies(tree: T) -> tuple[T, tuple[BodyModel, ...]]:
    """Returns the tree with places in place of its body models, and each of these
    once. Models are the same if their arrays are the same objects.

    Each factor has the body model among its fields. Were it an argument of a compiled
    program for each of them, XLA could not know that they are equal, and would compute
    the same kinematics for each factor.
    """
    known: dict[tuple, int] = {}
    bodies: list[BodyModel] = []

    def placed(x):
        if not _is_body(x):
            return x
        leaves, structure = jax.tree.flatten(x)
        key = (structure, *map(id, leaves))
        if key not in known:
            known[key] = len(bodies)
            bodies.append(x)
        return _Place(known[key])

    return jax.tree.map(placed, tree, is_leaf=_is_body), tuple(bodies)


def rejoin_bodies(tree: T, bodies: tuple[BodyModel, ...]) -> T:
    """Returns the tree of which `separate_bodies` made `tree` and `bodies`."""
    is_place = lambda x: isinstance(x, _Place)
    put = lambda x: bodies[x.index] if is_place(x) else x
    return jax.tree.map(put, tree, is_leaf=is_place)


def _is_body(x) -> bool:
    return isinstance(x, BodyModel)
