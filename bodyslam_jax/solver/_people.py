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

POSE = 69


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
    """What elimination leaves, and what back-substitution needs; axes `h n`."""

    inverse: Float[Array, "e h n 69 69"]
    """Inverse of each pivot, `e = B - 1` eliminated frames."""
    solved: Float[Array, "e h n 69 b"]
    """Pivot inverse times border columns."""
    link: Float[Array, "e h n *joint r r"]
    """Coupling of the next frame (rows) with each eliminated one; joint by joint (23
    of 3 x 3) where joints do not interact over time."""
    separator: Float[Array, "h n 69 69"]
    separator_border: Float[Array, "h n 69 b"]
    border: Float[Array, "h n b b"]
    """To be added to the border's own blocks (negative)."""


def border_of(lin: Linearisation, sizes: Sizes) -> Border:
    cross = any(
        key[0] == "pose" and (key[1] == "camera" or (key[1] == "root" and key[2]))
        for key in lin.blocks
    )
    return Border(cross, sizes.own_globals)


def pose_blocks(lin: Linearisation) -> tuple[Array, Array]:
    """Postures with themselves, `h t 69 69`, and with those of the frame before, like
    `Postures.link`."""
    h, t = lin.gradient["pose"].shape[:2]
    dtype = lin.gradient["pose"].dtype
    own = lin.blocks.get(("pose", "pose", 0), jnp.zeros((h, t, POSE, POSE), dtype))
    if ("joint", "joint", 0) in lin.blocks:
        own = own + _to_dense(lin.blocks["joint", "joint", 0])
    link = lin.blocks.get(("joint", "joint", 1), jnp.zeros((h, t, 23, 3, 3), dtype))
    if ("pose", "pose", 1) in lin.blocks:
        link = lin.blocks["pose", "pose", 1] + _to_dense(link)
    return own, link


def _to_dense(small: Float[Array, "*b 23 3 3"]) -> Float[Array, "*b 69 69"]:
    """Blocks down the diagonal, by a product: scatters of so many are slow."""
    eye = jnp.eye(23, dtype=small.dtype)
    full = small[..., :, :, None, :] * eye[:, None, :, None]
    return full.reshape(*small.shape[:-3], POSE, POSE)


def _link_times(link: Array, x: Float[Array, "h n 69 c"]) -> Float[Array, "h n 69 c"]:
    if link.ndim == 4:
        return link @ x
    rows = x.reshape(*x.shape[:2], 23, 3, x.shape[-1])
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
    own, link = pose_blocks(lin)
    own = own + damping[..., None] * jnp.eye(POSE, dtype=damping.dtype)
    cut = lambda x: x.reshape(h, n, CHUNK, *x.shape[2:])
    own, link = cut(own), cut(link)
    raw = _border_columns(lin, border, link, cut)
    inner_first = lambda x: jnp.moveaxis(x, 2, 0)

    def step(carry, following):
        pivot, columns, update = carry
        next_own, forward, next_raw = following
        inverse = invert(pivot)
        product = inverse @ columns
        update = update - jnp.einsum("hnka,hnkb->hnab", columns, product)
        half = _link_times(forward, inverse).swapaxes(-1, -2)
        next_pivot = next_own - _link_times(forward, half)
        next_columns = next_raw - _link_times(forward, product)
        return (next_pivot, next_columns, update), (inverse, product)

    width = border.rhs + 1
    start = own[:, :, 0], raw[:, :, 0], jnp.zeros((h, n, width, width), own.dtype)
    rest = tuple(inner_first(x[:, :, 1:]) for x in (own, link, raw))
    (pivot, columns, update), (inverse, product) = jax.lax.scan(step, start, rest)
    return Postures(inverse, product, rest[1], pivot, columns, update)


def invert(matrix: Float[Array, "*b n n"]) -> Float[Array, "*b n n"]:
    """Inverse of positive definite matrices; NaN where one is not."""
    half = _invert_lower(jnp.linalg.cholesky(matrix, symmetrize_input=False))
    return half.swapaxes(-1, -2) @ half


