"""The inverse of the normal equations, but only where it is asked for.

A second pass along the chunks, from the last to the first, gives the covariance of all
that stands in one front (Takahashi's recursion), from the same factor that gives a
step. The dense inverse is never formed.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.solver._blocks import Sizes, own_to_global
from bodyslam_jax.solver._chunks import Factor
from bodyslam_jax.solver._landmarks import CAMERAS
from bodyslam_jax.solver._people import Roots
from bodyslam_jax.solver._window import Window


def selected_inverse(
    factor: Factor, roots: Roots | None, window: Window, sizes: Sizes
) -> tuple[Float[Array, "n f f"], Float[Array, "n w w"], Float[Array, "g g"]]:
    """Covariance of each chunk's roots (all of them, person by person), cameras and the
    globals; of the cameras of its band with the globals; of the globals."""
    _, r, q = factor.side.shape
    g = sizes.globals
    head = q - CAMERAS
    middle = r - 1 - g - head - CAMERAS
    dtype = factor.half.dtype
    eye = jnp.eye(g, dtype=dtype)
    lower = jnp.linalg.cholesky(factor.corner[:g, :g], symmetrize_input=False)
    common = jax.scipy.linalg.cho_solve((lower, True), eye)
    start = jnp.zeros((r - 1, r - 1), dtype).at[-g:, -g:].set(common)
    last = jnp.arange(g) + q + r - 1 - g
    kept = jnp.concatenate([jnp.arange(q), q + head + jnp.arange(middle), last])
    pair = jnp.concatenate([jnp.arange(2 * q), last])
    band = jnp.concatenate(
        [head + jnp.arange(CAMERAS), q + head + jnp.arange(CAMERAS + middle), last]
    )

    def step(known, chunk):
        half, side, following = chunk
        gain = half.T @ side[:-1].T
        mixed = -gain @ known
        own = half.T @ half - mixed @ gain.T
        whole = jnp.block([[own, mixed], [mixed.T, known]])
        part = lambda index: whole[index[:, None], index[None, :]]
        # Roots that went with their chunk touch the chunk before: both stand here.
        front = _with_inner(part(pair), following, window, sizes)
        return part(kept), (front, part(band))

    by_chunk = jax.tree.map(lambda x: x.swapaxes(0, 1), roots)
    following = jax.tree.map(lambda x: jnp.roll(x, -1, axis=0), by_chunk)
    chunks = factor.half, factor.side, following
    known, (fronts, windows) = jax.lax.scan(step, start, chunks, reverse=True)
    # Before the first chunk there is none; after the last, what `step` made is empty.
    own = jnp.concatenate([jnp.arange(q), r - 1 - g + jnp.arange(g)])
    at = q + jnp.arange(q + g)
    alone = jnp.zeros((2 * q + g, 2 * q + g), dtype)
    alone = alone.at[at[:, None], at].set(known[own[:, None], own])
    first = jax.tree.map(lambda x: x[0], by_chunk)
    first = _with_inner(alone, first, window, sizes)
    return jnp.concatenate([first[None], fronts[:-1]]), windows, common


def _with_inner(
    pair: Float[Array, "p p"], roots: Roots | None, window: Window, sizes: Sizes
) -> Float[Array, "f f"]:
    """Covariance of all roots of a chunk, its cameras and the globals, from that of
    what two chunks kept: eliminated roots follow from it, with a spread of their own.
    """
    g, last, width = sizes.globals, 6 * window.reach, window.person
    q = (len(pair) - g) // 2
    eye = jnp.eye(len(pair), dtype=pair.dtype)
    rows, spread = [], jnp.zeros((0, 0), pair.dtype)
    for p in range(sizes.people):
        index = jnp.concatenate(
            [
                p * width + jnp.arange(width),
                q - last + jnp.arange(last),
                q + p * width + jnp.arange(width),
                2 * q - CAMERAS + jnp.arange(CAMERAS),
                2 * q + own_to_global(sizes, p),
            ]
        )
        half, side = roots.half[p], roots.side[p]
        none = jnp.zeros((len(half), len(pair)), pair.dtype)
        rows.append(none.at[:, index].set(-half.T @ side[:-1].T))
        rows.append(eye[q + (p + 1) * width - last + jnp.arange(last)])
        spread = _diagonal(spread, half.T @ half, last)
    rows.append(eye[2 * q - CAMERAS :])
    turn = jnp.concatenate(rows)
    return turn @ pair @ turn.T + _diagonal(spread, eye[:0, :0], CAMERAS + g)


def _diagonal(first: Array, second: Array, more: int) -> Array:
    """Two blocks down a diagonal, and `more` of zeros."""
    a, b = len(first), len(second)
    first = jnp.pad(first, ((0, b + more),) * 2)
    return first + jnp.pad(second, ((a, more),) * 2)
