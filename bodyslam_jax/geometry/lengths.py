"""Few lengths of arrays over frames, so that videos of any length share programs.

XLA compiles a program for each shape. Arrays over frames are therefore lengthened to
one of a few lengths before a compiled function sees them, and its results are cut.
"""

from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

LENGTHS = (20, 60, 120, 200, 340, 600, 1020)
"""In frames. A video of 30 to 1,020 frames becomes 1.36 times as long on average (of
the logarithm of its length), and at most twice as long. The first is for examples."""


def round_up(count: int, parts: int = 4) -> int:
    """The next of a few sizes, each above the one before by at most one in `parts` (a
    power of 2)."""
    if count <= parts:
        return max(count, 1)
    step = max(2 ** int(np.log2(count)) // parts, 1)
    return -(-count // step) * step


def padded_length(frames: int) -> int:
    """The least of `LENGTHS` that holds so many frames; beyond the last, one of more
    lengths, an eighth apart."""
    for length in LENGTHS:
        if frames <= length:
            return length
    return 10 * round_up(-(-frames // 10), parts=8)


def padded_rows(count: int) -> int:
    """The next power of two, for tables whose length is not that of a video."""
    return 1 << max(count - 1, 0).bit_length()


def put(x: Any, dtype: Any = None) -> Array:
    """`jnp.asarray` of an array of any shape, which compiles nothing.

    `jnp.asarray` compiles and keeps a program of a MiB for each shape that it meets:
    tables of tracks have another one in every window of a video.
    """
    return jax.device_put(np.asarray(x, dtype))


def lengthened(tree: Any, frames: int, axis: int = 0) -> Any:
    """Every array of a tree with the last entry of `axis` repeated, up to `frames`.

    Outside of `jit` by NumPy: JAX would compile one small program for each shape.
    """

    def one(x):
        missing = frames - x.shape[axis]
        widths = [(0, missing if a == axis else 0) for a in range(x.ndim)]
        if isinstance(x, jax.core.Tracer):
            return jnp.pad(x, widths, mode="edge")
        return jnp.asarray(np.pad(np.asarray(x), widths, mode="edge"))

    return jax.tree.map(one, tree)


def shortened(tree: Any, frames: int, axis: int = 0) -> Any:
    """The first `frames` entries of `axis` of every array of a tree."""

    def one(x):
        at = (slice(None),) * axis + (slice(frames),)
        known = x if isinstance(x, jax.core.Tracer) else np.asarray(x)
        return jnp.asarray(known[at])

    return jax.tree.map(one, tree)
