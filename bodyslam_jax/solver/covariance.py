"""Marginal covariances of an estimate.

They are blocks of the inverse of the normal equations, of which only those that are
needed are formed. Coordinates that are held are known exactly.

`marginals` takes its equations from the loop that `solve` has compiled, and a loop of
unknown length has no derivative backwards. `_equations` forms the same ones without it,
for the derivative alone, which takes a compilation of its own.

`selected_inverse` passes along the chunks, from the last to the first, and gives the
covariance of all variables in one front (Takahashi's recursion), from the same factor
that gives a step. The dense inverse is never formed.
"""

import dataclasses
import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from bodyslam_jax.geometry.lengths import is_alone, is_traced
from bodyslam_jax.graph import Problem, State
from bodyslam_jax.solver.block_cholesky import Factor
from bodyslam_jax.solver.blocks import (
    CAMERAS,
    Linearisation,
    Sizes,
    globals_of,
    own_to_global,
    sizes_of,
)
from bodyslam_jax.solver.compilation import compiled, in_full_precision
from bodyslam_jax.solver.elimination.person import RootFactor
from bodyslam_jax.solver.elimination.schur import half_inverse, lasting_spread
from bodyslam_jax.solver.front import Window, window_of
from bodyslam_jax.solver.levenberg_marquardt import Final, final_of
from bodyslam_jax.solver.linear_system import (
    UNOBSERVED_DIAGONAL,
    damped,
    diagonals,
    eliminate,
)
from bodyslam_jax.solver.linearise import linearise
from bodyslam_jax.solver.linearise.landmark import gather
from bodyslam_jax.solver.padding import first_rows, pad
from bodyslam_jax.solver.second_order import add_second_order, curvature_of
from bodyslam_jax.solver.solve import check_start, method_of, run
from bodyslam_jax.solver.step import little


class Marginals(eqx.Module):
    """Marginal covariances of each group, in the metric world frame."""

    scale: Float[Array, ""]
    """Variance of s, (m per unit)^2"""
    cameras: Float[Array, "t 3 3"]
    """Covariances of camera centres `s r'`, m^2"""
    people: Float[Array, "h t 3 3"]
    """Covariances of pelvis joints in the world, m^2"""
    intrinsics: Float[Array, "i i"]
    """Covariance of the intrinsics, px^2; empty where none is free."""
    globals: Float[Array, "g g"]
    """Covariance of named globals; empty where none is free."""
    shapes: Float[Array, "h 10 10"]
    """Covariances of SMPL β, in standard deviations of the population."""
    landmarks: Float[Array, "l 3 3"]
    """Covariances of landmarks `s l'`, m^2"""


def marginals(problem: Problem, state: State) -> Marginals:
    """Returns the marginal covariances at a solution: blocks of the inverse of `J^T J`
    and the second-order term of keypoints (`second_order.py`), or of `J^T J` alone
    where the sum is not positive definite, as away from a minimum.

    They are as good as the weights: sigmas must be standard deviations, and correlated
    errors modelled as such. The equations are set up by the program that `solve` has
    compiled, in a schedule without steps. Differentiable in reverse mode with respect
    to problem and state (`_equations`).

    **Raises:** `ValueError` if `state` does not fit the problem, as `solve` does.
    """
    check_start(problem, state)
    t, l = len(state.cameras), len(state.landmarks)
    spread = _differentiable(pad(problem, state), is_alone())
    cut = {
        "cameras": first_rows(spread.cameras, t),
        "people": first_rows(spread.people, t, axis=1),
        "landmarks": first_rows(spread.landmarks, l),
    }
    return Marginals(**{**vars(spread), **cut})


@eqx.filter_custom_vjp
def _differentiable(given: tuple[Problem, State], alone: bool) -> Marginals:
    problem, state = given
    method = method_of((), 0.0, state.scale.dtype, keep=True)
    _, final = run(problem, state, method, alone=alone)
    program = _program(alone and not is_traced((problem, state)))
    return program(problem, state, final)


@functools.cache
def _program(alone: bool) -> Callable[..., Marginals]:
    return compiled(_marginals) if alone else eqx.filter_jit(_marginals)


@_differentiable.def_fwd
def _forward(perturbed, given, alone):
    return _differentiable(given, alone), None


@_differentiable.def_bwd
def _backward(residuals, cotangent, perturbed, given, alone):
    return _pulled(given, cotangent)


@eqx.filter_jit
def _pulled(given: tuple[Problem, State], cotangent: Marginals):
    arrays, static = eqx.partition(given, eqx.is_inexact_array)

    def spread(arrays):
        problem, state = eqx.combine(arrays, static)
        problem = dataclasses.replace(problem, layout=problem.layout.all_used())
        return _marginals(problem, state, _equations(problem, state))

    found, pull = jax.vjp(spread, arrays)
    full = jax.tree.map(
        lambda c, x: jnp.zeros_like(x) if c is None else c,
        cotangent,
        found,
        is_leaf=lambda x: x is None,
    )
    return pull(full)[0]


