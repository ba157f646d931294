"""What `vmap` does with the solver: one problem after another on a CPU.

A CPU is busy with one problem. Mapped at once, small products become batches of small
products, branches that one problem skips are taken for all, and memory grows with the
batch: six starts of 300 frames took 1.4 times as long as in turn. A GPU has room for
all at once.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax


def in_turn(function: Callable[..., Any]) -> Callable[..., Any]:
    """The same function of pytrees; on a CPU it is mapped one after another, in one
    program."""

    def call(*args):
        if jax.default_backend() != "cpu":
            return function(*args)
        arrays, static = eqx.partition(args, eqx.is_array)
        form = None

        @jax.custom_batching.sequential_vmap
        def one(arrays):
            nonlocal form
            found = function(*eqx.combine(arrays, static))
            found, form = eqx.partition(found, eqx.is_array)
            return found

        found = one(arrays)
        return eqx.combine(found, form)

    return call
