"""Joints in no limb, such as hands and wrists: no keypoint ties them to the rest.

What is known of such a joint is its rotation in each frame, and that errors last. So it
is a chain in time by itself, of 3 x 3 blocks, and takes no part in the elimination of
postures, whose products are the dearest of a step. Exact.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph import JOINTS
from bodyslam_jax.solver.blocks import Linearisation


def pick(x: Array, joints: tuple[int, ...], axis: int = -1, width: int = 1) -> Array:
    """Entries of some joints along an axis, `width` each: by slices, not gathers."""
    parts, start = [], 0
    for i, joint in enumerate(joints):
        if i + 1 == len(joints) or joints[i + 1] != joint + 1:
            first, last = width * joints[start], width * (joint + 1)
            parts.append(jax.lax.slice_in_dim(x, first, last, axis=axis))
            start = i + 1
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=axis)


def groups_of(joints: tuple[int, ...]) -> dict[str, tuple[int, ...]]:
    """`pose`, the joints of `Layout`, and `apart`, the others; none that is empty."""
    rest = tuple(joint for joint in JOINTS if joint not in joints)
    return {name: j for name, j in (("pose", joints), ("apart", rest)) if j}


def split_poses(
    poses: Float[Array, "h t 23 3"], joints: tuple[int, ...]
) -> dict[str, Float[Array, "h t _"]]:
    """What postures hold, by group."""
    lead = poses.shape[:2]
    flat = lambda joints: pick(poses, joints, 2).reshape(*lead, 3 * len(joints))
    return {name: flat(j) for name, j in groups_of(joints).items()}


def join_poses(
    parts: dict[str, Float[Array, "h t _"]],
    joints: tuple[int, ...],
    zero: Float[Array, "h t 23 3"],
) -> Float[Array, "h t 23 3"]:
    """The other way round; `zero` where a group is missing."""
    whole = split_poses(zero, joints) | parts
    joined = jnp.concatenate([whole[name] for name in groups_of(joints)], axis=-1)
    order = sum(groups_of(joints).values(), ())
    back = tuple(order.index(joint) for joint in JOINTS)
    return pick(joined, back, width=3).reshape(zero.shape)


def apart_diagonal(lin: Linearisation) -> Float[Array, "h t _"]:
    """Of `J^T J`."""
    gradient = lin.gradient["apart"]
    diagonal = jnp.diagonal(lin.blocks["apart", "apart", 0], axis1=-2, axis2=-1)
    return diagonal.reshape(gradient.shape).astype(gradient.dtype)


def solve_apart(
    lin: Linearisation, damping: Float[Array, "h t _"]
) -> Float[Array, "h t _"]:
    """Steps of these joints: a block-tridiagonal system for each, of 3 x 3 blocks, all
    joints at once."""
    gradient = lin.gradient["apart"]
    link, pivot, known = eliminate_apart(lin, damping)

    def backward(pull, frame):
        pivot, known, link = frame
        moved = _along(_inverse(pivot), known - pull)
        return _along(_turned(link), moved), moved

    given = pivot, known, link
    _, moved = jax.lax.scan(backward, jnp.zeros_like(known[0]), given, reverse=True)
    return jnp.moveaxis(moved, 0, 1).reshape(gradient.shape)


def eliminate_apart(
    lin: Linearisation, damping: Float[Array, "h t _"]
) -> tuple[
    Float[Array, "t h j 3 3"], Float[Array, "t h j 3 3"], Float[Array, "t h j 3"]
]:
    """Coupling of each frame with the one before; and what all before leave of each
    frame's own block and right-hand side."""
    gradient, own = lin.gradient["apart"], lin.blocks["apart", "apart", 0]
    shape = own.shape[:-1]
    eye = jnp.eye(3, dtype=own.dtype)
    own = own + damping.reshape(shape)[..., None] * eye
    # Of each frame with the one before.
    link = lin.blocks.get(("apart", "apart", 1), jnp.zeros_like(own))
    right = -gradient.reshape(shape)

    def forward(before, frame):
        inverse, known = before
        own, link, right = frame
        gain = _times(link, inverse)
        pivot = own - _times(gain, _turned(link))
        known = right - _along(gain, known)
        return (_inverse(pivot), known), (pivot, known)

    own, link, right = (jnp.moveaxis(x, 1, 0) for x in (own, link, right))
    none = jnp.zeros_like(own[0]), jnp.zeros_like(right[0])
    _, (pivot, known) = jax.lax.scan(forward, none, (own, link, right))
    return link, pivot, known


def _turned(x: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3 3"]:
    return x.swapaxes(-1, -2)


def _times(a: Float[Array, "*b 3 3"], b: Float[Array, "*b 3 3"]) -> Array:
    """A product of small matrices, fused: a call for each would take far longer."""
    term = lambda c: a[..., :, c, None] * b[..., c, None, :]
    return term(0) + term(1) + term(2)


def _along(a: Float[Array, "*b 3 3"], x: Float[Array, "*b 3"]) -> Array:
    term = lambda c: a[..., c] * x[..., c, None]
    return term(0) + term(1) + term(2)


def _inverse(a: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3 3"]:
    """Of symmetric matrices, by their cross products."""
    rows = [a[..., i, :] for i in range(3)]
    turned = [jnp.cross(rows[i - 2], rows[i - 1]) for i in range(3)]
    size = jnp.sum(rows[0] * turned[0], axis=-1)[..., None, None]
    return jnp.stack(turned, axis=-1) / size
