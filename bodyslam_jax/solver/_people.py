"""Eliminates postures: a chain in time, cut into chunks that are eliminated together.

Inside a chunk of B frames the 69 joint coordinates of all frames but the last go, frame
after frame, the same step in all chunks and people at once. What they leave couples the
`border` of the chunk: the last posture before it, its own last posture (the separators),
its roots, and the person's globals. Exact; about 7 MFLOP a frame.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph import CHUNK
from bodyslam_jax.solver._linearise import Linearisation, Sizes

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

    inverse: Float[Array, "h n e 69 69"]
    """Inverse of each pivot, `e = B - 1` eliminated frames."""
    solved: Float[Array, "h n e 69 b"]
    """Pivot inverse times border columns."""
    link: Float[Array, "h n e 69 69"]
    """Coupling of the next frame (rows) with each eliminated one."""
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
    """`h t 69 69`: postures with themselves, and with those of the frame before."""
    h, t = lin.gradient["pose"].shape[:2]
    dtype = lin.gradient["pose"].dtype
    result = []
    for d in range(2):
        block = lin.blocks.get(
            ("pose", "pose", d), jnp.zeros((h, t, POSE, POSE), dtype)
        )
        small = lin.blocks.get(("joint", "joint", d))
        if small is not None:
            # 23 blocks of 3 x 3 down the diagonal, laid out by a product with the
            # identity: scatters of so many small blocks are slow.
            eye = jnp.eye(23, dtype=dtype)
            full = small[:, :, :, :, None, :] * eye[:, None, :, None]
            block = block + full.reshape(h, t, POSE, POSE)
        result.append(block)
    return result[0], result[1]


def pose_diagonal(lin: Linearisation) -> Float[Array, "h t 69"]:
    total = 0.0
    for kind in ("pose", "joint"):
        block = lin.blocks.get((kind, kind, 0))
        if block is not None:
            diagonal = jnp.diagonal(block, axis1=-2, axis2=-1)
            total = total + diagonal.reshape(*diagonal.shape[:2], POSE)
    return total  # type: ignore[return-value]


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
    raw = [_border_columns(lin, border, link, k, cut) for k in range(CHUNK)]
    pivot, columns = own[:, :, 0], raw[0]
    inverses, solved, kept = [], [], []
    for k in range(CHUNK - 1):
        inverse = invert(pivot)
        product = inverse @ columns
        inverses.append(inverse)
        solved.append(product)
        kept.append(columns)
        forward = link[:, :, k + 1]
        pivot = own[:, :, k + 1] - forward @ inverse @ forward.swapaxes(-1, -2)
        columns = raw[k + 1] - forward @ product
    stack = lambda arrays: jnp.stack(arrays, axis=2)
    tall = lambda x: stack(x).reshape(h, n, (CHUNK - 1) * POSE, border.rhs + 1)
    update = jnp.einsum("hnka,hnkb->hnab", tall(kept), tall(solved))
    return Postures(
        stack(inverses), stack(solved), link[:, :, 1:], pivot, columns, -update
    )


def invert(matrix: Float[Array, "*b n n"]) -> Float[Array, "*b n n"]:
    """Inverse of a positive definite matrix; NaN if it is not."""
    lower = jnp.linalg.cholesky(matrix, symmetrize_input=False)
    eye = jnp.broadcast_to(jnp.eye(matrix.shape[-1], dtype=matrix.dtype), matrix.shape)
    half = jax.scipy.linalg.solve_triangular(lower, eye, lower=True)
    return half.swapaxes(-1, -2) @ half


def _border_columns(lin, border, link, k, cut):
    """Columns of the k-th posture of each chunk against the chunk's border."""
    get = lambda name, other, d: lin.blocks.get((name, other, d))
    h, n = link.shape[:2]
    dtype = link.dtype
    none = lambda width: jnp.zeros((h, n, POSE, width), dtype)
    before = [link[:, :, 0] if k == 0 else none(POSE)]
    if border.cross:
        for name in ("root", "camera"):
            block = get("pose", name, 1)
            use = k == 0 and block is not None
            before.append(cut(block)[:, :, 0] if use else none(6))
    parts = before
    for name in ("root", "camera") if border.cross else ("root",):
        for i in range(CHUNK):
            block = get("pose", name, k - i) if abs(k - i) <= 1 else None
            parts.append(none(6) if block is None else cut(block)[:, :, k])
    common = get("pose", "globals", 0)
    parts.append(none(border.own_globals) if common is None else cut(common)[:, :, k])
    parts.append(-cut(lin.gradient["pose"])[:, :, k, :, None])
    return jnp.concatenate(parts, axis=-1)


def substitute_postures(
    postures: Postures,
    border_step: Float[Array, "h n b"],
    separator_step: Float[Array, "h n 69"],
) -> Float[Array, "h t 69"]:
    """Steps of all postures from those of the border (without the rhs column)."""
    following = separator_step
    steps = [separator_step]
    for k in range(CHUNK - 2, -1, -1):
        solved = postures.solved[:, :, k]
        step = solved[..., -1]
        step = step - jnp.einsum("hnab,hnb->hna", solved[..., :-1], border_step)
        back = jnp.einsum("hnba,hnb->hna", postures.link[:, :, k], following)
        step = step - jnp.einsum("hnab,hnb->hna", postures.inverse[:, :, k], back)
        following = step
        steps.append(step)
    h, n = separator_step.shape[:2]
    return jnp.stack(steps[::-1], axis=2).reshape(h, n * CHUNK, POSE)
