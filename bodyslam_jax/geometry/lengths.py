"""Padding of arrays to few lengths, so that videos of any length share programs.

XLA compiles a program for each shape. Arrays over frames are therefore padded to one of
a few lengths before they enter a compiled function, and its results are truncated.

`is_traced` and `is_alone` tell concrete calls from those traced in a larger program.
"""

from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

LENGTHS = (20, 60, 120, 200, 340, 600, 1020)
"""Padded lengths, frames. Padding makes a video of 30 to 1,020 frames longer by a
factor of 1.36 on average (over the logarithm of its length), and of at most 2. The
shortest length is for examples."""


def round_up(count: int, parts: int = 4) -> int:
    """Rounds up to the next of a few sizes, whose successive ratio is at most
    `1 + 1 / parts` (`parts` is a power of 2)."""
    if count <= parts:
        return max(count, 1)
    step = max(2 ** int(np.log2(count)) // parts, 1)
    return -(-count // step) * step


def padded_length(frames: int) -> int:
    """Returns the least of `LENGTHS` that is not below `frames`; beyond the last one,
    lengths grow by an eighth."""
    for length in LENGTHS:
        if frames <= length:
            return length
    return 10 * round_up(-(-frames // 10), parts=8)


def padded_rows(count: int) -> int:
    """Returns the next power of two, for tables whose length is not a number of
    frames."""
    return 1 << max(count - 1, 0).bit_length()


def put(x: Any, dtype: Any = None) -> Array:
    """Returns `jnp.asarray` of an array of any shape without compiling a program.

    `jnp.asarray` compiles and keeps a program of a MiB for each shape that it meets:
    tables of tracks have another one in every window of a video.
    """
    return jax.device_put(np.asarray(x, dtype))


def lengthened(tree: Any, frames: int, axis: int = 0) -> Any:
    """Pads every array of a tree to `frames` by repeating the last entry of `axis`.

    Outside `jit` it uses NumPy, as JAX would compile a small program for each shape.
    """

    def one(x):
        missing = frames - x.shape[axis]
        widths = [(0, missing if a == axis else 0) for a in range(x.ndim)]
        if isinstance(x, jax.core.Tracer):
            return jnp.pad(x, widths, mode="edge")
        return put(np.pad(np.asarray(x), widths, mode="edge"))

    return jax.tree.map(one, tree)


def shortened(tree: Any, frames: int, axis: int = 0) -> Any:
    """Truncates every array of a tree to the first `frames` entries of `axis`."""

    def one(x):
        at = (slice(None),) * axis + (slice(frames),)
        return x[at] if isinstance(x, jax.core.Tracer) else put(np.asarray(x)[at])

    return jax.tree.map(one, tree)


def is_alone() -> bool:
    """Returns True if the current call is not being traced in a larger `jit`."""
    return not isinstance(jnp.zeros(()) + 1, jax.core.Tracer)


def is_traced(tree: Any) -> bool:
    """Returns True if any array of a tree is a tracer (`jit`, `vmap`, `grad`)."""
    return any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(tree))
