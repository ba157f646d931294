"""Marginalises the first chunks of a problem into a prior on the remaining ones.

The measurements are split (`subproblem`): `old` are those of the first frames and of
all landmarks that these frames observe, `rest` are the others. With the normal
equations `H δ = -g` of `old` at a state, E the variables that only `old` depends on,
and R all others that it depends on,

    Λ = H_RR - H_RE H_EE^-1 H_ER,    η = g_R - H_RE H_EE^-1 g_E.

The elimination of a step (`linear_system.py`) yields both when it has come to the last
chunk of the first frames: landmarks, postures, roots and all chunks before it are
eliminated, and the remaining system is Λ, with the right-hand side -η. R are the last
posture and the last roots of that chunk, its last cameras and those of the next chunks
that observe old landmarks, and the globals. It takes one elimination, whatever the size
of R.

With `Λ = W^T W` and `W^T b = η`, from the eigenvectors of Λ in units of its diagonal,
`½ |W δ + b|²` is, up to a constant, the least cost of `old` over E: to second order,
and exactly where residuals are linear and losses squared (Sibley, Matthies, Sukhatme,
Sliding window filter with application to planetary landing, 2010). `MarginalPrior` has
it as a factor of the remaining state.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from bodyslam_jax.geometry import so3
from bodyslam_jax.graph import (
    CHUNK,
    MarginalPrior,
    Problem,
    State,
    layout_of,
    residual_of,
)
from bodyslam_jax.solver.block_cholesky import Factor as Factorised
from bodyslam_jax.solver.block_cholesky import factorise
from bodyslam_jax.solver.blocks import CAMERAS, Sizes, basis_of, mask_of, sizes_of
from bodyslam_jax.solver.compilation import compiled, in_full_precision
from bodyslam_jax.solver.elimination.schur import half_inverses
from bodyslam_jax.solver.front import Window
from bodyslam_jax.solver.linear_system import damped, diagonals, reduce_to_chunks
from bodyslam_jax.solver.linearise import linearise
from bodyslam_jax.solver.linearise.landmark import gather
from bodyslam_jax.solver.linearise.marginal_prior import indices
from bodyslam_jax.solver.padding import pad
from bodyslam_jax.solver.reduced_system import Chunks
from bodyslam_jax.solver.solve import check_start
from bodyslam_jax.solver.subproblem import (
    marginalised_part,
    observed_landmarks,
    reach_of,
    remaining_part,
    restricted,
)
from bodyslam_jax.solver.triangular import row_of

_ELIMINATION_DAMPING_EPS = 64
"""Damping of eliminated variables, in units of the machine epsilon: pivots of points
without parallax stay positive, and its effect on the rest is below rounding."""
_INVARIANCE_TOLERANCE = {"float64": 1e-6, "float32": 1e-2}
"""Largest change of an invariant residual, in standard deviations, that rounding may
cause where the map is moved as a whole."""
_TEST_ROTATION_RAD = (0.3, -0.2, 0.4)
"""Rotation of the map, rad, by which invariance is tested; any large one will do."""
_TEST_TRANSLATION, _TEST_SCALE = (0.7, -0.4, 0.5), 1.3
"""Translation and change of scale for the same test; any large ones will do."""


class Remainder(NamedTuple):
    """The remaining problem and state after `marginalise`."""

    problem: Problem
    """The last of its factors is the `MarginalPrior`."""
    state: State
    landmarks: Int[np.ndarray, " l"]
    """Indices of the remaining landmarks in the original problem."""


def marginalise(problem: Problem, state: State, frames: int) -> Remainder:
    """Returns the problem with the measurements of its first `frames`
    frames replaced by a prior.

    `frames` is a multiple of `graph.CHUNK`, ten frames. The last ten of them stay, as
    factors of later frames and the motion model reach back to them: their last cameras,
    roots and the last posture are in the prior, all else in them is held. Landmarks
    that the first frames observe are marginalised with all their observations. The
    prior is one more factor: it may be marginalised again, together with its ten
    frames, and added to other problems that begin with these frames.

    Predictions of the motion model, weights of robust losses and derivatives are those
    at `state`, and stay fixed in the prior.

    Not for use within `jit`: how many coordinates stay depends on the tracks.

    **Raises:** `ValueError` if `frames` is no multiple of ten, or not between 10 and
    the number of frames less 1; if `state` does not fit the problem, as `solve` does;
    or if a factor reaches back ten frames or more.
    """
    check_start(problem, state)
    total = len(state.cameras)
    if frames % CHUNK or not 0 < frames < total:
        raise ValueError(
            f"frames: {frames}, expected a multiple of {CHUNK} from {CHUNK} to "
            f"{total - 1}."
        )
    problem = problem.refresh(state)
    observed, last = observed_landmarks(problem, frames)
    first = frames // CHUNK - 1
    old, start = marginalised_part(problem, state, frames, observed, last)
    count = -(-len(start.cameras) // CHUNK) - first
    padded = pad(old, start)
    found = _program()(*padded, jnp.asarray(first, jnp.int32), count)
    invariant = _invariant(*padded)
    rest, rest_state, landmarks = remaining_part(
        problem, state, frames, observed, found.window.reach
    )
    free = np.asarray(problem.free.poses)[:, frames - 1].reshape(-1, 69, 1)
    postures = free * np.asarray(basis_of(problem, state.scale.dtype))
    prior = _prior(problem, old, rest_state, found, count, invariant, postures)
    left = (*rest.factors, prior)
    shape = {"t": len(rest_state.cameras), "l": len(landmarks), "h": len(state.roots)}
    whole = dataclasses.replace(rest, factors=left, layout=layout_of(left, shape, None))
    return Remainder(whole, rest_state, landmarks)


# The Schur complement.


class _Trailing(eqx.Module):
    """Λ and η of people in the last marginalised chunk, of `count` chunks of cameras
    from it on, and of globals."""

    matrix: Float[Array, "n n"]
    slope: Float[Array, " n"]
    window: Window


@functools.cache
def _program() -> Callable[..., _Trailing]:
    return compiled(_trailing)


@in_full_precision
def _trailing(
    problem: Problem, state: State, first: Int[Array, ""], count: int
) -> _Trailing:
    """Eliminates the `first` chunks before the last marginalised
    one; returns Λ and η."""
    sizes = sizes_of(problem, state)
    lin = linearise(problem, gather(problem), state)
    dtype = state.scale.dtype
    little = jnp.asarray(_ELIMINATION_DAMPING_EPS * jnp.finfo(dtype).eps, dtype)
    damping = damped(diagonals(lin, sizes), little)
    halves = half_inverses(lin.landmarks, damping["landmarks"])
    chunks, window, _ = reduce_to_chunks(problem, lin, sizes, damping, halves)
    layout = dataclasses.replace(problem.layout, used=first)
    factor = factorise(chunks, sizes, layout)
    matrix = _unfactorised(chunks, factor, sizes, first, count)
    after = first * CHUNK
    rows = lambda x, axis, start, size: jax.lax.dynamic_slice_in_dim(
        x, after + start, size, axis
    )
    kept = [rows(damping["camera"], 0, 0, count * CHUNK).reshape(-1)]
    if sizes.people:
        last = CHUNK - window.reach
        own = [rows(damping["root"], 1, last, window.reach).reshape(sizes.people, -1)]
        if window.pose:
            own.insert(0, rows(damping["pose"], 1, CHUNK - 1, 1)[:, 0])
        kept.insert(0, jnp.concatenate(own, axis=1).reshape(-1))
    added = jnp.concatenate([*kept, damping["globals"]])
    # The damping of the remaining variables is removed.
    return _Trailing(
        matrix[:-1, :-1] - jnp.diag(added),
        -matrix[:-1, -1],
        window,
    )


def _unfactorised(
    chunks: Chunks,
    factor: Factorised,
    sizes: Sizes,
    first: Int[Array, ""],
    count: int,
) -> Float[Array, "n n"]:
    """Returns the Schur complement on people of chunk `first`, cameras of `count`
    chunks, and the globals with the right-hand side, once the chunks before are
    factorised."""
    _, r, q = chunks.coupling.shape
    head, tail = q - CAMERAS, sizes.arrow + 1
    after = (r - head - tail) // CAMERAS
    end = head + count * CAMERAS
    size = end + tail
    whole = jnp.zeros((size, size), chunks.pivot.dtype)
    cameras = lambda i: np.arange(head + i * CAMERAS, head + (i + 1) * CAMERAS)
    globals_ = np.arange(end, size)
    tail_rows = np.arange(r - tail, r)
    for i in range(count):
        pivot, coupling = (
            row_of(x, first + i) for x in (chunks.pivot, chunks.coupling)
        )
        # People of the first chunk only: no old measurement sees those of the others.
        mine = np.arange(q) if i == 0 else np.arange(head, q)
        place = np.arange(q) if i == 0 else cameras(i)
        later = np.arange(end - cameras(i)[-1] - 1)[: after * CAMERAS]
        rows = np.concatenate([head + later, tail_rows])
        below = np.concatenate([cameras(i)[-1] + 1 + later, globals_])
        part = coupling[rows[:, None], mine]
        whole = whole.at[place[:, None], place].add(pivot[mine[:, None], mine])
        whole = whole.at[below[:, None], place].add(part)
        whole = whole.at[place[:, None], below].add(part.T)
    for back in range(1, after + 1):
        known = first >= back
        side = row_of(factor.side, jnp.maximum(first - back, 0))
        side = jnp.where(known, side, 0.0)
        people = side[:head] if back == 1 else jnp.zeros_like(side[:head])
        seen = side[head + (back - 1) * CAMERAS : -tail][: count * CAMERAS]
        seen = jnp.pad(seen, ((0, count * CAMERAS - len(seen)), (0, 0)))
        rows = jnp.concatenate([people, seen, side[-tail:]])
        whole = whole - rows @ rows.T
    return whole.at[end:, end:].set(factor.corner)


# The prior.


def _prior(
    problem: Problem,
    old: Problem,
    left: State,
    found: _Trailing,
    count: int,
    invariant: Bool[np.ndarray, " 3"],
    postures: Float[np.ndarray, "h 69 p"],
) -> MarginalPrior:
    """Returns the factor of the remaining state that has this Λ and η; `postures` are
    the derivatives of turns by the coordinates of the last postures."""
    frames = min(count * CHUNK, len(left.cameras))
    none = np.zeros(len(left.landmarks), bool)
    estimate = restricted(left, 0, frames, none)
    size = 1 + len(left.intrinsics) + len(left.globals) + left.shapes.size
    size += 6 * frames + len(left.roots) * (6 * found.window.reach + 69)
    dtype = left.scale.dtype
    prior = MarginalPrior(
        root=jnp.zeros((size, size), dtype),
        offset=jnp.zeros(size, dtype),
        estimate=estimate,
        anchor=jnp.zeros(frames, dtype),
        invariant=jnp.asarray(invariant, dtype),
        reach=found.window.reach,
    )
    index = indices(prior, sizes_of(old, left))
    cut = CAMERAS * count - 6 * frames
    end = len(found.slope) - len(index.globals)
    kept = np.r_[: end - cut, end : len(found.slope)]
    rest = np.concatenate([index.cameras, index.globals])
    # The prior is over turns, of which it sees only those that the basis spans.
    place = np.zeros((len(kept), size))
    width = found.window.person
    for h, turns in enumerate(postures):
        rows = slice(h * width, (h + 1) * width)
        if found.window.pose:
            place[rows][: found.window.pose, index.postures[h]] = np.linalg.pinv(turns)
        place[rows][found.window.pose :, index.roots[h]] = np.eye(
            6 * found.window.reach
        )
    place[len(kept) - len(rest) :, rest] = np.eye(len(rest))
    matrix = place.T @ np.asarray(found.matrix)[np.ix_(kept, kept)] @ place
    slope = place.T @ np.asarray(found.slope)[kept]
    gone = index.cameras[: 6 * (CHUNK - reach_of(problem))]
    matrix, slope = _without(matrix, slope, gone, float(np.finfo(dtype).eps))
    root, offset = square_root(matrix, slope, float(np.finfo(dtype).eps))
    diagonal = np.diag(matrix)[index.cameras].reshape(-1, 6)
    anchor = (diagonal[:, 3:] > 0).any(axis=1)
    return dataclasses.replace(
        prior,
        root=jnp.asarray(root, dtype),
        offset=jnp.asarray(offset, dtype),
        anchor=jnp.asarray(anchor, dtype),
    )


def _without(matrix, slope, gone, eps):
    """Returns Λ and η with the coordinates `gone` eliminated, whose rows become 0."""
    gone = gone[np.diag(matrix)[gone] > 0]
    unit = 1 / np.sqrt(np.diag(matrix)[gone])
    own = unit[:, None] * matrix[np.ix_(gone, gone)] * unit
    own += _ELIMINATION_DAMPING_EPS * eps * np.eye(len(gone))
    side = unit[:, None] * matrix[gone]
    gain = np.linalg.solve(own, side).T
    matrix = matrix - gain @ side
    slope = slope - gain @ (unit * slope[gone])
    matrix[gone], matrix[:, gone], slope[gone] = 0.0, 0.0, 0.0
    return (matrix + matrix.T) / 2, slope


def square_root(
    matrix: Float[np.ndarray, "n n"], slope: Float[np.ndarray, " n"], eps: float
) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, " n"]]:
    """Returns `W` with `W^T W` the matrix, and `b` with `W^T b` the slope, on the
    eigenvectors whose eigenvalues are above rounding."""
    diagonal = np.maximum(np.diag(matrix), 0.0)
    unit = np.where(diagonal > 0, np.sqrt(diagonal), 1.0)
    values, vectors = np.linalg.eigh(matrix / np.outer(unit, unit))
    known = values > len(values) * eps * max(values[-1], 0.0)
    size = np.sqrt(np.where(known, values, 0.0))
    root = size[:, None] * vectors.T * unit
    offset = np.where(known, vectors.T @ (slope / unit), 0.0)
    return root, offset / np.where(known, size, 1.0)


def _invariant(problem: Problem, state: State) -> Bool[np.ndarray, " 3"]:
    """Returns whether the measurements are invariant to translation, rotation and scale
    of the map; held coordinates do not move with it."""
    change, size = (np.asarray(x) for x in _changes(problem, state))
    free = change <= _INVARIANCE_TOLERANCE[state.scale.dtype.name] * (1 + size)
    return free & free[0]


@eqx.filter_jit
def _changes(problem: Problem, state: State) -> tuple[Float[Array, " 3"], Array]:
    """Returns the largest change of a residual by each motion of the map, and
    the largest residual."""
    mask = mask_of(problem)

    def residuals(moved: State) -> Array:
        step = jax.tree.map(jnp.multiply, mask, state.local(moved))
        there = state.retract(step)
        parts = [residual_of(f, there).reshape(-1) for f in problem.factors]
        return jnp.concatenate(parts)

    dtype = state.scale.dtype
    shift, turn = (
        jnp.asarray(_TEST_TRANSLATION, dtype),
        so3.exp(jnp.asarray(_TEST_ROTATION_RAD, dtype)),
    )
    centre = state.cameras[:, :3, 3]

    def placed(rotation, r):
        top = jnp.concatenate([rotation, r[..., None]], axis=-1)
        return jnp.concatenate([top, state.cameras[:, 3:]], axis=1)

    C = state.cameras[:, :3, :3]
    ways = [
        (placed(C, centre + shift), state.landmarks + shift, state.scale),
        (placed(turn @ C, centre @ turn.T), state.landmarks @ turn.T, state.scale),
        (
            placed(C, _TEST_SCALE * centre),
            _TEST_SCALE * state.landmarks,
            state.scale / _TEST_SCALE,
        ),
    ]
    before = residuals(state)
    change = []
    for cameras, landmarks, scale in ways:
        moved = dataclasses.replace(
            state, cameras=cameras, landmarks=landmarks, scale=scale
        )
        change.append(jnp.max(jnp.abs(residuals(moved) - before), initial=0.0))
    return jnp.stack(change), jnp.max(jnp.abs(before), initial=0.0)
