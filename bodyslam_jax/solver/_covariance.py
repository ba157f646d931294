"""How sure an estimate is: marginal covariances, and what is not determined at all.

The inverse of the normal equations, but only where it is asked for: a second pass along
the chunks, from the last to the first, gives the covariance of all that stands in one
front (Takahashi's recursion), from the same factor that gives a step. The dense inverse
is never formed. Coordinates that are held are known exactly.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.compilation import is_alone, jit_once
from bodyslam_jax.graph import Problem, State, world_from_root
from bodyslam_jax.solver._blocks import Linearisation, Sizes, own_to_global, sizes_of
from bodyslam_jax.solver._chunks import Factor
from bodyslam_jax.solver._landmarks import CAMERAS, half_inverse
from bodyslam_jax.solver._levenberg_marquardt import little
from bodyslam_jax.solver._loop import Final
from bodyslam_jax.solver._normal import damped, diagonals
from bodyslam_jax.solver._padding import pad
from bodyslam_jax.solver._people import Roots
from bodyslam_jax.solver._solve import method_of, run
from bodyslam_jax.solver._window import Window, window_of


class Marginals(eqx.Module):
    """Covariances of one group at a time, in the metric world frame."""

    scale: Float[Array, ""]
    """Variance of s, (m per unit)^2"""
    cameras: Float[Array, "t 3 3"]
    """Of camera centres `s r'`, m^2"""
    people: Float[Array, "h t 3 3"]
    """Of pelvis joints in the world, m^2"""
    intrinsics: Float[Array, "i i"]
    """px^2; without a coordinate where none is free."""
    shapes: Float[Array, "h 10 10"]
    landmarks: Float[Array, "l 3 3"]
    """Of `s l'`, m^2"""


def marginals(problem: Problem, state: State) -> Marginals:
    """Marginal covariances at a solution: the inverse of `J^T J`.

    They count for as much as the weights do: sigmas that are standard deviations, and
    correlated errors modelled as such. The equations are set up by the program that
    `solve` has compiled, in a schedule without steps.
    """
    t, l = len(state.cameras), len(state.landmarks)
    problem, state = pad(problem, state)
    method = method_of((), 0.0, state.scale.dtype, keep=True)
    _, final = run(problem, state, method, alone=is_alone())
    spread = _marginals(problem, state, final)
    cut = {"cameras": spread.cameras[:t], "people": spread.people[:, :t]}
    return Marginals(**{**vars(spread), **cut, "landmarks": spread.landmarks[:l]})


@jit_once
def _marginals(problem: Problem, state: State, final: Final) -> Marginals:
    sizes = sizes_of(problem, state)
    lin, factor = final.lin, final.factor
    damping = damped(
        diagonals(lin, sizes), jnp.asarray(little(state.scale.dtype), state.scale.dtype)
    )
    pairs, windows, common = _selected_inverse(factor, sizes)
    fronts = _with_inner(pairs, final.roots, window_of(lin, sizes), sizes)
    common = common * _outer(_free_globals(problem, sizes))
    cameras, people = _centres(problem, state, sizes, fronts)
    landmarks = _landmarks(problem, state, sizes, lin, damping, windows)
    i = sizes.intrinsics
    h = sizes.people
    shapes = common[1 + i :, 1 + i :].reshape(h, 10, h, 10)
    return Marginals(
        scale=common[0, 0],
        cameras=cameras,
        people=people,
        intrinsics=common[1 : 1 + i, 1 : 1 + i],
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
    return jnp.concatenate(
        [scale[None], free.intrinsics[: sizes.intrinsics], shapes.reshape(-1)]
    )


def _selected_inverse(
    factor: Factor, sizes: Sizes
) -> tuple[Float[Array, "n p p"], Float[Array, "n w w"], Float[Array, "g g"]]:
    """Covariance of each chunk with the one before and the globals; of the cameras of
    its band with them; of the globals."""
    _, r, q = factor.side.shape
    g = sizes.globals
    head = q - CAMERAS
    middle = r - 1 - g - head - CAMERAS
    dtype = factor.half.dtype
    eye = jnp.eye(g, dtype=dtype)
    lower = jnp.linalg.cholesky(factor.corner[:g, :g], symmetrize_input=False)
    common = jax.scipy.linalg.cho_solve((lower, True), eye)
    start = jnp.zeros((r - 1, r - 1), dtype).at[-g:, -g:].set(common)
    last = jnp.arange(g) + q + r - 1 - g
    kept = jnp.concatenate([jnp.arange(q), q + head + jnp.arange(middle), last])
    pair = jnp.concatenate([jnp.arange(2 * q), last])
    window = jnp.concatenate(
        [head + jnp.arange(CAMERAS), q + head + jnp.arange(CAMERAS + middle), last]
    )

    def step(known, chunk):
        half, side = chunk
        gain = half.T @ side[:-1].T
        mixed = -gain @ known
        own = half.T @ half - mixed @ gain.T
        whole = jnp.block([[own, mixed], [mixed.T, known]])
        part = lambda index: whole[index[:, None], index[None, :]]
        return part(kept), (part(pair), part(window))

    chunks = (factor.half, factor.side)
    _, (pairs, windows) = jax.lax.scan(step, start, chunks, reverse=True)
    # Of a chunk and the next; before the first there is none.
    own = jnp.concatenate([jnp.arange(q), 2 * q + jnp.arange(g)])
    first = jnp.zeros_like(pairs[0])
    at = jnp.concatenate([q + jnp.arange(q), 2 * q + jnp.arange(g)])
    first = first.at[at[:, None], at].set(pairs[0][own[:, None], own])
    return jnp.concatenate([first[None], pairs[:-1]]), windows, common


def _with_inner(
    pairs: Float[Array, "n f f"], roots: Roots | None, window: Window, sizes: Sizes
) -> Float[Array, "n _ _"]:
    """Covariance of all roots of each chunk, person by person, its cameras, and the
    globals: eliminated roots follow from what was kept, with a spread of their own."""
    g, last, width = sizes.globals, 6 * window.reach, window.person
    q = (pairs.shape[-1] - g) // 2
    eye = jnp.eye(pairs.shape[-1], dtype=pairs.dtype)
    own_roots = q + width - last + jnp.arange(last)
    kept = jnp.arange(q - CAMERAS, q + g) + q
    at = [
        jnp.concatenate(
            [
                p * width + jnp.arange(width),
                q - last + jnp.arange(last),
                q + p * width + jnp.arange(width),
                2 * q - CAMERAS + jnp.arange(CAMERAS),
                2 * q + own_to_global(sizes, p),
            ]
        )
        for p in range(sizes.people)
    ]

    def one(chunk):
        known, roots = chunk
        rows, spread = [], jnp.zeros((0, 0), known.dtype)
        for p, index in enumerate(at):
            half = roots.half[p]
            gain = -half.T @ roots.side[p, :-1].T
            rows.append(
                jnp.zeros((len(half), len(eye)), eye.dtype).at[:, index].set(gain)
            )
            rows.append(eye[p * width + own_roots])
            spread = _diagonal(spread, half.T @ half, last)
        rows.append(eye[kept])
        turn = jnp.concatenate(rows)
        return turn @ known @ turn.T + _diagonal(spread, eye[:0, :0], len(kept))

    by_chunk = jax.tree.map(lambda x: x.swapaxes(0, 1), roots)
    return jax.lax.map(one, (pairs, by_chunk))


def _diagonal(first: Array, second: Array, more: int) -> Array:
    """Two blocks down a diagonal, and `more` of zeros."""
    a, b = len(first), len(second)
    first = jnp.pad(first, ((0, b + more),) * 2)
    return first + jnp.pad(second, ((a, more),) * 2)


def _centres(problem, state, sizes, fronts):
    """Covariances of camera centres and pelvis joints, from each chunk's front."""
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
        """`J Σ J^T` of each frame, with the columns of J at `index` of the front."""
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
    """`d (C Exp(ω) r) / dω = -C [r]x`"""
    r = jnp.broadcast_to(r[..., None, :], C.shape)
    return jnp.cross(r, C)