@in_full_precision
def _equations(problem: Problem, state: State) -> Final:
    """Returns the equations of the loop's last factorisation, of a padded problem."""
    problem = problem.with_prediction(problem.predict(state))
    sizes = sizes_of(problem, state)
    lin = linearise(problem, gather(problem), state, sizes.dtype)
    lin = _bent(problem, lin, state, sizes)
    return final_of(lin, eliminate(problem, lin, sizes, _damping(lin, sizes)))


def _damping(lin: Linearisation, sizes: Sizes) -> dict:
    return damped(
        diagonals(lin, sizes),
        jnp.asarray(little(sizes.dtype), sizes.dtype),
        UNOBSERVED_DIAGONAL,
    )


def _bent(
    problem: Problem, lin: Linearisation, state: State, sizes: Sizes
) -> Linearisation:
    """Adds the second-order term of keypoints where the sum is positive definite."""
    bent = add_second_order(lin, curvature_of(problem, lin, state, sizes))
    tried = jax.lax.stop_gradient(bent)
    factor = eliminate(problem, tried, sizes, _damping(tried, sizes)).factor
    sound = jnp.all(jnp.isfinite(factor.half))
    # A masked sum, as the gradient of a choice between factorisations would be NaN.
    mixed = lambda a, b: a + jnp.where(sound, b - a, 0.0).astype(a.dtype)
    return jax.tree.map(
        lambda a, b: mixed(a, b) if eqx.is_inexact_array(a) else a, lin, bent
    )


@in_full_precision
def _marginals(problem: Problem, state: State, final: Final) -> Marginals:
    sizes = sizes_of(problem, state)
    lin = final.lin
    damping = _damping(lin, sizes)
    fronts, windows, arrow = selected_inverse(
        final.factor,
        final.roots,
        window_of(lin, sizes),
        sizes,
        problem.layout.order,
    )
    g = sizes.globals
    common = arrow[:g, :g] * _outer(_free_globals(problem, sizes))
    cameras, people = _centres(problem, state, sizes, fronts)
    landmarks = _landmarks(problem, state, sizes, lin, damping, windows, arrow)
    i = sizes.intrinsics
    h = sizes.people
    shapes = common[sizes.common :, sizes.common :].reshape(h, 10, h, 10)
    return Marginals(
        scale=common[0, 0],
        cameras=cameras,
        people=people,
        intrinsics=common[1 : 1 + i, 1 : 1 + i],
        globals=common[1 + i : sizes.common, 1 + i : sizes.common],
        shapes=jnp.stack([shapes[p, :, p] for p in range(h)])
        if h
        else jnp.zeros((0, 10, 10), common.dtype),
        landmarks=landmarks,
    )


def _outer(mask: Array) -> Array:
    return mask[..., :, None] * mask[..., None, :]


def _free_globals(problem: Problem, sizes: Sizes) -> Array:
    free = problem.free
    shapes = free.shapes if "shapes" in sizes.variables else 0 * free.shapes
    scale = free.scale if "scale" in sizes.variables else 0 * free.scale
    return globals_of(dataclasses.replace(free, scale=scale, shapes=shapes), sizes)


def _centres(problem, state, sizes, fronts):
    """Returns covariances of camera centres and pelvis joints, from the fronts."""
    h, n = sizes.people, sizes.chunks
    head = fronts.shape[-1] - sizes.globals - CAMERAS
    hb = head // h if h else 0
    b = CAMERAS // 6
    frames = jnp.arange(b)
    scale_at = head + CAMERAS
    free = problem.free
    ones = lambda group, x: x if group in sizes.variables else 0 * x
    s = state.scale * jnp.ones((n, b, 1, 1), state.scale.dtype)
    eye = jnp.eye(3, dtype=s.dtype)
    camera = state.cameras.reshape(n, b, 4, 4)
    free_camera = ones("cameras", free.cameras).reshape(n, b, 6)
    free_scale = ones("scale", free.scale)
    by_scale = camera[..., :3, 3:] * free_scale
    by_centre = s * eye * free_camera[..., None, 3:]

    def spread(jacobian, index):
        """Returns `J Σ J^T` of each frame; J's columns are at `index` of the front."""
        part = fronts[:, index[:, :, None], index[:, None, :]]
        return jnp.einsum("nbij,nbjk,nblk->nbil", jacobian, part, jacobian)

    at_camera = head + 6 * frames[:, None] + jnp.arange(6)
    at_scale = jnp.full((b, 1), scale_at)
    index = jnp.concatenate([at_camera[:, 3:], at_scale], axis=1)
    cameras = spread(jnp.concatenate([by_centre, by_scale], -1), index)
    people = []
    for p in range(h):
        r_CH = state.roots[p, :, :3, 3].reshape(n, b, 3)
        base = p * hb + hb - CAMERAS
        at_root = base + 6 * frames[:, None] + jnp.arange(3, 6)
        C = camera[..., :3, :3]
        free_root = ones("roots", free.roots)[p].reshape(n, b, 6)
        jacobian = jnp.concatenate(
            [
                _turned(C, r_CH) * free_camera[..., None, :3],
                by_centre,
                C * free_root[..., None, 3:],
                by_scale,
            ],
            axis=-1,
        )
        index = jnp.concatenate([at_camera, at_root, at_scale], axis=1)
        people.append(spread(jacobian, index).reshape(n * b, 3, 3))
    none = jnp.zeros((0, n * b, 3, 3), s.dtype)
    return cameras.reshape(n * b, 3, 3), jnp.stack(people) if h else none


