"""Eliminates postures: a chain in time, cut into chunks that are eliminated together.

Inside a chunk of B frames the 69 joint coordinates of all frames but the last go, frame
after frame, the same step in all chunks and people at once. What they leave couples the
`border` of the chunk: the last posture before it, its own last posture (separators),
its roots, and the person's globals. Exact; about 7 MFLOP a frame.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph import CHUNK
from bodyslam_jax.solver._blocks import Linearisation, Sizes
from bodyslam_jax.solver._triangular import half_of

POSE = 69
GROUP = 16
"""Chunks eliminated together, at most."""


class Border(eqx.Module):
    """Columns of a chunk's border; the last column of all is the right-hand side."""

    cross: bool = eqx.field(static=True)
    """Whether postures couple with cameras, or with roots of other frames."""
    own_globals: int = eqx.field(static=True)

    @property
    def before(self) -> slice:
        """Last posture of the chunk before; with `cross`, its last root and camera."""
        return slice(0, POSE + (12 if self.cross else 0))

    @property
    def roots(self) -> slice:
        start = self.before.stop
        return slice(start, start + 6 * CHUNK)

    @property
    def cameras(self) -> slice:
        start = self.roots.stop
        return slice(start, start + (6 * CHUNK if self.cross else 0))

    @property
    def globals(self) -> slice:
        start = self.cameras.stop
        return slice(start, start + self.own_globals)

    @property
    def rhs(self) -> int:
        return self.globals.stop


class Postures(eqx.Module):
    """What elimination leaves, and what back-substitution needs; axes `h n`, or
    one group of chunks."""

    half: Float[Array, "*h n e 69 69"]
    """`L^-1` of each pivot `L L^T`, `e = B - 1` eliminated frames."""
    solved: Float[Array, "*h n e 69 b"]
    """`L^-1` times border columns."""
    link: Float[Array, "*b r r"]
    """Coupling of the next frame (rows) with each eliminated one; joint by joint (23
    of 3 x 3) where joints do not interact over time."""
    separator: Float[Array, "*h n 69 69"]
    separator_border: Float[Array, "*h n 69 b"]
    border: Float[Array, "*h n b b"]
    """To be added to the border's own blocks (negative)."""


def border_of(lin: Linearisation, sizes: Sizes) -> Border:
    cross = any(
        key[0] == "pose" and (key[1] == "camera" or (key[1] == "root" and key[2]))
        for key in lin.blocks
    )
    return Border(cross, sizes.own_globals)


def _pose_blocks(blocks: dict, damping: Float[Array, "*b 69"]) -> tuple[Array, Array]:
    """Postures with themselves, `*b 69 69`, and with those of the frame before, like
    `Postures.link`."""
    dtype = damping.dtype
    own = damping[..., None] * jnp.eye(POSE, dtype=dtype)
    if ("pose", "pose", 0) in blocks:
        own = own + blocks["pose", "pose", 0]
    if ("joint", "joint", 0) in blocks:
        own = own + _to_dense(blocks["joint", "joint", 0])
    none = jnp.zeros((*damping.shape[:-1], 23, 3, 3), dtype)
    link = blocks.get(("joint", "joint", 1), none)
    if ("pose", "pose", 1) in blocks:
        link = blocks["pose", "pose", 1] + _to_dense(link)
    return own, link


def _to_dense(small: Float[Array, "*b 23 3 3"]) -> Float[Array, "*b 69 69"]:
    """Blocks down the diagonal, by a product: scatters of so many are slow."""
    eye = jnp.eye(23, dtype=small.dtype)
    full = small[..., :, :, None, :] * eye[:, None, :, None]
    return full.reshape(*small.shape[:-3], POSE, POSE)


def _link_times(link: Array, x: Float[Array, "*b 69 c"]) -> Float[Array, "*b 69 c"]:
    if link.ndim == x.ndim:
        return link @ x
    rows = x.reshape(*x.shape[:-2], 23, 3, x.shape[-1])
    # Three fused products: a matrix product for each joint would be far too small.
    term = lambda b: link[..., b, None] * rows[..., b, None, :]
    return (term(0) + term(1) + term(2)).reshape(x.shape)


def pose_diagonal(lin: Linearisation) -> Float[Array, "h t 69"]:
    total = jnp.zeros_like(lin.gradient["pose"])
    for kind in ("pose", "joint"):
        block = lin.blocks.get((kind, kind, 0))
        if block is not None:
            diagonal = jnp.diagonal(block, axis1=-2, axis2=-1)
            total = total + diagonal.reshape(total.shape)
    return total


