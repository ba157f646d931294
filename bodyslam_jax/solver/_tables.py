"""The blocks of landmarks: dense tables of frames by landmarks of a group.

All buckets are linearised at once, as pieces of one chunk's frames by `g` landmarks.
Derivatives by camera, intrinsics and the residual itself are rows of one array, whose
Gram matrix holds the camera's block, the intrinsics' and both gradients.
"""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bodyslam_jax.camera import project
from bodyslam_jax.graph import CHUNK, LandmarkPrior, Problem, Reprojection, State
from bodyslam_jax.solver._blocks import LandmarkBlocks, Observations, Sizes, Sums


def gather(problem: Problem) -> Observations | None:
    """Measurements of landmarks in the order of the tables; `None` without any."""
    buckets = problem.layout.buckets
    factor = next((f for f in problem.factors if isinstance(f, Reprojection)), None)
    if factor is None or not buckets:
        return None
    row = jnp.concatenate([_cut(b.row) for b in buckets])
    landmark = jnp.concatenate([jnp.repeat(b.landmark, b.width, 0) for b in buckets])
    chunks = [
        b.first_chunk[:, None] + np.arange(b.width, dtype=np.int32) for b in buckets
    ]
    return Observations(
        pixel=jnp.moveaxis(factor.pixel[row], -1, 2),
        weight=1 / factor.sigma[row],
        chunk=jnp.concatenate([c.reshape(-1) for c in chunks]),
        landmark=landmark,
    )


def _cut(table: Int[Array, "n f g"]) -> Int[Array, "u b g"]:
    return table.reshape(-1, CHUNK, table.shape[-1])


def frames_of(first_chunk: Int[Array, " n"], width: int) -> Int[Array, "n f"]:
    """Frames that each group spans."""
    within = jnp.arange(width * CHUNK, dtype=first_chunk.dtype)
    return first_chunk[:, None] * CHUNK + within


def linearise_landmarks(
    problem: Problem,
    factor: Reprojection,
    seen: Observations | None,
    state: State,
    sums: Sums,
) -> tuple[LandmarkBlocks, ...]:
    """Tables of all buckets; what cameras and intrinsics gather goes to `sums`."""
    sizes = sums.sizes
    dtype = state.scale.dtype
    if seen is None:
        sums.costs.append(jnp.zeros((), dtype))
        return ()
    rows, by_l, cost = _rows(problem, factor, seen, state, sizes)
    sums.costs.append(cost)
    wide = rows.reshape(*rows.shape[:3], -1)
    # Fused sums: a matrix product for each frame of a piece would be far too small.
    gram = jnp.sum(wide[:, :, :, None] * wide[:, :, None], axis=-1)
    if "cameras" in sizes.variables:
        # As a product: a scatter would take its pieces one by one.
        chunk = jnp.arange(sizes.chunks, dtype=seen.chunk.dtype)[:, None]
        belongs = (chunk == seen.chunk).astype(dtype)
        of_camera = belongs @ gram[:, :, :6].reshape(len(gram), -1)
        of_camera = of_camera.reshape(-1, 6, gram.shape[-1])
        sums.add(("alone", "alone", 0), of_camera[..., :6])
        sums.add_gradient("camera_alone", of_camera[..., -1])
        if sizes.intrinsics:
            mixed = jnp.pad(of_camera[..., 6:-1], ((0, 0), (0, 0), (1, 10)))
            sums.add(("alone", "globals", 0), mixed)
    if sizes.intrinsics:
        total = jnp.sum(gram[:, :, 6:, 6:], axis=(0, 1))
        # The scale, first of the globals, moves no pixel.
        sums.add_globals(
            None,
            jnp.pad(total[:-1, :-1], ((1, 0), (1, 0))),
            jnp.pad(total[:-1, -1], (1, 0)),
        )
    pick = lambda x, c: x[:, :, :, c]
    outer = lambda a, b: a[:, :, :, None] * b[:, :, None]
    product = lambda a: _add(outer(pick(a, c), pick(by_l, c)) for c in (0, 1))
    cross = product(rows[:, :, :6])
    common = jnp.sum(product(rows[:, :, 6:]), axis=1)
    own = jnp.sum(product(by_l), axis=1)
    tables, start = [], 0
    for bucket in problem.layout.buckets:
        n, f, g = bucket.row.shape
        here = slice(start, start + n * bucket.width)
        start = here.stop
        over = lambda x, here=here, n=n: (
            x[here].reshape(n, -1, *x.shape[1:]).sum(axis=1)
        )
        both = over(common)
        tables.append(
            LandmarkBlocks(
                cross=cross[here].reshape(n, f, 6, 3, g).astype(sizes.dtype),
                cross_intrinsics=both[:, :-1].astype(sizes.dtype),
                own=over(own).astype(sizes.dtype),
                gradient=both[:, -1],
            )
        )
    return tuple(tables)


