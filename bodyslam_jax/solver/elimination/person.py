"""Eliminates the inner variables of a person in a chunk: all but the last posture and
the last roots.

Chunks are eliminated a group at a time, so that their blocks stay in the processor's
cache: first the postures (`elimination/pose_chain.py`), then the roots all at once. The
Schur complement couples the last posture and roots of a chunk with those of the chunk
before, with the cameras of both, and with the globals.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph import CHUNK
from bodyslam_jax.solver.blocks import Linearisation, Sizes, shifted
from bodyslam_jax.solver.elimination.pose_chain import (
    Postures,
    border_of,
    eliminate_postures,
    posture_blocks,
    substitute_postures,
)
from bodyslam_jax.solver.front import (
    KEPT_GROUPS,
    Pairs,
    Window,
    add_pairs,
    matrix_of,
    spread,
)
from bodyslam_jax.solver.triangular import half_of

MAX_GROUP_CHUNKS = 16
"""Maximum number of chunks that are eliminated together."""


class RootFactor(eqx.Module):
    """The factor of inner roots: `L^-1` of their pivot, and `L^-1` times their coupling
    with the kept groups, transposed; its last row is the right-hand side's."""

    half: Float[Array, "*n m m"]
    side: Float[Array, "*n k m"]


class People(eqx.Module):
    """The Schur complement of the elimination, and what back-substitution needs."""

    postures: Postures | None
    """Factors of inner postures; leading axes `h n`."""
    roots: RootFactor
    kept: Float[Array, "*n k k"]
    """Schur complement on the groups `KEPT_GROUPS` of each chunk's window."""


