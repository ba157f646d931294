"""Factorises the system of chunks, from one end to the other.

Before a chunk is factorised, the updates of all chunks before it are subtracted from it
at once ("left-looking"): only the factors themselves are carried along. Chunks are
taken as they stand: in the order of time, or in that of `Layout.order`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.graph import Layout
from bodyslam_jax.solver.blocks import CAMERAS, Sizes
from bodyslam_jax.solver.reduced_system import Chunks
from bodyslam_jax.solver.triangular import half_of, row_of, scan_used, with_row


class Factor(eqx.Module):
    """Cholesky factors of all chunks, and the Schur complement of the arrow."""

    half: Float[Array, "n q q"]
    """`L^-1` of each pivot."""
    side: Float[Array, "n r q"]
    """`L^-1` times the coupling, transposed; the last row is the right-hand side's."""
    corner: Float[Array, "a1 a1"]


def factorise(chunks: Chunks, sizes: Sizes, layout: Layout) -> Factor:
    """Factorises one chunk after another, left-looking.

    Only chunks in use are factorised, over the bandwidth in use.
    """
    n, r, q = chunks.coupling.shape
    tail = sizes.arrow + 1
    head = q - CAMERAS
    near = sizes.reach * head
    reach = (r - near - tail) // CAMERAS
    with_people = min(sizes.reach, reach) if head else 0

    def step(sides, chunk):
        k, pivot, coupling = chunk
        people, later, common = coupling[:near], coupling[near:-tail], coupling[-tail:]
        # Sides before the first chunk wrap around to rows not yet written: zeros.
        side_of = lambda back: row_of(sides, jax.lax.rem(k - back + n, np.int32(n)))
        for back in range(1, with_people + 1):
            before = side_of(back)
            first, start = (back - 1) * head, near + (back - 1) * CAMERAS
            rows = jnp.concatenate([before[first:near], before[start:]])
            # Rows of this chunk come first, both among people and among cameras.
            beside = near - first - head
            width = head + CAMERAS
            own = _without(rows[: width + beside], head, beside)
            update = rows @ own.T
            if beside:
                more = update[head : head + beside]
                people = people - jnp.pad(more, ((0, near - beside), (0, 0)))
                update = _without(update, head, beside)
            pivot = pivot - update[:width]
            common = common - update[-tail:]
            middle = update[width:-tail]
            later = later - jnp.pad(middle, ((0, len(later) - len(middle)), (0, 0)))

        def of_cameras(back, total):
            before = side_of(back)
            cameras = jnp.pad(before[near:-tail], ((0, reach * CAMERAS), (0, 0)))
            start = (back - 1) * CAMERAS
            cameras = jax.lax.dynamic_slice(
                cameras,
                (start, jnp.zeros_like(start)),
                (reach * CAMERAS, q),
                allow_negative_indices=False,
            )
            rows = jnp.concatenate([cameras, before[-tail:]])
            return total + rows @ cameras[:CAMERAS].T

        stop = layout.used_bandwidth
        stop = np.int32(reach + 1) if stop is None else stop
        total = jnp.zeros((reach * CAMERAS + tail, CAMERAS), pivot.dtype)
        total = jax.lax.fori_loop(with_people + 1, stop, of_cameras, total)
        pivot = pivot.at[head:, head:].add(-total[:CAMERAS])
        middle = jnp.pad(total[CAMERAS:-tail], ((0, CAMERAS), (0, 0)))
        later = later.at[:, head:].add(-middle)
        common = common.at[:, head:].add(-total[-tail:])
        half = half_of(pivot)
        side = jnp.concatenate([people, later, common]) @ half.T
        return with_row(sides, side, k), half

    sides = jnp.zeros_like(chunks.coupling)
    each = jnp.arange(n, dtype=jnp.int32), chunks.pivot, chunks.coupling
    sides, half = scan_used(step, sides, each, layout.used)
    ends = sides[:, -tail:].swapaxes(0, 1).reshape(tail, -1)
    return Factor(half, sides, chunks.corner - ends @ ends.T)


def _without(rows, first, count):
    """Returns the rows without `count` of them from `first` on."""
    return jnp.concatenate([rows[:first], rows[first + count :]]) if count else rows


def back_substitute(
    factor: Factor, sizes: Sizes
) -> tuple[Float[Array, "n q"], Float[Array, " a"]]:
    """Returns the steps of all chunks, as they stand, and of the arrow."""
    n, r, q = factor.side.shape
    g = sizes.arrow
    head = q - CAMERAS
    near = sizes.reach * head
    corner = factor.corner
    lower = jnp.linalg.cholesky(corner[:g, :g], symmetrize_input=False)
    common = jax.scipy.linalg.cho_solve((lower, True), corner[:g, -1])

    def step(following, chunk):
        half, side = chunk
        # A factor of -1 for the right-hand side saves copying a part of the table.
        known = jnp.concatenate([following, common, -jnp.ones_like(common[:1])])
        here = -half.T @ (known @ side)
        people, cameras = following[: near - head], following[near:-CAMERAS]
        return jnp.concatenate([here[:head], people, here[head:], cameras]), here

    start = jnp.zeros(r - g - 1, corner.dtype)
    _, steps = jax.lax.scan(step, start, (factor.half, factor.side), reverse=True)
    return steps, common