def add_prior(
    problem: Problem,
    prior: LandmarkPrior,
    state: State,
    tables: tuple[LandmarkBlocks, ...],
) -> tuple[LandmarkBlocks, ...]:
    """The tables with what is known of their landmarks besides."""
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


def _rows(
    problem: Problem,
    factor: Reprojection,
    seen: Observations,
    state: State,
    sizes: Sizes,
) -> tuple[Float[Array, "u b r 2 g"], Float[Array, "u b 3 2 g"], Float[Array, ""]]:
    """Weighted derivatives by camera and intrinsics, and the residual; derivatives by
    landmark; the cost. Held coordinates have rows of zeros."""
    camera = state.cameras.reshape(-1, CHUNK, 4, 4)[seen.chunk][..., :3, :, None]
    C, centre = camera[:, :, :, :3], camera[:, :, :, 3]
    point = jnp.moveaxis(state.landmarks[seen.landmark], 2, 1)[:, None]
    offset = point - centre
    # p_C = C^T (l - r'), one row of C after another
    p_C = _add(C[:, :, i] * offset[:, :, i, None] for i in range(3))
    pixels = lambda i, p: jnp.moveaxis(project(i, jnp.moveaxis(p, 2, -1)), -1, 2)
    pixel, push = jax.linearize(lambda p: pixels(state.intrinsics, p), p_C)
    basis = jnp.eye(3, dtype=p_C.dtype)[:, None, None, :, None]
    basis = jnp.broadcast_to(basis, (3, *p_C.shape))
    by_p = jax.vmap(push, out_axes=2)(basis)
    error = (pixel - seen.pixel) * seen.weight[:, :, None]
    s = error[:, :, 0] ** 2 + error[:, :, 1] ** 2
    root_weight = jnp.sqrt(factor.loss.weight(s))
    weight = (seen.weight * root_weight)[:, :, None, None]
    by_p = by_p * weight
    # dp_C/dl = C^T, dp_C/dr' = -C^T, dp_C/dω = [p_C]x for C Exp(ω)
    by_l = _add(by_p[:, :, None, k] * C[:, :, :, k, None] for k in range(3))
    p = p_C[:, :, :, None]
    ahead, behind = (lambda x: jnp.roll(x, -1, 2)), (lambda x: jnp.roll(x, 1, 2))
    turn = ahead(by_p) * behind(p) - behind(by_p) * ahead(p)
    free_c = problem.free.cameras.reshape(-1, CHUNK, 6)[seen.chunk]
    if "cameras" not in sizes.variables:
        free_c = jnp.zeros_like(free_c)
    free_l = jnp.moveaxis(problem.free.landmarks[seen.landmark], 2, 1)
    by_c = jnp.concatenate([turn, -by_l], axis=2) * free_c[..., None, None]
    by_l = by_l * free_l[:, None, :, None]
    parts = [by_c]
    if sizes.intrinsics:
        by_i = jax.jacfwd(lambda i: pixels(i, p_C))(state.intrinsics)
        by_i = by_i * problem.free.intrinsics
        parts.append(jnp.moveaxis(by_i, -1, 2) * weight)
    parts.append((error * root_weight[:, :, None])[:, :, None])
    cost = 0.5 * jnp.sum(factor.loss.rho(s))
    return jnp.concatenate(parts, axis=2), by_l, cost


def _add(terms):
    return functools.reduce(jnp.add, terms)
