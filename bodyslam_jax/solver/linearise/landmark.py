"""The blocks of landmarks: dense tables of frames by landmarks of a group.

All buckets are linearised at once, as pieces of one chunk's frames by `g` landmarks.
Residuals and derivatives are taken in the camera frame. Camera blocks are sums over
landmarks, rotated to the axes of the cameras' steps afterwards.

With `P` a weighted pixel's derivative by the point in the camera frame, every block of
an observation follows from `P^T P`, since

    dp_C/dl = C^T,  dp_C/dr' = -C^T,  dp_C/dω = [p_C]x  for C Exp(ω).

Vectors here are lists of three arrays `u b g`, and a 3 x 3 matrix is the list of its
columns: parts of one stacked array would be copied before they are used.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bodyslam_jax.geometry.camera import project
from bodyslam_jax.graph import CHUNK, LandmarkPrior, Problem, Reprojection, State
from bodyslam_jax.solver.blocks import LandmarkBlocks, Observations, Sizes, Sums

Vector = list[Array]
Square = list[Vector]


def gather(problem: Problem) -> Observations | None:
    """Returns the observations of landmarks in the order of the tables, if any."""
    buckets = problem.layout.buckets
    factor = next((f for f in problem.factors if isinstance(f, Reprojection)), None)
    if factor is None or not buckets:
        return None
    row = jnp.concatenate([_cut(b.row) for b in buckets])
    landmark = jnp.concatenate([jnp.repeat(b.landmark, b.width, 0) for b in buckets])
    chunks = [
        b.first_chunk[:, None] + np.arange(b.width, dtype=np.int32) for b in buckets
    ]
    chunk = jnp.concatenate([c.reshape(-1) for c in chunks])
    order = problem.layout.order
    return Observations(
        pixel=jnp.moveaxis(factor.pixel[row], -1, 2),
        weight=1 / factor.sigma[row],
        chunk=chunk if order is None else order[chunk],
        landmark=landmark,
    )


def _cut(table: Int[Array, "n f g"]) -> Int[Array, "u b g"]:
    return table.reshape(-1, CHUNK, table.shape[-1])


def frames_of(first_chunk: Int[Array, " n"], width: int) -> Int[Array, "n f"]:
    """Returns the frames that each group spans, as their chunks stand."""
    within = jnp.arange(width * CHUNK, dtype=first_chunk.dtype)
    return first_chunk[:, None] * CHUNK + within


def linearise_landmarks(
    problem: Problem,
    factor: Reprojection,
    seen: Observations | None,
    state: State,
    sums: Sums,
) -> tuple[LandmarkBlocks, ...]:
    """Returns the tables of all buckets, and adds blocks of cameras and intrinsics to
    `sums`."""
    sizes = sums.sizes
    dtype = sizes.dtype
    if seen is None:
        sums.costs.append(jnp.zeros((), state.scale.dtype))
        return ()
    pixels = see(problem, factor, seen, state, sizes)
    sums.costs.append(pixels.cost)
    if sizes.intrinsics:
        # The scale, first of the globals, moves no pixel.
        sums.add_globals(
            None,
            jnp.pad(pixels.intrinsics, ((1, sizes.named), (1, sizes.named))),
            jnp.pad(pixels.intrinsics_slope, (1, sizes.named)),
        )
    free_c = jnp.zeros((len(seen.chunk), CHUNK, 6), dtype)
    if "cameras" in sizes.variables:
        _add_cameras(problem, seen, state, pixels, sums)
        free_c = problem.free.cameras.reshape(-1, CHUNK, 6)[seen.chunk].astype(dtype)
    free = jnp.moveaxis(problem.free.landmarks[seen.landmark], 2, 1)
    free_l = free.astype(dtype)
    C = [[x.astype(dtype) for x in column] for column in pixels.C]
    rows = transposed(C)
    # P^T P C^T, and C times that
    by_l = [times(pixels.square, row) for row in rows]
    moved = symmetric(lambda i, j: dot(rows[i], by_l[j]))
    turned = transposed([cross(x, pixels.point) for x in by_l])
    side = [jnp.stack(x, 2) for x in turned] + [-jnp.stack(x, 2) for x in moved]
    table = jnp.stack(side, 2) * free_c[..., None, None] * free_l[:, None, None]
    down = lambda vector: jnp.stack([jnp.sum(x, axis=1) for x in vector], 1)
    own = moved
    if dtype != free.dtype:
        by_point = [pair(x) for x in pixels.by_point]
        own = symmetric(lambda i, j: dot(by_point[i], by_point[j]))
    own = jnp.stack([down(x) for x in own], 1) * free[:, None] * free[:, :, None]
    common = [down(times(C, x)) * free_l for x in pixels.by_intrinsics]
    slope = down(times(pixels.C, pixels.slope)) * free
    tables, start = [], 0
    for bucket in problem.layout.buckets:
        n, f, g = bucket.row.shape
        here = slice(start, start + n * bucket.width)
        start = here.stop
        over = lambda x, here=here, n=n: (
            x[here].reshape(n, -1, *x.shape[1:]).sum(axis=1)
        )
        none = [jnp.zeros((n, 0, 3, g), dtype)]
        mixed = [over(x)[:, None] for x in common]
        tables.append(
            LandmarkBlocks(
                cross=table[here].reshape(n, f, 6, 3, g),
                cross_intrinsics=jnp.concatenate(mixed or none, axis=1),
                own=over(own),
                gradient=over(slope),
            )
        )
    return tuple(tables)


class Pixels(NamedTuple):
    """Sums over the two coordinates of each observation. All are in the state's
    precision except `square` and `by_intrinsics`, which have that of blocks."""

    C: Square
    """`C_WC`; arrays `u b 1`."""
    point: Vector
    """p_C"""
    square: Square
    """`P^T P`"""
    by_point: list[Float[Array, "u b 2 g"]]
    """Derivative by the point in the world, by coordinates."""
    slope: Vector
    """`P^T e`"""
    by_intrinsics: list[Vector]
    """`P^T Q` by columns, with Q the pixel's derivative by intrinsics."""
    intrinsics: Float[Array, "i i"]
    """`Q^T Q`, summed over all observations."""
    intrinsics_slope: Float[Array, " i"]
    cost: Float[Array, ""]


