"""Eliminates landmarks: dense tables in, a block-banded camera matrix out.

With `V = L L^T` a landmark's own 3 x 3 block, `Y = W L^-T` stacks a group's cameras
(rows) against its landmarks (columns), and the group takes `Y Y^T` from the cameras:
one matrix product for all pairs of cameras that share landmarks.

A few landmarks that are seen much longer than all others would widen the band of
cameras for all (`graph/ordering.py`): they are eliminated last, with the globals. Their
blocks become part of the arrow. They form one bucket; their coordinates stand group by
group, as in its tables: x of all, then y, then z.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.graph import Problem
from bodyslam_jax.solver.blocks import CAMERAS, LandmarkBlocks, Sizes, cast
from bodyslam_jax.solver.linearise.landmark import frames_of
from bodyslam_jax.solver.triangular import scan_used


class Lasting(eqx.Module):
    """Blocks of the `k` coordinates of lasting landmarks in the arrow."""

    cameras: Float[Array, "n c k"]
    """Coupling with the cameras of each chunk, as they stand."""
    intrinsics: Float[Array, "i k"]
    own: Float[Array, "k k"]
    """Their own block, damped."""
    rhs: Float[Array, " k"]


class ReducedCameras(eqx.Module):
    """The (negative) updates of `n` chunks of cameras, as they stand, and of intrinsics
    by the elimination of landmarks."""

    band: Float[Array, "n c w"]
    """Row chunk against itself and the next ones, `c = 6 B`, `w = bandwidth * c`."""
    rhs: Float[Array, "n c"]
    with_intrinsics: Float[Array, "n c i"]
    intrinsics: Float[Array, "i i"]
    intrinsics_rhs: Float[Array, " i"]
    lasting: Lasting | None


Halves = list[list[Array]]
"""`L^-1` of each landmark's damped 3 x 3 block `L L^T`, as rows of arrays `n g`."""


def half_inverses(
    tables: tuple[LandmarkBlocks, ...], damping: tuple[Array, ...]
) -> tuple[Halves, ...]:
    """Returns the factors of all tables, which are computed at once."""
    if not tables:
        return ()
    own = jnp.concatenate([table.own for table in tables])
    whole = half_inverse(own, jnp.concatenate(damping))
    ends = np.cumsum([len(table.own) for table in tables])
    parts = [slice(e - len(t.own), e) for e, t in zip(ends, tables, strict=True)]
    return tuple([[x[part] for x in row] for row in whole] for part in parts)


def half_inverse(
    own: Float[Array, "n 3 3 g"], damping: Float[Array, "n 3 g"]
) -> Halves:
    """Returns the factor of each landmark's block `own`, damped."""
    v = lambda i, j: own[:, i, j] + (damping[:, i] if i == j else 0.0)
    # No pivot is below its damping but by rounding.
    root = lambda i, x: jnp.sqrt(jnp.maximum(x, damping[:, i]))
    l00 = root(0, v(0, 0))
    l10, l20 = v(1, 0) / l00, v(2, 0) / l00
    l11 = root(1, v(1, 1) - l10**2)
    l21 = (v(2, 1) - l20 * l10) / l11
    l22 = root(2, v(2, 2) - l20**2 - l21**2)
    i00, i11, i22 = 1 / l00, 1 / l11, 1 / l22
    i10 = -l10 * i00 * i11
    i21 = -l21 * i11 * i22
    i20 = -(l20 * i00 + l21 * i10) * i22
    return [[i00], [i10, i11], [i20, i21, i22]]