def _turned(C, r):
    """Returns `d (C Exp(ω) r) / dω = -C [r]x`."""
    r = jnp.broadcast_to(r[..., None, :], C.shape)
    return jnp.cross(r, C)


def _landmarks(problem, state, sizes, lin: Linearisation, damping, windows, arrow):
    """Returns covariances of landmarks, m^2, with the share of the scale."""
    out = jnp.zeros((len(state.landmarks), 3, 3), state.scale.dtype)
    free_s = problem.free.scale if "scale" in sizes.variables else 0.0
    s = state.scale
    for bucket, table, damp in zip(
        problem.layout.buckets, lin.landmarks, damping["landmarks"], strict=True
    ):
        if bucket.lasting:
            found = lasting_spread(bucket.landmark.shape, sizes, arrow)
        else:
            found = _from_cameras(bucket, table, damp, windows, sizes)
        spread, with_scale, of_scale = found
        mask = problem.free.landmarks[bucket.landmark]
        spread = spread * _outer(mask)
        with_scale = with_scale * free_s * mask
        point = state.landmarks[bucket.landmark]
        mixed = s * (point[..., :, None] * with_scale[..., None, :])
        total = s**2 * spread + mixed + mixed.swapaxes(-1, -2)
        square = point[..., :, None] * point[..., None, :]
        total = total + free_s * of_scale[:, None, None, None] * square
        out = out.at[bucket.landmark].set(total, mode="drop")
    return out


def _from_cameras(bucket, table, damp, windows, sizes):
    """Returns `V^-1 + V^-1 W^T Σ W V^-1` of each landmark that was eliminated before
    the cameras, its covariance with the scale, and the variance of the scale."""
    rows = half_inverse(table.own, damp)
    zero = jnp.zeros_like(rows[0][0])
    half = jnp.stack(
        [jnp.stack(row + [zero] * (3 - len(row)), axis=1) for row in rows], axis=1
    )
    inverse = jnp.einsum("nkag,nkbg->nabg", half, half)
    width = bucket.width * CAMERAS
    common = sizes.bandwidth * CAMERAS + own_to_global(sizes, None)
    index = jnp.concatenate([jnp.arange(width), common])

    def one(group):
        chunk, cross, side, inverse = group
        known = windows[chunk][index[:, None], index[None, :]]
        count = cross.shape[-1]
        # Landmarks do not couple with the scale or named globals: rows of zeros.
        still = lambda rows: jnp.zeros((rows, 3, count), cross.dtype)
        w = jnp.concatenate(
            [cross.reshape(width, 3, count), still(1), side, still(sizes.named)]
        )
        gain = -jnp.einsum("wag,abg->wbg", w, inverse)
        moved = (known @ gain.reshape(len(index), -1)).reshape(gain.shape)
        spread = inverse + jnp.einsum("wag,wbg->abg", gain, moved)
        return spread, moved[width], known[width, width]

    groups = (bucket.first_chunk, table.cross, table.cross_intrinsics, inverse)
    spread, with_scale, of_scale = jax.lax.map(one, groups)
    return jnp.moveaxis(spread, 3, 1), jnp.moveaxis(with_scale, 2, 1), of_scale