def eliminate_postures(
    lin: Linearisation, sizes: Sizes, damping: Float[Array, "h t 69"]
) -> Postures:
    """Eliminates all postures but the last of each chunk; `damping` joins diagonals."""
    border = border_of(lin, sizes)
    h, n = sizes.people, sizes.chunks
    blocks = {k: v for k, v in lin.blocks.items() if k[0] in ("pose", "joint")}
    given = blocks, lin.gradient["pose"], damping
    together = group_size(h * n)
    cut = lambda x: x.reshape(-1, together, CHUNK, *x.shape[2:])
    found = jax.lax.map(
        lambda x: _eliminate_group(border, *x), jax.tree.map(cut, given)
    )
    return jax.tree.map(lambda x: x.reshape(h, n, *x.shape[2:]), found)


def group_size(count: int) -> int:
    """How many chunks are eliminated together: enough that small steps do not wait for
    each other, few enough that what they work on stays in the processor's cache."""
    return max(size for size in range(1, GROUP + 1) if count % size == 0)


def _eliminate_group(border: Border, blocks: dict, gradient: Array, damping: Array):
    """The same for chunks `g` that are eliminated together, axes `g B`."""
    own, link = _pose_blocks(blocks, damping)
    raw = _border_columns(border, blocks, gradient, link)
    at = lambda x, k: jax.lax.dynamic_index_in_dim(x, k, 1, keepdims=False)
    put = jax.lax.dynamic_update_index_in_dim

    def step(k, carry):
        pivot, columns, halves, solved = carry
        half = half_of(pivot)
        here = half @ columns
        forward = _link_times(at(link, k + 1), half.swapaxes(-1, -2))
        pivot = at(own, k + 1) - forward @ forward.swapaxes(-1, -2)
        columns = at(raw, k + 1) - forward @ here
        return pivot, columns, put(halves, half, k, 1), put(solved, here, k, 1)

    pivot, columns = own[:, 0], raw[:, 0]
    empty = lambda x: jnp.zeros((len(x), CHUNK - 1, *x.shape[1:]), x.dtype)
    carry = pivot, columns, empty(pivot), empty(columns)
    pivot, columns, halves, solved = jax.lax.fori_loop(0, CHUNK - 1, step, carry)
    tall = solved.reshape(len(solved), -1, solved.shape[-1])
    update = -tall.swapaxes(-1, -2) @ tall
    return Postures(halves, solved, link[:, 1:], pivot, columns, update)


def _border_columns(border, blocks, gradient, link):
    """Columns of each posture of a chunk, `g B 69 b`, against the chunk's border."""
    g = len(gradient)
    dtype = gradient.dtype
    none = lambda width: jnp.zeros((g, CHUNK, POSE, width), dtype)
    is_first = jnp.eye(1, CHUNK, dtype=dtype)[0][:, None, None]
    dense = link if link.ndim == 4 else _to_dense(link)
    parts = [dense * is_first]
    if border.cross:
        for name in ("root", "camera"):
            block = blocks.get(("pose", name, 1))
            parts.append(none(6) if block is None else block * is_first)
    for name in ("root", "camera") if border.cross else ("root",):
        total = none(6 * CHUNK)
        for lag in (-1, 0, 1):
            block = blocks.get(("pose", name, lag))
            if block is not None:
                # Frame k of the chunk against frame k - lag of the same chunk.
                place = jnp.eye(CHUNK, k=-lag, dtype=dtype)[:, None, :, None]
                total = total + (block[:, :, :, None, :] * place).reshape(total.shape)
        parts.append(total)
    common = blocks.get(("pose", "globals", 0))
    parts.append(none(border.own_globals) if common is None else common)
    parts.append(-gradient[..., None])
    return jnp.concatenate(parts, axis=-1)


def substitute_postures(
    postures: Postures,
    border_step: Float[Array, "h n b"],
    separator_step: Float[Array, "h n 69"],
) -> Float[Array, "h t 69"]:
    """Steps of all postures from those of the border (without the rhs column)."""
    h, n = separator_step.shape[:2]

    def group(known):
        half, solved, link, border, last = known
        right = solved[..., -1] - (solved[..., :-1] @ border[:, None, :, None])[..., 0]
        at = lambda x, k: jax.lax.dynamic_index_in_dim(x, k, 1, keepdims=False)

        def step(i, carry):
            following, steps = carry
            k = CHUNK - 2 - i
            back = _link_times(at(link, k).swapaxes(-1, -2), following[..., None])
            row = at(right, k)[..., None] - at(half, k) @ back
            here = (at(half, k).swapaxes(-1, -2) @ row)[..., 0]
            return here, jax.lax.dynamic_update_index_in_dim(steps, here, k, 1)

        empty = jnp.zeros((len(last), CHUNK, POSE), last.dtype).at[:, -1].set(last)
        return jax.lax.fori_loop(0, CHUNK - 1, step, (last, empty))[1]

    together = group_size(h * n)
    cut = lambda x: x.reshape(-1, together, *x.shape[2:])
    given = postures.half, postures.solved, postures.link, border_step, separator_step
    return jax.lax.map(group, jax.tree.map(cut, given)).reshape(h, -1, POSE)
