"""Eliminates postures: a chain in time, cut into chunks that are eliminated together.

Inside a chunk of B frames the joint coordinates of all frames but the last go, frame
after frame, the same step in all chunks and people at once. What they leave couples the
border of the chunk (`_window.py`). Border columns are stored as rows, one after another
in memory, as products of these are half as fast again. Exact.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph import CHUNK
from bodyslam_jax.solver._blocks import Linearisation
from bodyslam_jax.solver._triangular import half_of
from bodyslam_jax.solver._window import Pairs, Window


class Postures(eqx.Module):
    """What elimination leaves, and what back-substitution needs."""

    half: Float[Array, "*n e p p"]
    """`L^-1` of each pivot `L L^T`, `e = B - 1` eliminated frames."""
    solved: Float[Array, "*n b e p"]
    """`L^-1` times border columns, transposed."""
    link: Float[Array, "*m r r"]
    """Coupling of the next frame (rows) with each eliminated one; joint by joint
    (3 x 3) where joints do not interact over time."""


def border_of(window: Window) -> tuple[str, ...]:
    """The groups that inner postures of a chunk touch, once they are eliminated."""
    if window.cross:
        between = "old_roots", "inner", "roots", "old_cameras", "cameras"
    else:
        between = "inner", "roots"
    return "before", *between, "common"


def _pose_blocks(blocks: dict, damping: Float[Array, "*b p"]) -> tuple[Array, Array]:
    """Postures with themselves, `*b p p`, and with those of the frame before, like
    `Postures.link`."""
    dtype = damping.dtype
    width = damping.shape[-1]
    own = damping[..., None] * jnp.eye(width, dtype=dtype)
    if ("pose", "pose", 0) in blocks:
        own = own + blocks["pose", "pose", 0]
    if ("joint", "joint", 0) in blocks:
        own = own + _to_dense(blocks["joint", "joint", 0])
    none = jnp.zeros((*damping.shape[:-1], width // 3, 3, 3), dtype)
    link = blocks.get(("joint", "joint", 1), none)
    if ("pose", "pose", 1) in blocks:
        link = blocks["pose", "pose", 1] + _to_dense(link)
    return own, link


def _to_dense(small: Float[Array, "*b j 3 3"]) -> Float[Array, "*b p p"]:
    """Blocks down the diagonal, by a product: scatters of so many are slow."""
    count = small.shape[-3]
    eye = jnp.eye(count, dtype=small.dtype)
    full = small[..., :, :, None, :] * eye[:, None, :, None]
    return full.reshape(*small.shape[:-3], 3 * count, 3 * count)


def _link_times(link: Array, x: Float[Array, "*b p c"]) -> Float[Array, "*b p c"]:
    if link.ndim == x.ndim:
        return link @ x
    rows = x.reshape(*x.shape[:-2], -1, 3, x.shape[-1])
    # Three fused products: a matrix product for each joint would be far too small.
    term = lambda b: link[..., b, None] * rows[..., b, None, :]
    return (term(0) + term(1) + term(2)).reshape(x.shape)


def pose_diagonal(lin: Linearisation) -> Float[Array, "h t p"]:
    total = jnp.zeros_like(lin.gradient["pose"])
    for kind in ("pose", "joint"):
        block = lin.blocks.get((kind, kind, 0))
        if block is not None:
            diagonal = jnp.diagonal(block, axis1=-2, axis2=-1)
            total = total + diagonal.reshape(total.shape).astype(total.dtype)
    return total


def posture_blocks(lin: Linearisation, damping: Float[Array, "h t p"]) -> tuple:
    """What `eliminate_postures` takes, of all frames; leading axes `h t`."""
    blocks = {k: v for k, v in lin.blocks.items() if k[0] in ("pose", "joint")}
    return blocks, lin.gradient["pose"], damping


def eliminate_postures(
    window: Window, blocks: dict, gradient: Array, damping: Float[Array, "g B p"]
) -> tuple[Postures, Pairs]:
    """Eliminates all postures but the last of each of `g` chunks, at the same time.

    Returns what they leave on pairs of the window's groups, too.
    """
    own, link = _pose_blocks(blocks, damping)
    slices = window.slices(border_of(window))
    at = lambda x, k: jax.lax.dynamic_index_in_dim(x, k, 1, keepdims=False)
    put = jax.lax.dynamic_update_index_in_dim
    turned = lambda x: x.swapaxes(-1, -2)
    raw = lambda k: _rows(window, blocks, gradient, k)

    def step(k, carry):
        pivot, rows, halves, solved = carry
        half = half_of(pivot)
        here = rows @ turned(half)
        forward = _link_times(at(link, k + 1), turned(half))
        pivot = at(own, k + 1) - forward @ turned(forward)
        rows = raw(k + 1) - here @ turned(forward)
        return pivot, rows, put(halves, half, k, 1), put(solved, here, k, 2)

    before = at(link, 0) if link.ndim == 4 else _to_dense(at(link, 0))
    rows = raw(0).at[:, : window.pose].set(turned(before))
    halves = jnp.zeros((len(rows), CHUNK - 1, *own.shape[2:]), rows.dtype)
    solved = jnp.zeros((*rows.shape[:2], CHUNK - 1, window.pose), rows.dtype)
    carry = own[:, 0], rows, halves, solved
    pivot, rows, halves, solved = jax.lax.fori_loop(0, CHUNK - 1, step, carry)
    wide = solved.reshape(*rows.shape[:2], -1)
    update = -(wide @ turned(wide))
    names = list(slices)
    left = {
        (name, other): update[:, slices[name], slices[other]]
        for i, name in enumerate(names)
        for other in names[: i + 1]
    }
    left["sep", "sep"] = pivot
    left |= {(name, "sep"): rows[:, part] for name, part in slices.items()}
    return Postures(halves, solved, link[:, 1:]), left


def _rows(window: Window, blocks: dict, gradient: Array, k) -> Float[Array, "g b p"]:
    """Blocks of frame k of each chunk against the border; of the posture before it,
    only frame 0 knows."""
    at = lambda x: jax.lax.dynamic_index_in_dim(x, k, 1, keepdims=False)
    dtype = gradient.dtype
    reach = window.reach if window.cross else 0
    pose = window.pose
    parts = [jnp.zeros((len(gradient), pose, pose), dtype)]
    for name in ("root", "camera") if window.cross else ("root",):
        total = jnp.zeros((len(gradient), 6 * (CHUNK + reach), pose), dtype)
        for lag in (-1, 0, 1):
            block = blocks.get(("pose", name, lag))
            if block is not None:
                # Frame k against frame k - lag.
                place = jnp.eye(CHUNK, CHUNK + reach, k=reach - lag, dtype=dtype)
                place = jax.lax.dynamic_index_in_dim(place, k, 0, keepdims=False)
                wide = at(block).swapaxes(-1, -2)[:, None] * place[:, None, None]
                total = total + wide.reshape(total.shape)
        parts.append(total)
    common = blocks.get(("pose", "globals", 0))
    if common is None:
        parts.append(jnp.zeros((len(gradient), window.own_globals, pose), dtype))
    else:
        parts.append(at(common).swapaxes(-1, -2))
    parts.append(-at(gradient)[:, None])
    return jnp.concatenate(parts, axis=1)


def substitute_postures(
    postures: Postures,
    border_step: Float[Array, "g b"],
    separator_step: Float[Array, "g p"],
) -> Float[Array, "g B p"]:
    """Steps of all postures of chunks from those of the border (without the right-hand
    side's row) and of their last postures."""
    g, _, count, _ = postures.solved.shape
    # -1 for the right-hand side: the whole table as it is, without a copy of a part.
    known = jnp.pad(border_step, ((0, 0), (0, 1)), constant_values=-1.0)
    right = -(known[:, None] @ postures.solved.reshape(g, known.shape[1], -1))
    right = right.reshape(g, count, -1)
    at = lambda x, k: jax.lax.dynamic_index_in_dim(x, k, 1, keepdims=False)

    def step(i, carry):
        following, steps = carry
        k = CHUNK - 2 - i
        back = _link_times(at(postures.link, k).swapaxes(-1, -2), following[..., None])
        row = at(right, k)[..., None] - at(postures.half, k) @ back
        here = (at(postures.half, k).swapaxes(-1, -2) @ row)[..., 0]
        return here, jax.lax.dynamic_update_index_in_dim(steps, here, k, 1)

    empty = jnp.zeros(
        (len(separator_step), CHUNK, separator_step.shape[1]), separator_step.dtype
    )
    empty = empty.at[:, -1].set(separator_step)
    return jax.lax.fori_loop(0, CHUNK - 1, step, (separator_step, empty))[1]