def _invert_lower(lower: Float[Array, "*b n n"]) -> Float[Array, "*b n n"]:
    """Inverse of triangular matrices, halved until little is left: matrix products are
    ten times as fast as substitution.

    Without LAPACK's: two of jaxlib's batched solves at the same time (0.10.2, on two
    cores) wait for each other's threads for ever.
    """
    n = lower.shape[-1]
    if n <= 24:
        return _substitute(lower)
    cut = n // 2
    first = _invert_lower(lower[..., :cut, :cut])
    last = _invert_lower(lower[..., cut:, cut:])
    mixed = -last @ (lower[..., cut:, :cut] @ first)
    top = jnp.concatenate([first, jnp.zeros_like(mixed.swapaxes(-1, -2))], axis=-1)
    return jnp.concatenate([top, jnp.concatenate([mixed, last], axis=-1)], axis=-2)


def _substitute(lower: Float[Array, "*b n n"]) -> Float[Array, "*b n n"]:
    """The same, one row after another taken from all below it."""
    index = jnp.arange(lower.shape[-1])

    def one(k, inverse):
        column = jax.lax.dynamic_index_in_dim(lower, k, -1)
        pivot = jax.lax.dynamic_index_in_dim(column, k, -2)
        row = jax.lax.dynamic_index_in_dim(inverse, k, -2) / pivot
        below = jnp.where((index > k)[:, None], column, 0.0)
        return jnp.where((index == k)[:, None], row, inverse - below * row)

    eye = jnp.broadcast_to(jnp.eye(len(index), dtype=lower.dtype), lower.shape)
    return jax.lax.fori_loop(0, len(index), one, eye)


def _border_columns(lin, border, link, cut):
    """Columns of each posture of a chunk, `h n B 69 b`, against the chunk's border."""
    h, n = link.shape[:2]
    dtype = link.dtype
    none = lambda width: jnp.zeros((h, n, CHUNK, POSE, width), dtype)
    is_first = jnp.eye(1, CHUNK, dtype=dtype)[0][:, None, None]
    dense = link if link.ndim == 5 else _to_dense(link)
    parts = [dense * is_first]
    if border.cross:
        for name in ("root", "camera"):
            block = lin.blocks.get(("pose", name, 1))
            parts.append(none(6) if block is None else cut(block) * is_first)
    for name in ("root", "camera") if border.cross else ("root",):
        total = none(6 * CHUNK)
        for lag in (-1, 0, 1):
            block = lin.blocks.get(("pose", name, lag))
            if block is not None:
                # Frame k of the chunk against frame k - lag of the same chunk.
                place = jnp.eye(CHUNK, k=-lag, dtype=dtype)[:, None, :, None]
                wide = cut(block)[:, :, :, :, None, :] * place
                total = total + wide.reshape(total.shape)
        parts.append(total)
    common = lin.blocks.get(("pose", "globals", 0))
    parts.append(none(border.own_globals) if common is None else cut(common))
    parts.append(-cut(lin.gradient["pose"])[..., None])
    return jnp.concatenate(parts, axis=-1)


def substitute_postures(
    postures: Postures,
    border_step: Float[Array, "h n b"],
    separator_step: Float[Array, "h n 69"],
) -> Float[Array, "h t 69"]:
    """Steps of all postures from those of the border (without the rhs column)."""

    def step(following, kept):
        inverse, solved, link = kept
        here = solved[..., -1]
        here = here - jnp.einsum("hnab,hnb->hna", solved[..., :-1], border_step)
        back = _link_times(link.swapaxes(-1, -2), following[..., None])
        here = here - (inverse @ back)[..., 0]
        return here, here

    kept = postures.inverse, postures.solved, postures.link
    _, steps = jax.lax.scan(step, separator_step, kept, reverse=True)
    steps = jnp.concatenate([jnp.moveaxis(steps, 0, 2), separator_step[:, :, None]], 2)
    return steps.reshape(steps.shape[0], -1, POSE)
