"""Eliminates postures: a chain in time, cut into chunks that are eliminated together.

Inside a chunk of B frames the joint coordinates of all frames but the last go, frame
after frame, the same step in all chunks and people at once. What they leave couples the
border of the chunk (`front.py`). Joints that no measurement sees together, such as
those of the two legs, are limbs: each is eliminated by itself, limbs of one width at
once. The roots of later frames have no part in the first frames: these go with fewer
columns. Border columns are stored as rows, one after another in memory, as products of
these are half as fast again. Exact.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph import CHUNK
from bodyslam_jax.solver.blocks import Linearisation
from bodyslam_jax.solver.elimination.limbs import (
    cut,
    flat,
    joined,
    link_times,
    squares_of_rows,
    to_dense,
    whole,
)
from bodyslam_jax.solver.front import Pairs, Window
from bodyslam_jax.solver.loops import row_of, with_row
from bodyslam_jax.solver.triangular import half_of


class Limbs(eqx.Module):
    """What elimination of `l` limbs of one width leaves, for back-substitution."""

    half: Float[Array, "*n l e p p"]
    """`L^-1` of each pivot `L L^T`, `e = B - 1` eliminated frames."""
    solved: tuple[Float[Array, "*n l _b _e p"], ...]
    """`L^-1` times border columns, transposed; an entry for each of the `phases_of`."""
    link: Float[Array, "*m r r"]
    """Coupling of the next frame (rows) with each eliminated one; joint by joint
    (3 x 3) where joints do not interact over time."""


Postures = tuple[Limbs, ...]
"""One entry for each width."""


def border_of(window: Window) -> tuple[str, ...]:
    """The groups that inner postures of a chunk touch, once they are eliminated."""
    if window.cross:
        between = "old_roots", "inner", "roots", "old_cameras", "cameras"
    else:
        between = "inner", "roots"
    return "before", "common", *between


def phases_of(window: Window) -> tuple[tuple[int, int, int], ...]:
    """Frames from one up to another, and how many columns at the end of the border
    they do not touch: roots of later frames."""
    if window.cross:
        return ((0, CHUNK - 1, 0),)
    middle = CHUNK // 2
    return (0, middle, 6 * (CHUNK - middle)), (middle, CHUNK - 1, 0)


def _pose_blocks(
    window: Window, limbs: dict, blocks: dict, damping: Float[Array, "g B c"]
) -> tuple[list[Array], list[Array]]:
    """Limbs with themselves, `g B l p p`, and with those of the frame before, like
    `Limbs.link`."""
    dtype = damping.dtype
    own = [
        x[..., None] * jnp.eye(x.shape[-1], dtype=dtype)
        for x in cut(window.limbs, damping, 2)
    ]
    joint = blocks.get(("joint", "joint", 0))
    if joint is not None:
        small = cut(window.limbs, joint, 2, 3)
        own = [x + to_dense(y) for x, y in zip(own, small, strict=True)]
    dense = limbs.get(0)
    if dense is not None:
        own = [x + y for x, y in zip(own, dense, strict=True)]
    none = jnp.zeros((*damping.shape[:-1], window.pose // 3, 3, 3), dtype)
    link = cut(window.limbs, blocks.get(("joint", "joint", 1), none), 2, 3)
    dense = limbs.get(1)
    if dense is not None:
        link = [to_dense(x) + y for x, y in zip(link, dense, strict=True)]
    return own, link


def posture_blocks(lin: Linearisation, damping: Float[Array, "h t c"]) -> tuple:
    """What `eliminate_postures` takes, of all frames; leading axes `h t`."""
    blocks = {k: v for k, v in lin.blocks.items() if k[0] in ("pose", "joint")}
    return lin.limbs, blocks, lin.gradient["pose"], damping


def eliminate_postures(
    window: Window,
    limbs: dict,
    blocks: dict,
    gradient: Array,
    damping: Float[Array, "g B c"],
) -> tuple[Postures, Pairs]:
    """Eliminates all postures but the last of each of `g` chunks, at the same time.

    Returns what they leave on pairs of the window's groups, too.
    """
    # Limbs of one width, of all chunks, one after another: a product with two batch
    # axes takes three times as long as with one.
    by_limb = lambda xs: [flat(x.swapaxes(1, 2)) for x in xs]
    own, link = map(by_limb, _pose_blocks(window, limbs, blocks, damping))
    at = lambda x, k: row_of(x, k, 1)
    put = with_row
    turned = lambda x: x.swapaxes(-1, -2)
    raw = lambda k: [flat(x) for x in _rows(window, blocks, gradient, k)]

    def eliminate(k, own, link, raw, known):
        pivot, rows, halves, solved = known
        half = half_of(pivot)
        here = rows @ turned(half)
        forward = link_times(at(link, k + 1), turned(half))
        pivot = at(own, k + 1) - forward @ turned(forward)
        rows = raw[:, : rows.shape[1]] - here @ turned(forward)
        return pivot, rows, put(halves, half, k, 1), put(solved, here, k - start, 2)

    def step(k, carry):
        given = own, link, raw(k + 1), carry
        return [eliminate(k, *same) for same in zip(*given, strict=True)]

    def first(own, link, rows):
        before = at(link, 0) if link.ndim == 4 else to_dense(at(link, 0))
        rows = rows.at[:, : own.shape[-1]].set(turned(before))
        halves = jnp.zeros((len(own), CHUNK - 1, *own.shape[2:]), rows.dtype)
        return own[:, 0], rows, halves

    known = [first(*same) for same in zip(own, link, raw(0), strict=True)]
    solved = []
    for start, stop, late in phases_of(window):
        carry = []
        for (pivot, rows, halves), more in zip(known, raw(start), strict=True):
            count = more.shape[1] - late
            new = more[:, rows.shape[1] : count]
            rows = jnp.concatenate([rows[:, :count], new], axis=1)
            shape = *rows.shape[:2], stop - start, rows.shape[2]
            carry.append((pivot, rows, halves, jnp.zeros(shape, rows.dtype)))
        carry = jax.lax.fori_loop(start, stop, step, carry)
        known = [(pivot, rows, halves) for pivot, rows, halves, _ in carry]
        solved.append([found for *_, found in carry])
    by_chunk = lambda x: x.reshape(len(gradient), -1, *x.shape[1:])
    of_limbs = list(zip(*solved, strict=True))
    postures = tuple(
        Limbs(by_chunk(halves), tuple(map(by_chunk, parts)), by_chunk(coupling[:, 1:]))
        for (*_, halves), parts, coupling in zip(known, of_limbs, link, strict=True)
    )
    updates = [by_chunk(-squares_of_rows(parts)) for parts in of_limbs]
    pivots = [by_chunk(pivot) for pivot, *_ in known]
    rows = [by_chunk(rows) for _, rows, _ in known]
    return postures, _left(window, pivots, rows, updates)


def _left(
    window: Window, pivots: list[Array], rows: list[Array], updates: list[Array]
) -> Pairs:
    """What limbs leave on pairs of groups, from pivots and rows of the last posture and
    from what the others take from the border."""
    widths = [size for _, size in window.limbs]
    # What the limb was in the chunk before comes first, then the rest of the border.
    mine = lambda xs: [x[:, :, :p] for x, p in zip(xs, widths, strict=True)]
    rest = lambda xs: [x[:, :, p:] for x, p in zip(xs, widths, strict=True)]
    on_mine = lambda xs: [x[..., :p] for x, p in zip(xs, widths, strict=True)]
    on_rest = lambda xs: [x[..., p:] for x, p in zip(xs, widths, strict=True)]
    both = functools.reduce(
        jnp.add, (jnp.sum(x, axis=1) for x in on_rest(rest(updates)))
    )
    before, last = joined(on_mine(rest(updates))), joined(rest(rows))
    left = {
        ("before", "before"): whole(window.limbs, on_mine(mine(updates))),
        ("before", "sep"): whole(window.limbs, mine(rows)),
        ("sep", "sep"): whole(window.limbs, pivots),
    }
    slices = window.slices(border_of(window)[1:])
    names = list(slices)
    for i, name in enumerate(names):
        left[name, "before"] = before[:, slices[name]]
        left[name, "sep"] = last[:, slices[name]]
        for other in names[: i + 1]:
            left[name, other] = both[:, slices[name], slices[other]]
    return left


def _rows(window: Window, blocks: dict, gradient: Array, k) -> list[Array]:
    """Blocks of frame k of each chunk against the border, `g l b p` for each width; of
    the posture before it, only frame 0 knows."""
    at = lambda x: row_of(x, k, 1)
    dtype = gradient.dtype
    reach = window.reach if window.cross else 0
    common = blocks.get(("pose", "globals", 0))
    if common is None:
        common = jnp.zeros((len(gradient), window.own_globals, window.pose), dtype)
    else:
        common = at(common).swapaxes(-1, -2)
    parts = [common, -at(gradient)[:, None]]
    for name in ("root", "camera") if window.cross else ("root",):
        total = jnp.zeros((len(gradient), 6 * (CHUNK + reach), window.pose), dtype)
        for lag in (-1, 0, 1):
            block = blocks.get(("pose", name, lag))
            if block is not None:
                # Frame k against frame k - lag.
                place = jnp.eye(CHUNK, CHUNK + reach, k=reach - lag, dtype=dtype)
                place = row_of(place, k)
                wide = at(block).swapaxes(-1, -2)[:, None] * place[:, None, None]
                total = total + wide.reshape(total.shape)
        parts.append(total)
    rest = cut(window.limbs, jnp.concatenate(parts, axis=1), 2)
    before = lambda x: ((0, 0), (0, 0), (x.shape[3], 0), (0, 0))
    return [jnp.pad(x.swapaxes(1, 2), before(x)) for x in rest]


def substitute_postures(
    window: Window,
    postures: Postures,
    border_step: Float[Array, "g b"],
    separator_step: Float[Array, "g c"],
) -> Float[Array, "g B c"]:
    """Steps of all postures of chunks from those of the border (-1 for the right-hand
    side) and of their last postures."""
    before = cut(window.limbs, border_step[:, : window.pose], 1)
    rest = border_step[:, None, window.pose :]
    moved = []
    for limbs, old, last in zip(
        postures, before, cut(window.limbs, separator_step, 1), strict=True
    ):
        wide = jnp.broadcast_to(rest, (*old.shape[:2], rest.shape[2]))
        moved.append(_substitute(limbs, jnp.concatenate([old, wide], axis=-1), last))
    return jnp.concatenate(moved, axis=-1)


def _substitute(
    limbs: Limbs, border_step: Float[Array, "g l b"], last: Float[Array, "g l p"]
) -> Float[Array, "g B c"]:
    g, l, _, p, _ = limbs.half.shape
    half, link, known = map(flat, (limbs.half, limbs.link, border_step))
    right = []
    for solved in map(flat, limbs.solved):
        wide = solved.reshape(*solved.shape[:2], -1)
        here = -(known[:, None, : solved.shape[1]] @ wide)
        right.append(here.reshape(g * l, -1, p))
    right = jnp.concatenate(right, axis=1)
    at = lambda x, k: row_of(x, k, 1)

    def step(i, carry):
        following, steps = carry
        k = CHUNK - 2 - i
        back = link_times(at(link, k).swapaxes(-1, -2), following[..., None])
        row = at(right, k)[..., None] - at(half, k) @ back
        here = (at(half, k).swapaxes(-1, -2) @ row)[..., 0]
        return here, with_row(steps, here, k, 1)

    steps = jnp.zeros((g * l, CHUNK, p), last.dtype).at[:, -1].set(flat(last))
    steps = jax.lax.fori_loop(0, CHUNK - 1, step, (flat(last), steps))[1]
    return steps.reshape(g, l, CHUNK, p).swapaxes(1, 2).reshape(g, CHUNK, l * p)
