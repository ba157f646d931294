"""Eliminates postures: a chain in time, cut into chunks that are eliminated together.

Inside a chunk of B frames the postures of all frames but the last are eliminated, frame
after frame, the same step in all chunks and people at once. Their Schur complement
couples the border of the chunk (`front.py`). The border columns of later roots are
structurally zero in the first frames, and left out there. Border columns are stored as
rows, contiguous in memory, which makes their products half as fast again. The
elimination is exact.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph import CHUNK
from bodyslam_jax.solver.blocks import Linearisation
from bodyslam_jax.solver.front import Pairs, Window
from bodyslam_jax.solver.triangular import half_of, row_of, with_row


class Postures(eqx.Module):
    """The factors of the first `e = B - 1` postures of each chunk, for
    back-substitution."""

    half: Float[Array, "*n e p p"]
    """`L^-1` of each pivot `L L^T`."""
    solved: tuple[Float[Array, "*n _b _e p"], ...]
    """`L^-1` times border columns, transposed; an entry for each of the `phases_of`."""
    link: Float[Array, "*n e p p"]
    """Coupling of the next frame (rows) with each eliminated one."""


def border_of(window: Window) -> tuple[str, ...]:
    """Returns the groups that the Schur complement of inner postures couples."""
    if window.cross:
        between = "old_roots", "inner", "roots", "old_cameras", "cameras"
    else:
        between = "inner", "roots"
    return "before", "common", *between


def phases_of(window: Window) -> tuple[tuple[int, int, int], ...]:
    """Returns, for each phase, its first frame, its end, and the number of columns at
    the end of the border, of later roots, that are structurally zero in it."""
    if window.cross:
        return ((0, CHUNK - 1, 0),)
    middle = CHUNK // 2
    return (0, middle, 6 * (CHUNK - middle)), (middle, CHUNK - 1, 0)


def posture_blocks(lin: Linearisation, damping: Float[Array, "h t p"]) -> tuple:
    """Returns the arguments of `eliminate_postures`; leading axes `h t`."""
    blocks = {k: v for k, v in lin.blocks.items() if k[0] == "pose"}
    return blocks, lin.gradient["pose"], damping


def eliminate_postures(
    window: Window, blocks: dict, gradient: Array, damping: Float[Array, "g B p"]
) -> tuple[Postures, Pairs]:
    """Eliminates all postures but the last of each of `g` chunks, at the same time.

    Returns their factors, and their Schur complement on pairs of the window's groups.
    """
    p, dtype = window.pose, damping.dtype
    eye = jnp.eye(p, dtype=dtype)
    none = jnp.zeros((*damping.shape[:2], p, p), dtype)
    own = blocks.get(("pose", "pose", 0), none) + damping[..., None] * eye
    link = blocks.get(("pose", "pose", 1), none)
    at = lambda x, k: row_of(x, k, 1)
    turned = lambda x: x.swapaxes(-1, -2)
    raw = lambda k: _rows(window, blocks, gradient, k)

    def eliminate(k, known):
        pivot, rows, halves, solved = known
        half = half_of(pivot)
        here = rows @ turned(half)
        forward = at(link, k + 1) @ turned(half)
        pivot = at(own, k + 1) - forward @ turned(forward)
        rows = raw(k + 1)[:, : rows.shape[1]] - here @ turned(forward)
        halves = with_row(halves, half, k, 1)
        return pivot, rows, halves, with_row(solved, here, k - start, 2)

    rows = raw(0).at[:, :p].set(turned(at(link, 0)))
    pivot, halves = own[:, 0], jnp.zeros((len(own), CHUNK - 1, p, p), dtype)
    solved = []
    for start, stop, late in phases_of(window):
        more = raw(start)
        count = more.shape[1] - late
        rows = jnp.concatenate([rows[:, :count], more[:, rows.shape[1] : count]], 1)
        found = jnp.zeros((*rows.shape[:2], stop - start, p), dtype)
        carry = pivot, rows, halves, found
        pivot, rows, halves, found = jax.lax.fori_loop(start, stop, eliminate, carry)
        solved.append(found)
    postures = Postures(halves, tuple(solved), link[:, 1:])
    return postures, _left(window, pivot, rows, -_squares(solved))


def _squares(parts: list[Float[Array, "g _b _e p"]]) -> Float[Array, "g b b"]:
    """Returns the sum of all parts' products of rows with each other; rows that the
    first parts lack at the end count as 0."""
    size = parts[-1].shape[1]
    total = jnp.zeros((), parts[-1].dtype)
    for part in parts:
        wide = part.reshape(*part.shape[:2], -1)
        more = (0, size - wide.shape[1])
        total = total + jnp.pad(wide @ wide.swapaxes(-1, -2), ((0, 0), more, more))
    return total


def _left(
    window: Window,
    pivot: Float[Array, "g p p"],
    rows: Float[Array, "g b p"],
    update: Float[Array, "g b b"],
) -> Pairs:
    """Returns the Schur complement on pairs of groups, from the pivot and the rows of
    the last posture and from the `update` of the border by the others."""
    slices = window.slices(border_of(window))
    left = {("sep", "sep"): pivot}
    names = list(slices)
    for i, name in enumerate(names):
        left[name, "sep"] = rows[:, slices[name]]
        for other in names[: i + 1]:
            left[name, other] = update[:, slices[name], slices[other]]
    return left


def _rows(window: Window, blocks: dict, gradient: Array, k) -> Float[Array, "g b p"]:
    """Returns the blocks of frame k of each chunk against the border, with zeros for
    the last posture of the chunk before, which only frame 0 couples with."""
    at = lambda x: row_of(x, k, 1)
    dtype, g, p = gradient.dtype, len(gradient), window.pose
    reach = window.reach if window.cross else 0
    common = blocks.get(("pose", "globals", 0))
    if common is None:
        common = jnp.zeros((g, window.own_globals, p), dtype)
    else:
        common = at(common).swapaxes(-1, -2)
    parts = [jnp.zeros((g, p, p), dtype), common, -at(gradient)[:, None]]
    for name in ("root", "camera") if window.cross else ("root",):
        total = jnp.zeros((g, 6 * (CHUNK + reach), p), dtype)
        for lag in (-1, 0, 1):
            block = blocks.get(("pose", name, lag))
            if block is not None:
                # The block couples frame k with frame k - lag.
                place = jnp.eye(CHUNK, CHUNK + reach, k=reach - lag, dtype=dtype)
                place = row_of(place, k)
                wide = at(block).swapaxes(-1, -2)[:, None] * place[:, None, None]
                total = total + wide.reshape(total.shape)
        parts.append(total)
    return jnp.concatenate(parts, axis=1)


def substitute_postures(
    postures: Postures,
    border_step: Float[Array, "g b"],
    last: Float[Array, "g p"],
) -> Float[Array, "g B p"]:
    """Returns the steps of all postures of chunks, given those of the border (-1 for
    the right-hand side) and of their last postures."""
    half, link = postures.half, postures.link
    right = []
    for solved in postures.solved:
        g, rows, frames, p = solved.shape
        here = -(border_step[:, None, :rows] @ solved.reshape(g, rows, -1))
        right.append(here.reshape(g, frames, p))
    right = jnp.concatenate(right, axis=1)
    at = lambda x, k: row_of(x, k, 1)

    def step(i, carry):
        following, steps = carry
        k = CHUNK - 2 - i
        back = at(link, k).swapaxes(-1, -2) @ following[..., None]
        row = at(right, k)[..., None] - at(half, k) @ back
        here = (at(half, k).swapaxes(-1, -2) @ row)[..., 0]
        return here, with_row(steps, here, k, 1)

    steps = jnp.zeros((len(last), CHUNK, last.shape[1]), last.dtype).at[:, -1].set(last)
    return jax.lax.fori_loop(0, CHUNK - 1, step, (last, steps))[1]
