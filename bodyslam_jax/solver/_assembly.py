"""The reduced system of chunks: people, cameras, and an arrow of globals.

After landmarks and inner postures are gone, a chunk keeps for each person its last
posture and its roots, and its cameras. People couple with the next chunk only, cameras
over the band of the tracks, all with the globals. Memory grows linearly with frames.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph import CHUNK
from bodyslam_jax.solver._blocks import Linearisation, Sizes, own_to_global
from bodyslam_jax.solver._landmarks import CAMERAS, ReducedCameras
from bodyslam_jax.solver._people import POSE, Border, Postures

ROOTS = 6 * CHUNK


class Chunks(eqx.Module):
    """The system `[pivot, coupling]` of each of `n` chunks; right-hand side included.

    A pivot is `[people, cameras]` of one chunk, `q` wide. Its coupling has the columns
    `[people and cameras of the next chunk, cameras of the chunks after, globals, rhs]`.
    """

    pivot: Float[Array, "n q q"]
    coupling: Float[Array, "n q r"]
    corner: Float[Array, "g1 g1"]
    """Globals and right-hand side."""


def assemble(
    lin: Linearisation,
    sizes: Sizes,
    reduced: ReducedCameras,
    postures: Postures | None,
    border: Border,
    damping: dict[str, Array],
) -> Chunks:
    """Puts all blocks of the kept variables in place."""
    h, n, g = sizes.people, sizes.chunks, sizes.globals
    base = POSE if postures is not None else 0
    hb = base + ROOTS
    dtype = reduced.band.dtype
    zeros = lambda *shape: jnp.zeros(shape, dtype)
    people = {
        "own": zeros(h, n, hb, hb),
        "next": zeros(h, n, hb, hb),
        "cameras": zeros(h, n, hb, CAMERAS),
        "next_cameras": zeros(h, n, hb, CAMERAS),
        "before_cameras": zeros(h, n, CAMERAS, hb),
        "globals": zeros(h, n, hb, border.own_globals),
        "rhs": zeros(h, n, hb),
        "camera_own": zeros(h, n, CAMERAS, CAMERAS),
        "camera_next": zeros(h, n, CAMERAS, CAMERAS),
        "camera_globals": zeros(h, n, CAMERAS, border.own_globals),
        "camera_rhs": zeros(h, n, CAMERAS),
    }
    corner = zeros(g + 1, g + 1).at[:g, :g].set(lin.globals)
    corner = corner.at[:g, -1].add(-lin.globals_gradient)
    corner = corner.at[jnp.arange(g), jnp.arange(g)].add(damping["globals"])
    if h:
        people = _roots(people, lin, sizes, base, damping["root"])
    if postures is not None:
        people = _separators(people, lin, sizes, postures, border)
        part = border.globals.start
        for person in range(h):
            index = jnp.append(own_to_global(sizes, person), g)
            total = jnp.sum(postures.border[person, :, part:, part:], axis=0)
            corner = corner.at[index[:, None], index].add(total)
    i = sizes.intrinsics
    if i:
        corner = corner.at[1 : 1 + i, 1 : 1 + i].add(reduced.intrinsics)
        corner = corner.at[1 : 1 + i, -1].add(reduced.intrinsics_rhs)
    corner = corner.at[-1].set(0.0)
    return _join(lin, sizes, reduced, people, corner, damping)


def _place(blocks, frames_axis_cut):
    """Blocks `{lag: h t p q}`, row frame k against column frame k - lag, to chunks.

    Returns row chunk against the same, the one before and the next column chunk.
    """
    same = before = after = 0.0
    for lag, block in blocks.items():
        block = frames_axis_cut(block)
        h, n, _, p, q = block.shape

        def put(shift, block=block, lag=lag, h=h, n=n, p=p, q=q):
            # Products with shifted identities: scatters of small blocks are slow.
            where = jnp.eye(CHUNK, k=shift - lag, dtype=block.dtype)
            wide = block[:, :, :, :, None, :] * where[:, None, :, None]
            return wide.reshape(h, n, CHUNK * p, CHUNK * q)

        same = same + put(0)
        if lag > 0:
            before = before + put(CHUNK)
        if lag < 0:
            after = after + put(-CHUNK)
    return same, before, after


def _of(lin, first, second):
    return {k[2]: v for k, v in lin.blocks.items() if k[:2] == (first, second)}


def _transposed(x):
    return x.swapaxes(-1, -2)


def _to_previous(x, axis=1):
    """Entry of chunk c to chunk c - 1."""
    head, tail = jnp.split(x, [1], axis=axis)
    return jnp.concatenate([tail, jnp.zeros_like(head)], axis=axis)


def _symmetric_place(blocks, cut):
    """Chunks of a variable against itself: own, and against the next chunk."""
    own, before, _ = _place({0: blocks[0]}, cut)
    rest = {lag: block for lag, block in blocks.items() if lag}
    following = jnp.zeros_like(own)
    if rest:
        same, before, _ = _place(rest, cut)
        own = own + same + _transposed(same)
        following = _to_previous(_transposed(before + jnp.zeros_like(own)))
    return own, following


def _roots(people, lin, sizes, base, damping):
    h, n = sizes.people, sizes.chunks
    cut = lambda x: x.reshape(h, n, CHUNK, *x.shape[2:])
    new = dict(people)
    rows = slice(base, base + ROOTS)
    eye = damping[..., None] * jnp.eye(6, dtype=damping.dtype)
    blocks = _of(lin, "root", "root")
    blocks[0] = blocks[0] + eye if 0 in blocks else eye
    own, following = _symmetric_place(blocks, cut)
    new["own"] = new["own"].at[:, :, rows, rows].add(own)
    new["next"] = new["next"].at[:, :, rows, rows].add(following)
    same, before, after = _place(_of(lin, "root", "camera"), cut)
    # XLA would take seconds to add up zeros that it knows.
    if not isinstance(same, float):
        new["cameras"] = new["cameras"].at[:, :, rows].add(same)
    if not isinstance(after, float):
        new["next_cameras"] = new["next_cameras"].at[:, :, rows].add(after)
    if not isinstance(before, float):
        before = _to_previous(_transposed(before))
        new["before_cameras"] = new["before_cameras"].at[..., rows].add(before)
    common = lin.blocks.get(("root", "globals", 0))
    if common is not None:
        common = common.reshape(h, n, ROOTS, -1)
        new["globals"] = new["globals"].at[:, :, rows].add(common)
    if "root" in lin.gradient:
        rhs = -lin.gradient["root"].reshape(h, n, ROOTS)
        new["rhs"] = new["rhs"].at[:, :, rows].add(rhs)
    return new


def _separators(people, lin, sizes, postures, border):
    """Adds what elimination of postures left on separators, roots and the rest."""
    h, n = sizes.people, sizes.chunks
    sep, roots = slice(0, POSE), slice(POSE, POSE + ROOTS)
    last_root = slice(POSE + ROOTS - 6, POSE + ROOTS)
    last_camera = slice(CAMERAS - 6, CAMERAS)
    update, own_row = postures.border, postures.separator_border
    b_roots, b_cams, b_glob = border.roots, border.cameras, border.globals
    # The border's columns of the chunk before, and where they stand in that chunk.
    pose_before = slice(0, POSE)
    new = dict(people)

    def add(name, rows, columns, value):
        new[name] = new[name].at[:, :, rows, columns].add(value)

    full = slice(None)
    add("own", sep, sep, postures.separator)
    add("own", sep, roots, own_row[..., b_roots])
    add("own", roots, sep, _transposed(own_row[..., b_roots]))
    add("own", roots, roots, update[..., b_roots, b_roots])
    add("globals", sep, full, own_row[..., b_glob])
    add("globals", roots, full, update[..., b_roots, b_glob])
    new["rhs"] = new["rhs"].at[:, :, sep].add(own_row[..., border.rhs])
    new["rhs"] = new["rhs"].at[:, :, roots].add(update[..., b_roots, border.rhs])

    places = [(pose_before, "human", sep)]
    if border.cross:
        places.append((slice(POSE, POSE + 6), "human", last_root))
        places.append((slice(POSE + 6, POSE + 12), "camera", last_camera))
    for columns, kind, rows in places:
        to_sep = _to_previous(_transposed(own_row[..., columns]))
        to_roots = _to_previous(update[..., columns, b_roots])
        name = "next" if kind == "human" else "before_cameras"
        add(name, rows, sep, to_sep)
        add(name, rows, roots, to_roots)
        name = "globals" if kind == "human" else "camera_globals"
        add(name, rows, full, _to_previous(update[..., columns, b_glob]))
        name = "rhs" if kind == "human" else "camera_rhs"
        right = _to_previous(update[..., columns, border.rhs])
        new[name] = new[name].at[:, :, rows].add(right)
        if border.cross:
            name = "next_cameras" if kind == "human" else "camera_next"
            add(name, rows, full, _to_previous(update[..., columns, b_cams]))
        for other, other_kind, other_rows in places:
            block = _to_previous(update[..., columns, other])
            if kind == other_kind:
                add("own" if kind == "human" else "camera_own", rows, other_rows, block)
            elif kind == "human":
                add("cameras", rows, other_rows, block)
    if border.cross:
        add("cameras", sep, full, own_row[..., b_cams])
        add("cameras", roots, full, update[..., b_roots, b_cams])
        new["camera_own"] = new["camera_own"] + update[..., b_cams, b_cams]
        new["camera_globals"] = new["camera_globals"] + update[..., b_cams, b_glob]
        new["camera_rhs"] = new["camera_rhs"] + update[..., b_cams, border.rhs]
        for name, other, rows in (
            ("next", "root", slice(POSE, POSE + 6)),
            ("next_cameras", "camera", slice(0, 6)),
        ):
            block = lin.blocks.get(("pose", other, -1))
            if block is not None:
                block = block.reshape(h, n, CHUNK, POSE, 6)[:, :, -1]
                add(name, sep, rows, block)
    return new


def _join(lin, sizes, reduced, people, corner, damping):
    """All people and the cameras into pivots and couplings."""
    h, n, g, nb = sizes.people, sizes.chunks, sizes.globals, sizes.bandwidth
    hb = people["own"].shape[-1]
    head = h * hb
    q, r = head + CAMERAS, head + CAMERAS * (nb - 1) + g + 1
    dtype = reduced.band.dtype
    alone = _of(lin, "alone", "alone")
    for lag, block in _of(lin, "camera", "camera").items():
        total = jnp.sum(block, axis=0)
        alone[lag] = alone[lag] + total if lag in alone else total
    eye = damping["camera"][..., None] * jnp.eye(6, dtype=dtype)
    alone[0] = alone[0] + eye if 0 in alone else eye
    cut = lambda x: x.reshape(1, n, CHUNK, *x.shape[1:])
    own, following = _symmetric_place(alone, cut)
    own = (
        jnp.asarray(own)[0]
        + reduced.band[..., :CAMERAS]
        + jnp.sum(people["camera_own"], axis=0)
    )
    pivot = jnp.zeros((n, q, q), dtype).at[:, head:, head:].set(own)
    coupling = jnp.zeros((n, q, r), dtype)
    band = reduced.band[..., CAMERAS:]
    band = band.at[..., :CAMERAS].add(following[0] + jnp.sum(people["camera_next"], 0))
    coupling = coupling.at[:, head:, head : head + band.shape[-1]].set(band)
    rhs = reduced.rhs + jnp.sum(people["camera_rhs"], axis=0)
    for name in ("camera", "camera_alone"):
        if name in lin.gradient:
            gradient = lin.gradient[name].reshape(-1, n, CAMERAS)
            rhs = rhs - jnp.sum(gradient, axis=0)
    coupling = coupling.at[:, head:, -1].set(rhs)
    start = r - g - 1
    wide = jnp.zeros((n, CAMERAS, sizes.own_globals), dtype)
    common = lin.blocks.get(("alone", "globals", 0))
    if common is not None:
        wide = wide + common.reshape(n, CAMERAS, -1)
    i = sizes.intrinsics
    wide = wide.at[..., 1 : 1 + i].add(reduced.with_intrinsics)
    index = start + own_to_global(sizes, None)
    coupling = coupling.at[:, head:, index].add(wide[..., : len(index)])
    for person in range(h):
        a = slice(person * hb, (person + 1) * hb)
        part = {name: value[person] for name, value in people.items()}
        index = start + own_to_global(sizes, person)
        pivot = pivot.at[:, a, a].set(part["own"])
        pivot = pivot.at[:, a, head:].set(part["cameras"])
        pivot = pivot.at[:, head:, a].set(_transposed(part["cameras"]))
        coupling = coupling.at[:, a, a].set(part["next"])
        cams = slice(head, head + CAMERAS)
        coupling = coupling.at[:, a, cams].set(part["next_cameras"])
        coupling = coupling.at[:, head:, a].set(part["before_cameras"])
        coupling = coupling.at[:, a, index].set(part["globals"])
        coupling = coupling.at[:, a, -1].set(part["rhs"])
        more = part["camera_globals"]
        common = lin.blocks.get(("camera", "globals", 0))
        if common is not None:
            more = more + common[person].reshape(n, CAMERAS, -1)
        coupling = coupling.at[:, head:, index].add(more)
    return Chunks(pivot, coupling, corner)