def selected_inverse(
    factor: Factor,
    roots: RootFactor | None,
    window: Window,
    sizes: Sizes,
    order: Int[Array, " n"] | None,
) -> tuple[Float[Array, "n f f"], Float[Array, "n w w"], Float[Array, "a a"]]:
    """Returns three covariances: of each chunk's roots (all, person by person), cameras
    and the globals, in the order of time; of the cameras in its band with the globals,
    chunks as they stand; and of the whole arrow."""
    r, q = factor.side.shape[1:]
    g, arrow = sizes.globals, sizes.arrow
    head = q - CAMERAS
    near = sizes.reach * head
    dtype = factor.half.dtype
    eye = jnp.eye(arrow, dtype=dtype)
    corner = factor.corner[:arrow, :arrow]
    lower = jnp.linalg.cholesky(corner, symmetrize_input=False)
    common = jax.scipy.linalg.cho_solve((lower, True), eye)
    start = jnp.zeros((r - 1, r - 1), dtype).at[-arrow:, -arrow:].set(common)
    split = jnp.split(jnp.arange(q + r - 1), [head, q, q + near, q + r - 1 - arrow])
    own_people, own_cameras, people, cameras, last = split
    kept = own_people, people[: near - head], own_cameras, cameras[:-CAMERAS], last
    last = last[:g]
    kept, band = jnp.concatenate(kept), jnp.concatenate([own_cameras, cameras, last])

    def pair(apart):
        """Returns the indices of this chunk, the one `apart` places after it, and the
        globals."""
        block = lambda start, width: start + (apart - 1) * width + jnp.arange(width)
        other = block(q, head), block(q + near, CAMERAS)
        return jnp.concatenate([own_people, own_cameras, *other, last])

    def step(known, chunk):
        half, side, neighbours = chunk
        gain = half.T @ side[:-1].T
        mixed = -gain @ known
        own = half.T @ half - mixed @ gain.T
        whole = jnp.block([[own, mixed], [mixed.T, known]])
        part = lambda index: whole[index[:, None], index[None, :]]
        pairs = [part(pair(apart)) for apart in neighbours or (1,)]
        return part(kept), (pairs, part(band))

    def scan(*neighbours):
        chunks = factor.half, factor.side, neighbours
        _, (pairs, windows) = jax.lax.scan(step, start, chunks, reverse=True)
        return pairs, windows

    if order is None:
        (pairs,), windows = scan()
    else:
        place = jnp.argsort(order)
        follower = jnp.roll(place, -1)
        ahead = follower - place
        near_by = lambda apart: jnp.clip(apart, 1, sizes.reach)[order]
        (after, before), windows = scan(near_by(ahead), near_by(-jnp.roll(ahead, 1)))
        turned = jnp.r_[q : 2 * q, 0:q, 2 * q : 2 * q + g]
        before = before[follower][:, turned][:, :, turned]
        pairs = jnp.where((ahead > 0)[:, None, None], after[place], before)
    # Roots eliminated with their chunk couple with the chunk before: both stand in a
    # pair. The first chunk has none before it.
    at = q + jnp.arange(q + g)
    own = jnp.r_[0:q, 2 * q : 2 * q + g]
    alone = jnp.zeros_like(pairs[:1])
    alone = alone.at[:, at[:, None], at].set(pairs[:1, own[:, None], own])
    pairs = jnp.concatenate([alone, pairs[:-1]])
    by_chunk = jax.tree.map(lambda x: x.swapaxes(0, 1), roots)
    with_inner = lambda given: _with_inner(given[0], given[1], window, sizes)
    return jax.lax.map(with_inner, (pairs, by_chunk)), windows, common


def _with_inner(
    pair: Float[Array, "p p"], roots: RootFactor | None, window: Window, sizes: Sizes
) -> Float[Array, "f f"]:
    """Returns the covariance of all roots of a chunk, its cameras and the globals, from
    that of the kept variables of two chunks: eliminated roots are linear in these, with
    a conditional covariance of their own."""
    g, last, width = sizes.globals, 6 * window.reach, window.person
    q = (len(pair) - g) // 2
    eye = jnp.eye(len(pair), dtype=pair.dtype)
    rows, spread = [], jnp.zeros((0, 0), pair.dtype)
    halves, sides = ((), ()) if roots is None else (roots.half, roots.side)
    for p in range(sizes.people):
        index = jnp.concatenate(
            [
                p * width + jnp.arange(width),
                q - last + jnp.arange(last),
                q + p * width + jnp.arange(width),
                2 * q - CAMERAS + jnp.arange(CAMERAS),
                2 * q + own_to_global(sizes, p),
            ]
        )
        half, side = halves[p], sides[p]
        none = jnp.zeros((len(half), len(pair)), pair.dtype)
        rows.append(none.at[:, index].set(-half.T @ side[:-1].T))
        rows.append(eye[q + (p + 1) * width - last + jnp.arange(last)])
        spread = _diagonal(spread, half.T @ half, last)
    rows.append(eye[2 * q - CAMERAS :])
    turn = jnp.concatenate(rows)
    return turn @ pair @ turn.T + _diagonal(spread, eye[:0, :0], CAMERAS + g)


def _diagonal(first: Array, second: Array, more: int) -> Array:
    """Returns the block-diagonal matrix of both blocks, and `more` rows of zeros."""
    a, b = len(first), len(second)
    first = jnp.pad(first, ((0, b + more),) * 2)
    return first + jnp.pad(second, ((a, more),) * 2)