def _landmarks(problem, state, sizes, lin: Linearisation, damping, windows):
    """`V^-1 + V^-1 W^T Σ W V^-1` and the share of the scale, landmark by landmark."""
    l = state.landmarks.shape[0]
    out = jnp.zeros((l, 3, 3), state.scale.dtype)
    nb = sizes.bandwidth
    free_l = problem.free.landmarks
    free_s = problem.free.scale if "scale" in sizes.variables else 0.0
    common = nb * CAMERAS
    extra = common + own_to_global(sizes, None)
    for bucket, table, damp in zip(
        problem.layout.buckets, lin.landmarks, damping["landmarks"], strict=True
    ):
        rows = half_inverse(table, damp)
        zero = jnp.zeros_like(rows[0][0])
        half = jnp.stack(
            [jnp.stack(row + [zero] * (3 - len(row)), axis=1) for row in rows], axis=1
        )
        inverse = jnp.einsum("nkag,nkbg->nabg", half, half)
        width = bucket.width * CAMERAS
        index = jnp.concatenate([jnp.arange(width), extra])

        def one(group, index=index, width=width):
            chunk, cross, side, inverse = group
            known = windows[chunk][index[:, None], index[None, :]]
            count = cross.shape[-1]
            # The scale moves no landmark of the map: a row of zeros in its place.
            still = jnp.zeros((1, 3, count), cross.dtype)
            w = jnp.concatenate([cross.reshape(width, 3, count), still, side])
            gain = -jnp.einsum("wag,abg->wbg", w, inverse)
            moved = (known @ gain.reshape(len(index), -1)).reshape(gain.shape)
            spread = inverse + jnp.einsum("wag,wbg->abg", gain, moved)
            return spread, moved[width], known[width, width]

        groups = (bucket.first_chunk, table.cross, table.cross_intrinsics, inverse)
        spread, with_scale, of_scale = jax.lax.map(one, groups)
        spread = jnp.moveaxis(spread, 3, 1)
        with_scale = jnp.moveaxis(with_scale, 2, 1) * free_s
        mask = free_l[bucket.landmark]
        spread = spread * _outer(mask)
        with_scale = with_scale * mask
        point = state.landmarks[bucket.landmark]
        s = state.scale
        mixed = s * (point[..., :, None] * with_scale[..., None, :])
        total = s**2 * spread + mixed + mixed.swapaxes(-1, -2)
        square = point[..., :, None] * point[..., None, :]
        total = total + free_s * of_scale[:, None, None, None] * square
        out = out.at[bucket.landmark].set(total, mode="drop")
    return out