def eliminate_landmarks(
    problem: Problem,
    tables: tuple[LandmarkBlocks, ...],
    halves: tuple[Halves, ...],
    damping: tuple[Array, ...],
    sizes: Sizes,
) -> ReducedCameras:
    """Sums the (negative) updates of all groups of landmarks, to be added to the
    cameras' own blocks. Lasting landmarks are not eliminated here."""
    dtype = sizes.dtype
    n, count = sizes.chunks, sizes.intrinsics
    band = jnp.zeros((n, CAMERAS, sizes.bandwidth * CAMERAS), dtype)
    side = jnp.zeros((n, CAMERAS, count + 1), dtype)
    corner = jnp.zeros((count + 1, count + 1), dtype)
    for bucket, table, half in zip(problem.layout.buckets, tables, halves, strict=True):
        if bucket.lasting:
            continue
        half = cast(half, dtype)
        width = bucket.width

        slice_of = functools.partial(
            jax.lax.dynamic_slice, allow_negative_indices=False
        )
        with_slice = functools.partial(
            jax.lax.dynamic_update_slice, allow_negative_indices=False
        )

        def add(carry, group, width=width):
            band, side, corner = carry
            chunk, cross, extra, rows = group
            zero = jnp.zeros_like(chunk)
            mix = lambda w: jnp.stack(
                [sum(w[:, k] * r for k, r in enumerate(row)) for row in rows], axis=1
            )
            y = mix(cross.reshape(width * CAMERAS, 3, -1)).reshape(width * CAMERAS, -1)
            e = mix(extra).reshape(count + 1, -1)
            for i in range(width):
                rest = (width - i) * CAMERAS
                start = (chunk + i, zero, zero)
                here = slice(i * CAMERAS, (i + 1) * CAMERAS)
                strip = y[here] @ y[i * CAMERAS :].T
                known = slice_of(band, start, (1, CAMERAS, rest))
                band = with_slice(band, known - strip[None], start)
            start = (chunk, zero, zero)
            known = slice_of(side, start, (width, CAMERAS, count + 1))
            edge = (y @ e.T).reshape(width, CAMERAS, count + 1)
            side = with_slice(side, known - edge, start)
            return (band, side, corner - e @ e.T), None

        extra = jnp.concatenate(
            [table.cross_intrinsics, -table.gradient[:, None].astype(dtype)], axis=1
        )
        groups = (bucket.first_chunk, table.cross, extra, half)
        start = band, side, corner
        (band, side, corner), _ = scan_used(add, start, groups, bucket.used)
    return ReducedCameras(
        band,
        side[..., -1],
        side[..., :-1],
        corner[:-1, :-1],
        corner[:-1, -1],
        lasting_blocks(problem, tables, damping, sizes),
    )


def substitute_landmarks(
    problem: Problem,
    tables: tuple[LandmarkBlocks, ...],
    halves: tuple[Halves, ...],
    cameras: Float[Array, "t 6"],
    intrinsics: Float[Array, " i"],
    out: Float[Array, "l 3"],
) -> Float[Array, "l 3"]:
    """Returns `out` with the steps of all but lasting landmarks, given those of
    cameras, as their chunks stand, and of intrinsics."""
    for bucket, table, half in zip(problem.layout.buckets, tables, halves, strict=True):
        if bucket.lasting:
            continue
        step = cameras[frames_of(bucket.first_chunk, bucket.width)]
        n, g = len(step), table.own.shape[-1]
        # A product in the order of the tables, which `einsum` would transpose first.
        taken = step.reshape(n, 1, -1) @ table.cross.reshape(n, -1, 3 * g)
        taken = taken.reshape(n, 3, g)
        taken += jnp.einsum("nibg,i->nbg", table.cross_intrinsics, intrinsics)
        right = -table.gradient - taken.astype(table.gradient.dtype)
        moved = solve_landmarks(half, right)
        moved = jnp.moveaxis(moved, 1, 2).astype(out.dtype)
        out = out.at[bucket.landmark].set(moved, mode="drop")
    return out


def solve_landmarks(half: list[list], right: Float[Array, "n 3 g"]) -> Array:
    """Returns `L^-T L^-1` times a right-hand side of each landmark."""
    forward = [sum(half[i][k] * right[:, k] for k in range(i + 1)) for i in range(3)]
    back = [sum(half[k][i] * forward[k] for k in range(i, 3)) for i in range(3)]
    return jnp.stack(back, axis=1)


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
