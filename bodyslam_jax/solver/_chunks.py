"""Factorises the system of chunks, from one end to the other.

A front slides along: it holds one chunk as pivot and all that the pivot touches; what
elimination leaves on the rest is carried to the next.
"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.solver._assembly import Chunks
from bodyslam_jax.solver._blocks import Sizes
from bodyslam_jax.solver._landmarks import CAMERAS
from bodyslam_jax.solver._triangular import half_of


class Factor(eqx.Module):
    """The factorised front of each chunk, and the globals' own."""

    half: Float[Array, "n q q"]
    """`L^-1` of each pivot."""
    side: Float[Array, "n r q"]
    """`L^-1` times the coupling, transposed; the last row is the right-hand side's."""
    corner: Float[Array, "g1 g1"]


def factorise(chunks: Chunks, sizes: Sizes) -> Factor:
    """Slides the front along the chunks."""
    n, r, q = chunks.coupling.shape
    tail = sizes.globals + 1
    head = q - CAMERAS
    middle = r - head - CAMERAS - tail
    dtype = chunks.pivot.dtype
    gap = lambda height: jnp.zeros((height, q), dtype)

    def step(front, chunk):
        pivot, coupling = chunk
        known = front[q:, :q]
        coupling = coupling + jnp.concatenate(
            [gap(head), known[:middle], gap(CAMERAS), known[middle:]]
        )
        # The lower part of the front is all there is of it.
        half = half_of(pivot + front[:q, :q])
        side = coupling @ half.T
        rest = _spread(front[q:, q:], head, middle)
        return rest - _lower_square(side, tail), (half, side)

    front = jnp.zeros((r, r), dtype)
    front, (half, side) = jax.lax.scan(step, front, (chunks.pivot, chunks.coupling))
    return Factor(half, side, chunks.corner + front[-tail:, -tail:])


def _lower_square(side: Array, tail: int) -> Array:
    """`side side^T` below the diagonal, in three strips; the last `tail` in full."""
    width = side.shape[0]
    cuts = [0, width // 3, min(2 * width // 3, width - tail), width]
    strips = []
    for start, stop in itertools.pairwise(cuts):
        strip = side[start:stop] @ side[:stop].T
        strips.append(jnp.pad(strip, ((0, 0), (0, width - stop))))
    return jnp.concatenate(strips)


def _spread(rest, head, middle):
    """Makes room in the front for the people and cameras that enter it."""
    rows = [
        jnp.zeros((head, rest.shape[1]), rest.dtype),
        rest[:middle],
        jnp.zeros((CAMERAS, rest.shape[1]), rest.dtype),
        rest[middle:],
    ]
    tall = jnp.concatenate(rows, axis=0)
    columns = [
        jnp.zeros((tall.shape[0], head), rest.dtype),
        tall[:, :middle],
        jnp.zeros((tall.shape[0], CAMERAS), rest.dtype),
        tall[:, middle:],
    ]
    return jnp.concatenate(columns, axis=1)


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