def _add_cameras(
    problem: Problem, seen: Observations, state: State, pixels: Pixels, sums: Sums
) -> None:
    """Adds blocks and gradients of cameras, summed over each frame's landmarks."""
    sizes, point = sums.sizes, pixels.point
    chunk = jnp.arange(sizes.chunks, dtype=seen.chunk.dtype)[:, None]
    belongs = chunk == seen.chunk
    # A matrix product: a scatter would add its pieces one by one.
    of_frames = lambda x: (belongs.astype(x.dtype) @ x.reshape(len(x), -1)).reshape(
        -1, *x.shape[2:]
    )
    total = lambda columns: jnp.stack(
        [jnp.stack([jnp.sum(x, axis=-1) for x in column], -1) for column in columns], -1
    )
    # By rotation and by translation in the camera's axes: dp_C = [p]x ω - C^T dr'
    half = [cross(x, point) for x in pixels.square]
    rows = transposed(half)
    both = symmetric(lambda i, j: cross(rows[i], point)[j])
    corner, side = total(both), -total(half)
    upper = jnp.concatenate([corner, side], axis=-1)
    lower = jnp.concatenate([side.swapaxes(-1, -2), total(pixels.square)], axis=-1)
    free = problem.free.cameras
    C, none = state.cameras[:, :3, :3], jnp.zeros_like(state.cameras[:, :3, :3])
    eye = jnp.broadcast_to(jnp.eye(3, dtype=C.dtype), C.shape)
    turn = jnp.block([[eye, none], [none, C]]) * free[..., None]
    low = turn.astype(sizes.dtype)
    block = of_frames(jnp.concatenate([upper, lower], axis=-2))
    sums.add(("alone", "alone", 0), low @ block @ low.swapaxes(-1, -2))
    both_ways = lambda x: [*cross(x, point), *(-y for y in x)]
    slope = of_frames(total([both_ways(pixels.slope)]))
    sums.add_gradient("camera_alone", (turn @ slope)[..., 0])
    if sizes.intrinsics:
        mixed = low @ of_frames(total([both_ways(x) for x in pixels.by_intrinsics]))
        around = (1, sizes.named + 10)
        sums.add(("alone", "globals", 0), jnp.pad(mixed, ((0, 0), (0, 0), around)))


