"""Factorises the system of chunks, from one end to the other.

Before a chunk is factorised, all that the chunks before it leave on it is taken from it
at once ("left-looking"): nothing is carried along but the factors themselves.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.solver._assembly import Chunks
from bodyslam_jax.solver._blocks import Sizes
from bodyslam_jax.solver._landmarks import CAMERAS
from bodyslam_jax.solver._triangular import half_of


class Factor(eqx.Module):
    """Each chunk, factorised, and what is left of the globals."""

    half: Float[Array, "n q q"]
    """`L^-1` of each pivot."""
    side: Float[Array, "n r q"]
    """`L^-1` times the coupling, transposed; the last row is the right-hand side's."""
    corner: Float[Array, "g1 g1"]


def factorise(chunks: Chunks, sizes: Sizes) -> Factor:
    """One chunk after another, less what those before it left on it."""
    n, r, q = chunks.coupling.shape
    tail = sizes.globals + 1
    head = q - CAMERAS
    reach = (r - head - tail) // CAMERAS

    def step(sides, chunk):
        k, pivot, coupling = chunk
        people, later, common = coupling[:head], coupling[head:-tail], coupling[-tail:]
        for back in range(1, reach + 1):
            # What lies before the first chunk is not written yet: zeros.
            before = jax.lax.dynamic_index_in_dim(sides, (k - back) % n, 0, False)
            width = q if back == 1 else CAMERAS
            start = head + back * CAMERAS - width
            update = before[start:] @ before[start : start + width].T
            wide = ((0, 0), (q - width, 0))
            pivot = pivot - jnp.pad(update[:width], ((q - width, 0), wide[1]))
            common = common - jnp.pad(update[-tail:], wide)
            middle = update[width:-tail]
            below = len(later) - len(middle)
            later = later - jnp.pad(middle, ((0, below), wide[1]))
        half = half_of(pivot)
        side = jnp.concatenate([people, later, common]) @ half.T
        return jax.lax.dynamic_update_index_in_dim(sides, side, k, 0), half

    sides = jnp.zeros_like(chunks.coupling)
    each = jnp.arange(n), chunks.pivot, chunks.coupling
    sides, half = jax.lax.scan(step, sides, each)
    ends = sides[:, -tail:].swapaxes(0, 1).reshape(tail, -1)
    return Factor(half, sides, chunks.corner - ends @ ends.T)


def back_substitute(
    factor: Factor, sizes: Sizes
) -> tuple[Float[Array, "n q"], Float[Array, " g"]]:
    """Steps of all chunks, and of the globals."""
    n, r, q = factor.side.shape
    g = sizes.globals
    head = q - CAMERAS
    corner = factor.corner
    lower = jnp.linalg.cholesky(corner[:g, :g], symmetrize_input=False)
    common = jax.scipy.linalg.cho_solve((lower, True), corner[:g, -1])

    def step(following, chunk):
        half, side = chunk
        # -1 for the right-hand side: the whole table, without a copy of a part.
        known = jnp.concatenate([following, common, -jnp.ones_like(common[:1])])
        here = -half.T @ (known @ side)
        kept = following[head : r - g - 1 - CAMERAS]
        return jnp.concatenate([here[:head], here[head:], kept]), here

    start = jnp.zeros(r - g - 1, corner.dtype)
    _, steps = jax.lax.scan(step, start, (factor.half, factor.side), reverse=True)
    return steps, common
