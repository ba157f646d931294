"""The reduced system of chunks: people, cameras, and an arrow of globals.

After landmarks, inner postures and inner roots are eliminated, a chunk keeps its
cameras and, for each person, the last posture and the last roots. People couple with
the next chunk only, cameras over the band of the tracks, and all of them with the
globals. Memory grows linearly with the number of frames.

Chunks stand in the order of time, or in that of `Layout.order`, where the next in time
is up to `reach` places away, either way.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bodyslam_jax.graph import CHUNK
from bodyslam_jax.solver.blocks import (
    CAMERAS,
    Linearisation,
    PriorBlocks,
    Sizes,
    own_to_global,
    shifted,
)
from bodyslam_jax.solver.elimination.schur import ReducedCameras
from bodyslam_jax.solver.front import KEPT_GROUPS, Window, spread


class Chunks(eqx.Module):
    """The system `[pivot, coupling^T]` of each of `n` chunks; right-hand side included.

    A pivot is `[people, cameras]` of one chunk, `q` wide. Its coupling has the rows
    `[people of the next chunks, cameras of the next chunks, arrow, rhs]`: as many
    chunks as the reach is, and as the band is wide. The arrow is of globals and lasting
    landmarks.
    """

    pivot: Float[Array, "n q q"]
    coupling: Float[Array, "n r q"]
    corner: Float[Array, "a1 a1"]
    """Block of the arrow, with the right-hand side."""


def assemble(
    lin: Linearisation,
    sizes: Sizes,
    reduced: ReducedCameras,
    kept: Float[Array, "h n k k"] | None,
    window: Window,
    damping: dict[str, Array],
    order: Int[Array, " n"] | None,
) -> Chunks:
    """Assembles the blocks of the kept variables; all but `reduced` are given in the
    order of time."""
    n, g = sizes.chunks, sizes.arrow
    dtype = reduced.band.dtype
    zeros = lambda *shape: jnp.zeros((n, *shape), dtype)
    own, following = _cameras(lin, sizes, damping["camera"])
    tail = _camera_tail(lin, sizes, dtype)
    corner = _corner(lin, sizes, reduced, damping["globals"])
    people, across = [], []
    blocks = () if kept is None else kept
    for person in range(sizes.people):
        part = _parts(blocks[person], window)
        people.append(part)
        across.append(part["own", "cameras"])
        own = own + part["cameras", "cameras"]
        following = following + part["next cameras", "cameras"]
        index = jnp.append(own_to_global(sizes, person), g)
        tail = tail.at[:, index].add(part["common", "cameras"])
        corner = corner.at[index[:, None], index].add(part["common", "common"])
    corner = corner.at[-1].set(0.0)

    lines, below, tails = [], [], []
    width = window.person
    for i, part in enumerate(people):
        beside = lambda block, i=i: [
            block if j == i else zeros(width, width) for j in range(len(people))
        ]
        lines.append([*beside(part["own", "own"]), part["own", "cameras"]])
        below.append([*beside(part["next", "own"]), part["next", "cameras"]])
        index = jnp.append(own_to_global(sizes, i), g)
        tails.append(zeros(g + 1, width).at[:, index].set(part["common", "own"]))
    below.append([*(part["next cameras", "own"] for part in people), following])
    after = _stack(below)
    placed = lambda x: x if order is None else x[order]
    across = [placed(x) for x in across]
    lines = [[placed(x) for x in line] for line in lines]
    own = placed(own) + reduced.band[..., :CAMERAS]
    lines.append([*(_transposed(x) for x in across), own])
    tails = [placed(x) for x in tails]
    tail = placed(tail) + _reduced_tail(sizes, reduced)
    band = _transposed(reduced.band[..., CAMERAS:])
    head = width * len(people)
    band = jnp.concatenate([zeros(band.shape[1], head), band], axis=-1)
    if order is None:
        coupling = [
            after[:, :head],
            after[:, head:] + band[:, :CAMERAS],
            band[:, CAMERAS:],
        ]
    else:
        band = jnp.pad(band, ((0, 0), (sizes.reach * head, 0), (0, 0)))
        coupling = [band + _in_place(after, order, sizes.reach, band.shape[1])]
    coupling = jnp.concatenate([*coupling, _stack([[*tails, tail]])], axis=1)
    return Chunks(_stack(lines), coupling, corner)


def add_marginal_prior(
    chunks: Chunks, prior: PriorBlocks, sizes: Sizes, window: Window
) -> Chunks:
    """Adds the blocks of a marginal prior; chunks are in the order of time."""
    matrix, pivot, coupling = prior.matrix, chunks.pivot, chunks.coupling
    own, head = sizes.people * prior.person, sizes.people * window.person
    count = (len(matrix) - own - sizes.globals) // CAMERAS
    person = np.arange(prior.person)
    # The prior has the last roots only, of a window that may have more.
    roots = person >= prior.person - 6 * prior.reach
    person = person + roots * 6 * (window.reach - prior.reach)
    people = np.arange(sizes.people)[:, None] * window.person + person
    cameras = head + np.arange(CAMERAS)
    tail = coupling.shape[1] - sizes.arrow - 1 + np.arange(sizes.globals)
    of_globals = np.arange(len(matrix) - sizes.globals, len(matrix))
    for i in range(count):
        start = own + i * CAMERAS
        here = np.arange(start, start + CAMERAS)
        place = cameras
        if i == 0:
            here = np.concatenate([np.arange(own), here])
            place = np.concatenate([people.reshape(-1), cameras])
        later = np.arange(start + CAMERAS, own + count * CAMERAS)
        rows = np.concatenate([sizes.reach * head + later - later[:1].sum(), tail])
        below = np.concatenate([later, of_globals])
        pivot = pivot.at[i, place[:, None], place].add(matrix[here[:, None], here])
        coupling = coupling.at[i, rows[:, None], place].add(
            matrix[below[:, None], here]
        )
    return Chunks(pivot, coupling, chunks.corner)


def _in_place(
    after: Float[Array, "n q q"], order: Int[Array, " n"], reach: int, count: int
) -> Float[Array, "n c q"]:
    """Places the blocks of the next chunk in time (rows) against each chunk, in the
    order in which chunks stand."""
    n, q, _ = after.shape
    head = q - CAMERAS
    place = jnp.argsort(order)
    follower = jnp.roll(place, -1)
    turned = (follower < place)[:, None, None]
    block = jnp.where(turned, _transposed(after), after)
    apart = jnp.abs(follower - place)[:, None]
    first = jnp.minimum(place, follower)
    # The last has no follower. The last of the video does not couple with padding,
    # which may stand far from it.
    first = jnp.where((jnp.arange(n) < n - 1) & (apart[:, 0] <= reach), first, n)
    people = (apart - 1) * head + jnp.arange(head)
    cameras = reach * head + (apart - 1) * CAMERAS + jnp.arange(CAMERAS)
    row = jnp.concatenate([people, cameras], axis=1)
    out = jnp.zeros((n, count, q), after.dtype)
    return out.at[first[:, None], row].add(block, mode="drop")


def _stack(lines: list[list[Array]]) -> Array:
    return jnp.concatenate([jnp.concatenate(x, axis=-1) for x in lines], axis=-2)


def _transposed(x):
    return x.swapaxes(-1, -2)


def _parts(kept: Float[Array, "n k k"], window: Window) -> dict[tuple[str, str], Array]:
    """Returns the blocks of one person, rows by columns: its kept variables of the
    chunk (`own`) and of the `next` one, cameras, and globals with the right-hand side
    (`common`)."""
    at = window.slices(KEPT_GROUPS)
    old = slice(at["before"].start, at["old_roots"].stop)
    own = slice(at["sep"].start, at["roots"].stop)
    old_cameras, cameras, common = (at[k] for k in ("old_cameras", "cameras", "common"))
    later = shifted(kept, -1, 0)
    first = CAMERAS - 6 * window.reach
    wide = lambda x: jnp.pad(x, ((0, 0), (0, 0), (first, 0)))
    last = jnp.pad(later[:, old_cameras, old_cameras], ((0, 0),) + ((first, 0),) * 2)
    return {
        ("own", "own"): kept[:, own, own] + later[:, old, old],
        ("own", "cameras"): kept[:, own, cameras] + wide(later[:, old, old_cameras]),
        ("cameras", "cameras"): kept[:, cameras, cameras] + last,
        ("next", "own"): later[:, own, old],
        ("next", "cameras"): wide(later[:, own, old_cameras]),
        ("next cameras", "own"): later[:, cameras, old],
        ("next cameras", "cameras"): wide(later[:, cameras, old_cameras]),
        ("common", "own"): kept[:, common, own] + later[:, common, old],
        ("common", "cameras"): kept[:, common, cameras]
        + wide(later[:, common, old_cameras]),
        ("common", "common"): jnp.sum(kept[:, common, common], axis=0),
    }


def _cameras(lin, sizes, damping):
    """Returns the blocks of each chunk's cameras with themselves and with those of the
    next chunk (rows), from factors other than landmarks."""
    blocks = {k[2]: v for k, v in lin.blocks.items() if k[:2] == ("alone", "alone")}
    for (first, other, lag), block in lin.blocks.items():
        if (first, other) == ("camera", "camera"):
            total = jnp.sum(block, axis=0)
            blocks[lag] = blocks[lag] + total if lag in blocks else total
    eye = damping[..., None] * jnp.eye(6, dtype=damping.dtype)
    blocks[0] = blocks[0] + eye if 0 in blocks else eye
    n, reach = sizes.chunks, max(blocks)
    cut = lambda x: x.reshape(n, CHUNK, 6, 6)
    whole = spread(cut(blocks.pop(0)), 0, 0, reach)
    for lag, block in blocks.items():
        wide = spread(cut(block), 0, lag, reach)
        whole = whole + wide + _transposed(wide)
    start = 6 * reach
    following = shifted(whole[:, start:, :start], -1, 0)
    following = jnp.pad(following, ((0, 0), (0, 0), (CAMERAS - start, 0)))
    return whole[:, start:, start:], following


def _reduced_tail(sizes, reduced):
    """Returns the Schur complement of landmarks on arrow (rows) and cameras."""
    n, g, i = sizes.chunks, sizes.arrow, sizes.intrinsics
    tail = jnp.zeros((n, g + 1, CAMERAS), reduced.band.dtype)
    if i:
        tail = tail.at[:, 1 : 1 + i].set(_transposed(reduced.with_intrinsics))
    if reduced.lasting is not None:
        lasting = _transposed(reduced.lasting.cameras)
        tail = tail.at[:, sizes.globals : g].set(lasting)
    return tail.at[:, -1].set(reduced.rhs)


def _camera_tail(lin, sizes, dtype):
    """Returns arrow and right-hand side (rows) against each chunk's cameras."""
    n, g = sizes.chunks, sizes.arrow
    tail = jnp.zeros((n, g + 1, CAMERAS), dtype)
    alone = lin.blocks.get(("alone", "globals", 0))
    if alone is not None:
        index = own_to_global(sizes, None)
        wide = _transposed(alone.reshape(n, CAMERAS, -1))
        tail = tail.at[:, index].add(wide[:, : len(index)])
    common = lin.blocks.get(("camera", "globals", 0))
    if common is not None:
        for person in range(sizes.people):
            wide = _transposed(common[person].reshape(n, CAMERAS, -1))
            tail = tail.at[:, own_to_global(sizes, person)].add(wide)
    right = jnp.zeros((n, CAMERAS), dtype)
    for name in ("camera", "camera_alone"):
        if name in lin.gradient:
            gradient = lin.gradient[name].reshape(-1, n, CAMERAS)
            right = right - jnp.sum(gradient, axis=0)
    return tail.at[:, -1].add(right)


def _corner(lin, sizes, reduced, damping):
    g, i, arrow = sizes.globals, sizes.intrinsics, sizes.arrow
    corner = jnp.zeros((arrow + 1, arrow + 1), reduced.band.dtype)
    corner = corner.at[:g, :g].set(lin.globals)
    corner = corner.at[:g, -1].add(-lin.globals_gradient)
    corner = corner.at[jnp.arange(g), jnp.arange(g)].add(damping)
    if i:
        corner = corner.at[1 : 1 + i, 1 : 1 + i].add(reduced.intrinsics)
        corner = corner.at[1 : 1 + i, -1].add(reduced.intrinsics_rhs)
    if reduced.lasting is not None:
        last, lasting = slice(g, arrow), reduced.lasting
        corner = corner.at[last, last].set(lasting.own)
        corner = corner.at[last, -1].set(lasting.rhs)
        if i:
            corner = corner.at[1 : 1 + i, last].set(lasting.intrinsics)
            corner = corner.at[last, 1 : 1 + i].set(lasting.intrinsics.T)
    return corner
