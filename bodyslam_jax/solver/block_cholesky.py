"""Factorises the system of chunks, from one end to the other.

Before a chunk is factorised, all that the chunks before it leave on it is taken from it
at once ("left-looking"): nothing is carried along but the factors themselves. Chunks
are taken as they stand: in the order of time, or of what they see (`Layout.order`).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.solver.blocks import CAMERAS, Sizes
from bodyslam_jax.solver.reduced_system import Chunks
from bodyslam_jax.solver.triangular import half_of


class Factor(eqx.Module):
    """Each chunk, factorised, and what is left of the arrow."""

    half: Float[Array, "n q q"]
    """`L^-1` of each pivot."""
    side: Float[Array, "n r q"]
    """`L^-1` times the coupling, transposed; the last row is the right-hand side's."""
    corner: Float[Array, "a1 a1"]


def factorise(chunks: Chunks, sizes: Sizes) -> Factor:
    """One chunk after another, less what those before it left on it."""
    n, r, q = chunks.coupling.shape
    tail = sizes.arrow + 1
    head = q - CAMERAS
    near = sizes.reach * head
    reach = (r - near - tail) // CAMERAS

    def step(sides, chunk):
        k, pivot, coupling = chunk
        people, later, common = coupling[:near], coupling[near:-tail], coupling[-tail:]
        for back in range(1, reach + 1):
            # What lies before the first chunk is not written yet: zeros.
            before = jax.lax.dynamic_index_in_dim(sides, (k - back) % n, 0, False)
            first, start = (back - 1) * head, near + (back - 1) * CAMERAS
            rows = before[start:]
            if first < near:
                rows = jnp.concatenate([before[first:near], rows])
            # Of people and of cameras this chunk's come first.
            mine = head if first < near else 0
            beside = max(near - first - head, 0)
            width = mine + CAMERAS
            own = _without(rows[: width + beside], mine, beside)
            update = rows @ own.T
            wide = ((0, 0), (q - width, 0))
            if beside:
                more = update[mine : mine + beside]
                people = people - jnp.pad(more, ((0, near - beside), wide[1]))
                update = _without(update, mine, beside)
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


def _without(rows, first, count):
    """All rows but `count` of them."""
    return jnp.concatenate([rows[:first], rows[first + count :]]) if count else rows


def back_substitute(
    factor: Factor, sizes: Sizes
) -> tuple[Float[Array, "n q"], Float[Array, " a"]]:
    """Steps of all chunks, as they stand, and of the arrow."""
    n, r, q = factor.side.shape
    g = sizes.arrow
    head = q - CAMERAS
    near = sizes.reach * head
    corner = factor.corner
    lower = jnp.linalg.cholesky(corner[:g, :g], symmetrize_input=False)
    common = jax.scipy.linalg.cho_solve((lower, True), corner[:g, -1])

    def step(following, chunk):
        half, side = chunk
        # -1 for the right-hand side: the whole table, without a copy of a part.
        known = jnp.concatenate([following, common, -jnp.ones_like(common[:1])])
        here = -half.T @ (known @ side)
        people, cameras = following[: near - head], following[near:-CAMERAS]
        return jnp.concatenate([here[:head], people, here[head:], cameras]), here

    start = jnp.zeros(r - g - 1, corner.dtype)
    _, steps = jax.lax.scan(step, start, (factor.half, factor.side), reverse=True)
    return steps, common
