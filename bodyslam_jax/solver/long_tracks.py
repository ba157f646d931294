"""Landmarks that are eliminated last, with the globals.

A few landmarks that are seen much longer than all others would widen the band of
cameras for all (`graph/ordering.py`). Their blocks become part of the arrow. They
form one bucket; their coordinates stand group by group, as in its tables: x of all,
then y, then z.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.graph import Problem
from bodyslam_jax.solver.blocks import CAMERAS, LandmarkBlocks, Sizes


class Lasting(eqx.Module):
    """Blocks of the `k` coordinates of lasting landmarks in the arrow."""

    cameras: Float[Array, "n c k"]
    """Coupling with the cameras of each chunk, as they stand."""
    intrinsics: Float[Array, "i k"]
    own: Float[Array, "k k"]
    """Their own block, damped."""
    rhs: Float[Array, " k"]


def lasting_blocks(
    problem: Problem,
    tables: tuple[LandmarkBlocks, ...],
    damping: tuple[Array, ...],
    sizes: Sizes,
) -> Lasting | None:
    """Returns the blocks of lasting landmarks; `None` where there are none."""
    for bucket, table, damp in zip(
        problem.layout.buckets, tables, damping, strict=True
    ):
        if bucket.lasting:
            break
    else:
        return None
    n, _, g = table.gradient.shape
    cameras = jnp.zeros((sizes.chunks, CAMERAS, 3 * n * g), sizes.dtype)
    cross = table.cross.reshape(n, bucket.width, CAMERAS, 3 * g)
    for i in range(n):
        chunk = bucket.first_chunk[i]
        at = (chunk, jnp.zeros_like(chunk), jnp.full_like(chunk, 3 * i * g))
        cameras = jax.lax.dynamic_update_slice(cameras, cross[i], at)
    own = table.own + damp[:, :, None] * jnp.eye(3, dtype=damp.dtype)[..., None]
    groups, landmarks = jnp.eye(n, dtype=own.dtype), jnp.eye(g, dtype=own.dtype)
    own = jnp.einsum("nabg,nm,gh->nagmbh", own, groups, landmarks)
    return Lasting(
        cameras=cameras,
        intrinsics=jnp.moveaxis(table.cross_intrinsics, 1, 0).reshape(-1, 3 * n * g),
        own=own.reshape(3 * n * g, -1).astype(sizes.dtype),
        rhs=-table.gradient.reshape(-1).astype(sizes.dtype),
    )


def move_lasting(
    problem: Problem, steps: Float[Array, " k"], out: Float[Array, "l 3"]
) -> Float[Array, "l 3"]:
    """Returns `out`, the steps of all landmarks, with those of lasting ones set."""
    for bucket in problem.layout.buckets:
        if bucket.lasting:
            n, g = bucket.landmark.shape
            moved = jnp.moveaxis(steps.reshape(n, 3, g), 1, 2)
            out = out.at[bucket.landmark].set(moved, mode="drop")
    return out


def lasting_spread(
    shape: tuple[int, int], sizes: Sizes, arrow: Float[Array, "a a"]
) -> tuple[Float[Array, "n g 3 3"], Float[Array, "n g 3"], Float[Array, " n"]]:
    """Extracts from the covariance of the arrow that of each of the bucket's landmarks,
    its covariance with the scale, and the variance of the scale."""
    n, g = shape
    start = sizes.globals
    each = jnp.arange(n * g).reshape(n, g)
    whole = arrow[start:, start:].reshape(n, 3, g, n, 3, g)
    whole = jnp.moveaxis(whole, (1, 4), (4, 5)).reshape(n * g, n * g, 3, 3)
    with_scale = jnp.moveaxis(arrow[0, start:].reshape(n, 3, g), 1, 2)
    return whole[each, each], with_scale, jnp.full(n, arrow[0, 0])