def eliminate_people(
    lin: Linearisation, sizes: Sizes, window: Window, damping: dict[str, Array]
) -> People:
    """Eliminates inner postures and roots of all people, damped."""
    h, n = sizes.people, sizes.chunks
    terms = _terms(lin, sizes, window, damping["root"])
    chain = posture_blocks(lin, damping["pose"]) if window.pose else None
    together = group_size(h * n)
    cut = lambda x: x.reshape(h * n // together, together, *x.shape[2:])
    of_chunks = lambda x: cut(x.reshape(h, n, CHUNK, *x.shape[2:]))
    given = jax.tree.map(cut, terms), jax.tree.map(of_chunks, chain)

    def group(given):
        pairs, chain = given
        postures = None
        if chain is not None:
            postures, left = eliminate_postures(window, *chain)
            pairs = add_pairs(left, pairs)
        half = half_of(matrix_of(window, pairs, ("inner",), ("inner",)))
        side = matrix_of(window, pairs, KEPT_GROUPS, ("inner",)) @ half.swapaxes(-1, -2)
        kept = matrix_of(
            window, pairs, KEPT_GROUPS, KEPT_GROUPS
        ) - side @ side.swapaxes(-1, -2)
        return People(postures, RootFactor(half, side), kept)

    found = jax.lax.map(group, given)
    return jax.tree.map(lambda x: x.reshape(h, n, *x.shape[2:]), found)


def group_size(count: int) -> int:
    """Returns how many of `count` chunks are eliminated together, a divisor of it:
    enough that small operations do not wait for each other, few enough that their
    blocks stay in the processor's cache. On a GPU all of them are."""
    if jax.default_backend() != "cpu":
        return count
    return max(size for size in range(1, MAX_GROUP_CHUNKS + 1) if count % size == 0)


def _terms(
    lin: Linearisation, sizes: Sizes, window: Window, damping: Float[Array, "h t 6"]
) -> Pairs:
    """Returns the blocks of roots with roots, cameras and globals in each chunk's
    window. A term belongs to the chunk of its latest frame."""
    h, n, reach = sizes.people, sizes.chunks, window.reach
    cut = lambda x: x.reshape(h, n, CHUNK, *x.shape[2:])
    turned = lambda x: x.swapaxes(-1, -2)
    length = 6 * (CHUNK + reach)
    roots = spread(
        cut(damping[..., None] * jnp.eye(6, dtype=damping.dtype)), 0, 0, reach
    )
    cameras = jnp.zeros((h, n, length, length), damping.dtype)
    for (first, other, lag), block in lin.blocks.items():
        if (first, other) == ("root", "root"):
            wide = spread(cut(block), 0, lag, reach)
            roots = roots + (wide + turned(wide) if lag else wide)
        elif (first, other) == ("root", "camera"):
            later = cut(shifted(block, max(-lag, 0), 1))
            cameras = cameras + spread(later, max(-lag, 0), max(lag, 0), reach)
    old, start = 6 * reach, 6 * CHUNK
    parts = {
        "old_roots": slice(0, old),
        "inner": slice(old, start),
        "roots": slice(start, length),
    }
    pairs = {
        ("inner", "old_roots"): roots[..., parts["inner"], parts["old_roots"]],
        ("roots", "old_roots"): roots[..., parts["roots"], parts["old_roots"]],
        ("inner", "inner"): roots[..., parts["inner"], parts["inner"]],
        ("roots", "inner"): roots[..., parts["roots"], parts["inner"]],
        ("roots", "roots"): roots[..., parts["roots"], parts["roots"]],
    }
    for name, part in parts.items():
        pairs[name, "cameras"] = cameras[..., part, old:]
        if name != "old_roots":
            pairs[name, "old_cameras"] = cameras[..., part, :old]
    common = jnp.zeros((h, n, start, window.own_globals), damping.dtype)
    if ("root", "globals", 0) in lin.blocks:
        common = lin.blocks["root", "globals", 0].reshape(common.shape)
    right = jnp.zeros((h, n, start, 1), damping.dtype)
    if "root" in lin.gradient:
        right = -lin.gradient["root"].reshape(right.shape)
    common = jnp.concatenate([common, right], axis=-1)
    pairs["inner", "common"] = common[..., : start - old, :]
    pairs["roots", "common"] = common[..., start - old :, :]
    # The last posture of the chunk before, with the first root and camera of this one.
    for other, name in (("root", "inner"), ("camera", "cameras")):
        block = lin.blocks.get(("pose", other, -1))
        if block is not None:
            block = shifted(cut(block)[:, :, -1], 1, 1)
            more = window.widths[name] - 6
            pairs["before", name] = jnp.pad(block, ((0, 0),) * 3 + ((0, more),))
    return pairs


def substitute_people(
    people: People,
    sizes: Sizes,
    window: Window,
    steps: Float[Array, "h n p"],
    cameras: Float[Array, "t 6"],
    own_globals: Float[Array, "h g"],
) -> tuple[Float[Array, "h t 6"], Float[Array, "h t c"] | None]:
    """Returns the steps of all roots and postures, given those of each chunk's last
    posture and roots, of the cameras, and of each person's globals."""
    h, n = sizes.people, sizes.chunks
    last = 6 * window.reach
    of_chunks = jnp.broadcast_to(cameras.reshape(1, n, -1), (h, n, 6 * CHUNK))
    old_cameras = shifted(of_chunks, 1, 1)[..., 6 * CHUNK - last :]
    common = jnp.broadcast_to(own_globals[:, None], (h, n, own_globals.shape[-1]))
    before = shifted(steps, 1, 1)
    known = [before, old_cameras, steps, of_chunks, common]
    right = people.roots.side[..., -1, :] - jnp.einsum(
        "hnkm,hnk->hnm", people.roots.side[..., :-1, :], jnp.concatenate(known, axis=-1)
    )
    inner = jnp.einsum("hnmi,hnm->hni", people.roots.half, right)
    pose = window.pose
    roots = jnp.concatenate([inner, steps[..., pose:]], axis=-1)
    if people.postures is None:
        return roots.reshape(h, -1, 6), None
    values = {
        "before": before[..., :pose],
        "old_roots": before[..., pose:],
        "inner": inner,
        "roots": steps[..., pose:],
        "old_cameras": old_cameras,
        "cameras": of_chunks,
        # A factor of -1 for the right-hand side saves copying parts of the tables.
        "common": jnp.concatenate([common, -jnp.ones_like(common[..., :1])], axis=-1),
    }
    border = jnp.concatenate([values[name] for name in border_of(window)], axis=-1)
    together = group_size(h * n)
    cut = lambda x: x.reshape(h * n // together, together, *x.shape[2:])
    given = people.postures, border, steps[..., :pose]
    group = lambda given: substitute_postures(*given)
    poses = jax.lax.map(group, jax.tree.map(cut, given))
    return roots.reshape(h, -1, 6), poses.reshape(h, -1, pose)