def add_prior(
    problem: Problem,
    prior: LandmarkPrior,
    state: State,
    tables: tuple[LandmarkBlocks, ...],
) -> tuple[LandmarkBlocks, ...]:
    """Returns the tables with the blocks of a prior on landmarks added."""
    free = problem.free.landmarks
    error = prior.residual(state)
    weight = prior.loss.weight(jnp.sum(error**2, axis=-1))[:, None]
    jacobian = prior.whitening * free[:, None, :]
    own = jnp.einsum("lki,lkj->lij", weight[..., None] * jacobian, jacobian)
    gradient = jnp.einsum("lki,lk->li", jacobian, weight * error)
    of = lambda x, bucket: jnp.moveaxis(
        x.at[bucket.landmark].get(mode="fill", fill_value=0.0), 1, -1
    )
    return tuple(
        eqx.tree_at(
            lambda t: (t.own, t.gradient),
            table,
            (
                table.own + of(own.astype(table.own.dtype), bucket),
                table.gradient + of(gradient, bucket),
            ),
        )
        for bucket, table in zip(problem.layout.buckets, tables, strict=True)
    )


def see(
    problem: Problem,
    factor: Reprojection,
    seen: Observations,
    state: State,
    sizes: Sizes,
) -> Pixels:
    """Evaluates all observations at a state, weighted; derivatives by held intrinsics
    are 0."""
    camera = state.cameras.reshape(-1, CHUNK, 4, 4)[seen.chunk][..., :3, :, None]
    C, centre = camera[:, :, :, :3], camera[:, :, :, 3]
    point = jnp.moveaxis(state.landmarks[seen.landmark], 2, 1)[:, None]
    offset = point - centre
    # p_C = C^T (l - r'), one row of C after another
    p_C = add(C[:, :, i] * offset[:, :, i, None] for i in range(3))
    pixels = lambda i, p: jnp.moveaxis(project(i, jnp.moveaxis(p, 2, -1)), -1, 2)
    pixel, push = jax.linearize(lambda p: pixels(state.intrinsics, p), p_C)
    basis = jnp.eye(3, dtype=p_C.dtype)[:, None, None, :, None]
    P = jax.vmap(push)(jnp.broadcast_to(basis, (3, *p_C.shape)))
    error = (pixel - seen.pixel) * seen.weight[:, :, None]
    s = error[:, :, 0] ** 2 + error[:, :, 1] ** 2
    root_weight = jnp.sqrt(factor.loss.weight(s))[:, :, None]
    weight = seen.weight[:, :, None] * root_weight
    P, error = P * weight, error * root_weight
    Q = jnp.zeros((0, *error.shape), error.dtype)
    if sizes.intrinsics:
        by_i = jax.jacfwd(lambda i: pixels(i, p_C))(state.intrinsics)
        Q = jnp.moveaxis(by_i * problem.free.intrinsics, -1, 0) * weight
    low_P = [pair(x.astype(sizes.dtype)) for x in P]
    return Pixels(
        C=[[C[:, :, i, j] for i in range(3)] for j in range(3)],
        point=[p_C[:, :, i] for i in range(3)],
        square=symmetric(lambda i, j: dot(low_P[i], low_P[j])),
        by_point=[
            add(P[i] * C[:, :, j, i, :, None] for i in range(3)) for j in range(3)
        ],
        slope=[dot(pair(x), pair(error)) for x in P],
        by_intrinsics=[[dot(x, pair(q.astype(sizes.dtype))) for x in low_P] for q in Q],
        intrinsics=jnp.einsum("iubcg,jubcg->ij", Q, Q),
        intrinsics_slope=jnp.einsum("iubcg,ubcg->i", Q, error),
        cost=0.5 * jnp.sum(factor.loss.rho(s)),
    )


def pair(x: Float[Array, "u b 2 g"]) -> Vector:
    return [x[:, :, 0], x[:, :, 1]]


def add(terms) -> Array:
    return functools.reduce(jnp.add, terms)


def dot(a: Sequence[Array], b: Sequence[Array]) -> Array:
    return add(x * y for x, y in zip(a, b, strict=True))


def cross(a: Vector, b: Vector) -> Vector:
    """Returns `a x b`, in the precision of `a`."""
    b = [x.astype(a[0].dtype) for x in b]
    ahead, behind = (1, 2, 0), (2, 0, 1)
    return [a[i] * b[j] - a[j] * b[i] for i, j in zip(ahead, behind, strict=True)]


def times(columns: Square, x: Vector) -> Vector:
    return [dot(row, x) for row in transposed(columns)]


def transposed(columns: Square) -> Square:
    return [list(row) for row in zip(*columns, strict=True)]


def symmetric(entry: Callable[[int, int], Array]) -> Square:
    """Returns a symmetric 3 x 3 matrix, with each entry computed once."""
    known = {(i, j): entry(i, j) for i in range(3) for j in range(i, 3)}
    return [[known[min(i, j), max(i, j)] for i in range(3)] for j in range(3)]
