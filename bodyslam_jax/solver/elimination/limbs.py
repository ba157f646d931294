"""Posture coordinates cut into limbs, joints that measurements see together.

Coordinates stand limb after limb, narrow ones first. Limbs of one width are worked on
at once: lists here have an entry for each width, of `l` limbs with `p` coordinates.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Widths = tuple[tuple[int, int], ...]
"""How many limbs have how many coordinates."""


def cut(limbs: Widths, x: Array, axis: int, width: int = 1) -> list[Array]:
    """Coordinates along an axis (`width` of them in one entry) by limbs: `... l p ...`
    for each width."""
    parts, start = [], 0
    for count, size in limbs:
        stop = start + count * size // width
        part = jax.lax.slice_in_dim(x, start, stop, axis=axis)
        shape = (*x.shape[:axis], count, size // width, *x.shape[axis + 1 :])
        parts.append(part.reshape(shape))
        start = stop
    return parts


def diagonal(limbs: Widths, x: Float[Array, "*b c c"]) -> list[Array]:
    """Blocks of limbs with themselves, `*b l p p` for each width: others are 0."""
    parts, start = [], 0
    for count, size in limbs:
        here = [slice(start + i * size, start + (i + 1) * size) for i in range(count)]
        parts.append(jnp.stack([x[..., k, k] for k in here], axis=-3))
        start += count * size
    return parts


def squares(limbs: Widths, x: Float[Array, "*b r c"]) -> list[Array]:
    """Products of the columns of each limb with themselves, `*b l p p` for each width.

    A limb at a time: products with two batch axes take three times as long.
    """
    square = lambda y: jnp.einsum("...ra,...rb->...ab", y, y)
    parts, start = [], 0
    for count, size in limbs:
        starts = range(start, start + count * size, size)
        same = [square(x[..., k : k + size]) for k in starts]
        parts.append(jnp.stack(same, axis=-3))
        start += count * size
    return parts


def whole(limbs: Widths, parts: list[Array]) -> Float[Array, "g c c"]:
    """The other way round: blocks `g l p p` down the diagonal."""
    total = sum(count * size for count, size in limbs)
    lines, start = [], 0
    for (count, size), part in zip(limbs, parts, strict=True):
        for i in range(count):
            after = total - start - size
            lines.append(jnp.pad(part[:, i], ((0, 0), (0, 0), (start, after))))
            start += size
    return jnp.concatenate(lines, axis=-2)


def joined(parts: list[Array]) -> Float[Array, "g r c"]:
    """Columns of all limbs, `g l r p`, side by side."""
    columns = [x.swapaxes(1, 2).reshape(len(x), x.shape[2], -1) for x in parts]
    return jnp.concatenate(columns, axis=-1)


def to_dense(small: Float[Array, "*b j 3 3"]) -> Float[Array, "*b p p"]:
    """Blocks down the diagonal, by a product: scatters of so many are slow."""
    count = small.shape[-3]
    eye = jnp.eye(count, dtype=small.dtype)
    full = small[..., :, :, None, :] * eye[:, None, :, None]
    return full.reshape(*small.shape[:-3], 3 * count, 3 * count)


def flat(x: Array) -> Array:
    """Its two first axes as one."""
    return x.reshape(-1, *x.shape[2:])


def link_times(link: Array, x: Float[Array, "*b p c"]) -> Float[Array, "*b p c"]:
    """A product with what couples two frames: of whole limbs, or joint by joint."""
    if link.ndim == x.ndim:
        return link @ x
    rows = x.reshape(*x.shape[:-2], -1, 3, x.shape[-1])
    # Three fused products: a matrix product for each joint would be far too small.
    term = lambda b: link[..., b, None] * rows[..., b, None, :]
    return (term(0) + term(1) + term(2)).reshape(x.shape)


def squares_of_rows(parts: tuple[Float[Array, "m _b _e p"], ...]) -> Array:
    """Products of rows with each other, `m b b`, added up; the first parts lack rows at
    the end, which are 0 there."""
    wide = [x.reshape(*x.shape[:2], -1) for x in parts]
    size = wide[-1].shape[1]
    more = [(0, size - x.shape[1]) for x in wide]
    each = [
        jnp.pad(x @ x.swapaxes(-1, -2), ((0, 0), width, width))
        for x, width in zip(wide, more, strict=True)
    ]
    return functools.reduce(jnp.add, each)
