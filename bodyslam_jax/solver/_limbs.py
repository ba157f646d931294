"""Posture coordinates cut into limbs, joints that measurements see together.

Coordinates stand limb after limb, narrow ones first. Limbs of one width are worked on
at once: lists here have an entry for each width, of `l` limbs with `p` coordinates.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.solver._window import Window


def cut(window: Window, x: Array, axis: int, width: int = 1) -> list[Array]:
    """Coordinates along an axis (`width` of them in one entry) by limbs: `... l p ...`
    for each width."""
    parts, start = [], 0
    for count, size in window.limbs:
        stop = start + count * size // width
        part = jax.lax.slice_in_dim(x, start, stop, axis=axis)
        shape = (*x.shape[:axis], count, size // width, *x.shape[axis + 1 :])
        parts.append(part.reshape(shape))
        start = stop
    return parts


def diagonal(window: Window, x: Float[Array, "*b c c"]) -> list[Array]:
    """Blocks of limbs with themselves, `*b l p p` for each width: others are 0."""
    parts, start = [], 0
    for count, size in window.limbs:
        here = [slice(start + i * size, start + (i + 1) * size) for i in range(count)]
        parts.append(jnp.stack([x[..., k, k] for k in here], axis=-3))
        start += count * size
    return parts


def whole(window: Window, parts: list[Array]) -> Float[Array, "g c c"]:
    """The other way round: blocks `g l p p` down the diagonal."""
    lines, start = [], 0
    for (count, size), part in zip(window.limbs, parts, strict=True):
        for i in range(count):
            after = window.pose - start - size
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
