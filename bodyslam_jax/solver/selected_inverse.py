"""Selected blocks of the inverse of the normal equations.

A pass along the chunks, from the last to the first, gives the covariance of all
variables in one front (Takahashi's recursion), from the same factor that gives a step.
The dense inverse is never formed.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bodyslam_jax.solver.block_cholesky import Factor
from bodyslam_jax.solver.blocks import CAMERAS, Sizes, own_to_global
from bodyslam_jax.solver.elimination.person import RootFactor
from bodyslam_jax.solver.front import Window


def selected_inverse(
    factor: Factor,
    roots: RootFactor | None,
    window: Window,
    sizes: Sizes,
    order: Int[Array, " n"] | None,
) -> tuple[Float[Array, "n f f"], Float[Array, "n w w"], Float[Array, "a a"]]:
    """Returns three covariances: of each chunk's roots (all, person by person), cameras
    and the globals, in the order of time; of the cameras in its band with the globals,
    chunks as they stand; and of the whole arrow."""
    r, q = factor.side.shape[1:]
    g, arrow = sizes.globals, sizes.arrow
    head = q - CAMERAS
    near = sizes.reach * head
    dtype = factor.half.dtype
    eye = jnp.eye(arrow, dtype=dtype)
    corner = factor.corner[:arrow, :arrow]
    lower = jnp.linalg.cholesky(corner, symmetrize_input=False)
    common = jax.scipy.linalg.cho_solve((lower, True), eye)
    start = jnp.zeros((r - 1, r - 1), dtype).at[-arrow:, -arrow:].set(common)
    split = jnp.split(jnp.arange(q + r - 1), [head, q, q + near, q + r - 1 - arrow])
    own_people, own_cameras, people, cameras, last = split
    kept = own_people, people[: near - head], own_cameras, cameras[:-CAMERAS], last
    last = last[:g]
    kept, band = jnp.concatenate(kept), jnp.concatenate([own_cameras, cameras, last])

    def pair(apart):
        """Returns the indices of this chunk, the one `apart` places after it, and the
        globals."""
        block = lambda start, width: start + (apart - 1) * width + jnp.arange(width)
        other = block(q, head), block(q + near, CAMERAS)
        return jnp.concatenate([own_people, own_cameras, *other, last])

    def step(known, chunk):
        half, side, neighbours = chunk
        gain = half.T @ side[:-1].T
        mixed = -gain @ known
        own = half.T @ half - mixed @ gain.T
        whole = jnp.block([[own, mixed], [mixed.T, known]])
        part = lambda index: whole[index[:, None], index[None, :]]
        pairs = [part(pair(apart)) for apart in neighbours or (1,)]
        return part(kept), (pairs, part(band))

    def scan(*neighbours):
        chunks = factor.half, factor.side, neighbours
        _, (pairs, windows) = jax.lax.scan(step, start, chunks, reverse=True)
        return pairs, windows

    if order is None:
        (pairs,), windows = scan()
    else:
        place = jnp.argsort(order)
        follower = jnp.roll(place, -1)
        ahead = follower - place
        near_by = lambda apart: jnp.clip(apart, 1, sizes.reach)[order]
        (after, before), windows = scan(near_by(ahead), near_by(-jnp.roll(ahead, 1)))
        turned = jnp.r_[q : 2 * q, 0:q, 2 * q : 2 * q + g]
        before = before[follower][:, turned][:, :, turned]
        pairs = jnp.where((ahead > 0)[:, None, None], after[place], before)
    # Roots eliminated with their chunk couple with the chunk before: both stand in a
    # pair. The first chunk has none before it.
    at = q + jnp.arange(q + g)
    own = jnp.r_[0:q, 2 * q : 2 * q + g]
    alone = jnp.zeros_like(pairs[:1])
    alone = alone.at[:, at[:, None], at].set(pairs[:1, own[:, None], own])
    pairs = jnp.concatenate([alone, pairs[:-1]])
    by_chunk = jax.tree.map(lambda x: x.swapaxes(0, 1), roots)
    with_inner = lambda given: _with_inner(given[0], given[1], window, sizes)
    return jax.lax.map(with_inner, (pairs, by_chunk)), windows, common


def _with_inner(
    pair: Float[Array, "p p"], roots: RootFactor | None, window: Window, sizes: Sizes
) -> Float[Array, "f f"]:
    """Returns the covariance of all roots of a chunk, its cameras and the globals, from
    that of the kept variables of two chunks: eliminated roots are linear in these, with
    a conditional covariance of their own."""
    g, last, width = sizes.globals, 6 * window.reach, window.person
    q = (len(pair) - g) // 2
    eye = jnp.eye(len(pair), dtype=pair.dtype)
    rows, spread = [], jnp.zeros((0, 0), pair.dtype)
    halves, sides = ((), ()) if roots is None else (roots.half, roots.side)
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
        half, side = halves[p], sides[p]
        none = jnp.zeros((len(half), len(pair)), pair.dtype)
        rows.append(none.at[:, index].set(-half.T @ side[:-1].T))
        rows.append(eye[q + (p + 1) * width - last + jnp.arange(last)])
        spread = _diagonal(spread, half.T @ half, last)
    rows.append(eye[2 * q - CAMERAS :])
    turn = jnp.concatenate(rows)
    return turn @ pair @ turn.T + _diagonal(spread, eye[:0, :0], CAMERAS + g)


def _diagonal(first: Array, second: Array, more: int) -> Array:
    """Returns the block-diagonal matrix of both blocks, and `more` rows of zeros."""
    a, b = len(first), len(second)
    first = jnp.pad(first, ((0, b + more),) * 2)
    return first + jnp.pad(second, ((a, more),) * 2)