def observability(problem: Problem, state: State, spread: Marginals) -> tuple[str, ...]:
    """What the measurements do not determine, one line each; empty if all is well.

    A direction counts as not determined where its standard deviation is more than a
    third of the thing itself.
    """
    deviation = lambda x: np.sqrt(np.maximum(np.trace(x, axis1=-2, axis2=-1), 0.0))
    found = []
    cameras = np.asarray(state.cameras)
    s = float(state.scale)
    centres = s * cameras[:, :3, 3]
    reach = float(np.max(np.linalg.norm(centres - centres[0], axis=1), initial=0.0))
    if "scale" in problem.variables:
        share = float(np.sqrt(max(float(spread.scale), 0.0))) / s
        if not share < 1 / 3:
            found.append(
                f"scale: known to {share:.0%} only; the person or the camera hardly "
                "moves, or nothing links them."
            )
    if len(state.landmarks) and "landmarks" in problem.variables:
        seen = np.zeros(len(state.landmarks), bool)
        for bucket in problem.layout.buckets:
            index = np.asarray(bucket.landmark).ravel()
            seen[index[index < len(seen)]] = True
        if not seen.all():
            found.append(f"landmarks: {int((~seen).sum())} are not observed.")
        points = s * np.asarray(state.landmarks)
        depth = np.linalg.norm(points - centres.mean(axis=0), axis=1)
        lost = seen & ~(deviation(np.asarray(spread.landmarks)) < depth / 3)
        if lost.sum() > 0.5 * seen.sum():
            found.append(
                f"depth of {int(lost.sum())} of {int(seen.sum())} landmarks: the "
                "camera turns but does not move."
            )
        elif lost.any():
            found.append(f"depth of {int(lost.sum())} landmarks: seen from one place.")
    if "cameras" in problem.variables:
        lost = ~(deviation(np.asarray(spread.cameras)) < max(reach, 1e-9) / 3)
        if lost[1:].any():
            found.append(
                f"centres of {int(lost[1:].sum())} cameras: too few points, or the "
                "camera hardly moves."
            )
    if "roots" in problem.variables:
        for person in range(len(state.roots)):
            place = np.asarray(world_from_root(state))[person, :, :3, 3]
            distance = np.linalg.norm(place - centres, axis=1)
            lost = ~(deviation(np.asarray(spread.people[person])) < distance / 3)
            if problem.motion is not None:
                lost &= np.asarray(problem.motion.present[person])
            if lost.any():
                found.append(f"place of person {person} in {int(lost.sum())} frames.")
    return tuple(found)
