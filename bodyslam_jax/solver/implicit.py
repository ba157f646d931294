"""Derivatives of a solution, by the implicit function theorem.

At a solution x*(p) the gradient `F(δ, p)` of the cost is 0, so for a cotangent v on the
solution the cotangent on p is `-(∂F/∂p)^T λ` with `(∂F/∂δ)^T λ = v`. The true second
derivative of the robust cost is used (Gauss-Newton's would be wrong wherever residuals
are not 0), solved for by GMRES with the structured factorisation as preconditioner: a
few products. Nothing is unrolled. Predictions of the motion model are held when F is
taken, as the solver holds them, but they move with x and p when F is differentiated.
Where GMRES does not converge the derivative is NaN: the equations are as good as
singular, or the state is no minimum.

`gmres` is Saad and Schultz, GMRES (1986); it traces its operator once, and reports
failure to converge. JAX's own does neither: it traces the operator seven times, which
takes as much longer to compile, and returns no residual.
"""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy as jsp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from bodyslam_jax.geometry.lengths import is_alone, is_traced
from bodyslam_jax.graph import LandmarkPrior, Problem, Reprojection, State, Step
from bodyslam_jax.solver.batching import sequential_vmap
from bodyslam_jax.solver.blocks import (
    Linearisation,
    Sizes,
    from_turns,
    globals_of,
    mask_of,
    sizes_of,
    to_turns,
)
from bodyslam_jax.solver.compilation import compiled, in_full_precision
from bodyslam_jax.solver.linear_system import (
    Move,
    damped,
    diagonals,
    eliminate,
    solve_step,
)
from bodyslam_jax.solver.linearise import linearise
from bodyslam_jax.solver.linearise.landmark import gather

_PRECONDITIONER_DAMPING = {"float64": 1e-9, "float32": 1e-5}
"""Marquardt's damping of the preconditioner, by precision."""
_RTOL = {"float64": 1e-10, "float32": 1e-5}
"""Relative residual at which GMRES ends, by precision."""
MAX_DIRECTIONS = 100
"""Maximum number of directions in a cycle. Every outlier changes the curvature in
another direction, and each has to be among them: with 20 at a time a path of 120 frames
did not converge."""
MAX_CYCLES = 2
"""Maximum number of cycles of `MAX_DIRECTIONS`."""
MAX_RELATIVE_ERROR = 1e-3
"""Share of the first residual below which a solution counts as found; in most cases it
is far smaller."""


def cotangent_of_problem(problem: Problem, state: State, cotangent: State) -> Problem:
    """Pulls a cotangent on the solution back to all arrays of the (padded) problem."""
    given = problem, state, cotangent
    if is_traced(given):
        return sequential_vmap(_program(False), _program(True))(*given)
    return _program(is_alone())(*given)


@functools.cache
def _program(alone: bool) -> Callable[..., Problem]:
    if alone:
        return compiled(_cotangent_of_problem)
    return eqx.filter_jit(_cotangent_of_problem)


@in_full_precision
def _cotangent_of_problem(problem, state, cotangent):
    problem = _without_single_views(problem)
    zero = state.zero_step()
    lin = normal_equations(problem, state)
    diagonal = diagonal_of(problem, state, lin)
    masks = coordinates_of(problem, mask_of(problem))
    if problem.basis is not None:
        masks["poses"] = jnp.ones_like(diagonal["poses"])
    mask = jax.tree.map(lambda m, d: jnp.where(d > 0, m, 0.0), masks, diagonal)
    # In units of standard deviations: in metres and radians, poorly observed points
    # would dominate the residual of GMRES.
    unit = jax.tree.map(lambda d: jax.lax.rsqrt(jnp.where(d > 0, d, 1.0)), diagonal)
    masked = lambda x: jax.tree.map(lambda m, s: m * s, mask, x)
    _, pull = jax.vjp(state.retract, zero)
    (right,) = pull(cotangent)
    right = masked(coordinates_of(problem, right))
    arrays, static = eqx.partition(problem, eqx.is_inexact_array)

    def gradient(step, arrays):
        whole: Problem = eqx.combine(arrays, static)
        moved = state.retract(step)
        seen = whole.predict(moved, frozen=False)
        fixed = whole.with_prediction(seen)

        # In the chart at the moved state, where the solver holds single coordinates: in
        # the chart at another state they are others, and their gradient is not 0.
        def cost(d):
            return fixed.cost(moved.retract(d), held=True)

        return jax.grad(cost)(zero)

    _, transpose = jax.vjp(gradient, zero, arrays)
    precondition = normal_solver(problem, state, lin)
    flat, unravel = ravel_pytree(right)
    scale, _ = ravel_pytree(unit)

    def left_of(scaled, share):
        x = unravel(scaled * scale)
        product, _ = transpose(step_of(problem, masked(x)))
        # The equation of a held coordinate is the identity.
        image = jax.tree.map(
            lambda b, m, p, x: share * b - jnp.where(m > 0, m * p, x),
            *(right, mask, coordinates_of(problem, product), x),
        )
        return ravel_pytree(precondition(image))[0] / scale

    adjoint = unravel(scale * gmres(left_of, flat, _RTOL[flat.dtype.name]))
    adjoint = step_of(problem, masked(adjoint))
    _, result = transpose(jax.tree.map(jnp.negative, adjoint))
    return result


def _without_single_views(problem: Problem) -> Problem:
    """Drops observations of landmarks seen once: they say nothing about the rest, and
    leave the landmark's depth, and so the linear system, without a solution.

    Those of landmarks that are held, or have a prior, stay: they locate the cameras.
    """
    factors = list(problem.factors)
    alone = jnp.all(mask_of(problem).landmarks > 0, axis=-1)
    for factor in factors:
        if isinstance(factor, LandmarkPrior):
            alone &= ~jnp.any(factor.whitening != 0, axis=(-2, -1))
    for i, factor in enumerate(factors):
        if isinstance(factor, Reprojection):
            seen = jnp.isfinite(factor.sigma)
            count = jnp.zeros(problem.free.landmarks.shape[0], jnp.int32)
            count = count.at[factor.landmark].add(seen.astype(jnp.int32))
            once = ((count < 2) & alone)[factor.landmark]
            sigma = jnp.where(once, jnp.inf, factor.sigma)
            factors[i] = eqx.tree_at(lambda f: f.sigma, factor, sigma)
    return eqx.tree_at(lambda p: p.factors, problem, tuple(factors))


Coordinates = dict[str, Array]
"""Arrays of a step by name, with postures in the coordinates that the solver moves
(`blocks.py`)."""


def coordinates_of(problem: Problem, slope: Step) -> Coordinates:
    """Converts a gradient with respect to a step into one by coordinates."""
    return {**vars(slope), "poses": from_turns(problem, slope.poses)}


def step_of(problem: Problem, x: Coordinates) -> Step:
    """Returns the step that has these coordinates."""
    return Step(**{**x, "poses": to_turns(problem, x["poses"])})


def normal_equations(problem: Problem, state: State) -> Linearisation:
    """Returns the normal equations, with the motion predicted at `state`."""
    problem = problem.refresh(state)
    return linearise(problem, gather(problem), state)


def diagonal_of(problem: Problem, state: State, lin: Linearisation) -> Coordinates:
    """Returns the diagonal of `J^T J`: 0 for coordinates that no measurement sees."""
    sizes = sizes_of(problem, state)
    diagonal = diagonals(lin, sizes)
    zero = state.zero_step()
    count = sizes.intrinsics
    landmarks = zero.landmarks
    for bucket, own in zip(problem.layout.buckets, diagonal["landmarks"], strict=True):
        moved = jnp.moveaxis(own, 1, 2)
        landmarks = landmarks.at[bucket.landmark].set(moved, mode="drop")
    none = jnp.zeros((*zero.poses.shape[:2], sizes.posture), state.scale.dtype)
    return dict(
        scale=diagonal["globals"][0],
        cameras=diagonal["camera"],
        roots=diagonal["root"],
        poses=diagonal.get("pose", none),
        shapes=diagonal["globals"][sizes.common :].reshape(zero.shapes.shape),
        landmarks=landmarks,
        intrinsics=diagonal["globals"][1 : 1 + count] if count else zero.intrinsics,
        globals=diagonal["globals"][1 + count : sizes.common]
        if sizes.named
        else zero.globals,
    )


def normal_solver(
    problem: Problem, state: State, lin: Linearisation
) -> Callable[[Coordinates], Coordinates]:
    """Returns `v -> (J^T J)^-1 v`, barely damped, by the solver's own elimination."""
    sizes = sizes_of(problem, state)
    little = jnp.asarray(
        _PRECONDITIONER_DAMPING[state.scale.dtype.name], state.scale.dtype
    )
    damping = damped(diagonals(lin, sizes), little)

    def apply(right: Coordinates) -> Coordinates:
        down = jax.tree.map(jnp.negative, right)
        move = Move(step_of(problem, down), down["poses"])
        there = _with_gradient(problem, lin, sizes, move)
        eliminated = eliminate(problem, there, sizes, damping)
        found = solve_step(problem, state, there, sizes, eliminated)
        return {**vars(found.step), "poses": found.postures}

    return apply


def _with_gradient(
    problem: Problem, lin: Linearisation, sizes: Sizes, move: Move
) -> Linearisation:
    """Returns the same blocks of `J^T J` with the gradient `move`.

    The implicit derivative solves the normal equations for such right-hand sides.
    """
    step, gradient = move.step, {}
    for name, known in lin.gradient.items():
        if name == "pose":
            gradient[name] = move.postures
        elif name == "root":
            gradient[name] = step.roots
        else:
            gradient[name] = jnp.zeros_like(known)
    if "camera_alone" in gradient:
        gradient["camera_alone"] = step.cameras
    elif "camera" in gradient:
        gradient["camera"] = gradient["camera"].at[0].set(step.cameras)
    common = globals_of(step, sizes)
    # Indices of padding are those of a row of zeros, so that a plain gather suffices.
    tables = tuple(
        eqx.tree_at(
            lambda t: t.gradient,
            table,
            jnp.moveaxis(step.landmarks[bucket.landmark], 1, 2),
        )
        for bucket, table in zip(problem.layout.buckets, lin.landmarks, strict=True)
    )
    names = "gradient", "globals_gradient", "landmarks"
    return eqx.tree_at(
        lambda lin: [getattr(lin, name) for name in names],
        lin,
        [gradient, common, tables],
    )


class _Search(eqx.Module):
    """State between two passes: one for the residual, then one for each direction."""

    x: Float[Array, " n"]
    basis: Float[Array, "k n"]
    table: Float[Array, "k j"]
    """Hessenberg matrix: the operator's image of each direction, in terms of all."""
    length: Float[Array, ""]
    """Length of the residual when the cycle began."""
    whole: Float[Array, ""]
    """Length of the residual when the first cycle began."""
    known: Int[Array, ""]
    """Number of directions in this cycle."""
    cycle: Int[Array, ""]
    ended: Bool[Array, ""]


def gmres(
    left_of: Callable[[Array, Array], Array], like: Float[Array, " n"], rtol: float
) -> Float[Array, " n"]:
    """Returns the `x` of `A x = b`, or NaN if it was not found.

    `left_of(x, share)` is `M (share b - A x)`, where the preconditioner `M` is about
    the inverse of `A`: the residual is then about the error of `x`, whose coordinates
    should be of one unit. The iteration ends where the residual is `rtol` of the first
    one, or does not halve in a cycle, as at the level of rounding; `x` counts as found
    below `MAX_RELATIVE_ERROR` of the first one.
    """
    zero = jnp.zeros_like(like, shape=())
    # Columns of unknown directions are unit vectors, so that their coefficients are 0.
    none = jnp.eye(MAX_DIRECTIONS + 1, MAX_DIRECTIONS, -1, dtype=like.dtype)
    start = _Search(
        x=jnp.zeros_like(like),
        basis=jnp.zeros_like(like, shape=(MAX_DIRECTIONS + 1, like.size)),
        table=none,
        length=zero,
        whole=zero,
        known=jnp.array(0),
        cycle=jnp.array(0),
        ended=jnp.array(False),
    )

    def one(s: _Search) -> _Search:
        first = s.known == 0
        at = s.known - 1
        share = first.astype(like.dtype)
        given = jnp.where(first, s.x, s.basis[at])
        image = left_of(given, share) * (2 * share - 1)
        basis = jnp.where(first, 0.0, s.basis)
        # Orthogonalised twice: once leaves too much of the other directions.
        parts = basis @ image
        image = image - parts @ basis
        more = basis @ image
        image, parts = image - more @ basis, parts + more
        size = jnp.linalg.norm(image)
        unit = image / jnp.where(size > 0, size, 1.0)
        column = parts.at[s.known].set(size)
        table = jnp.where(first, none, s.table.at[:, at].set(column))
        length = jnp.where(first, size, s.length)
        whole = jnp.where(first & (s.cycle == 0), size, s.whole)
        target = jnp.zeros_like(column).at[0].set(length)
        q, r = jnp.linalg.qr(table)
        shares = jsp.linalg.solve_triangular(r, target @ q)
        left = jnp.linalg.norm(table @ shares - target)
        full = ~first & ((s.known == MAX_DIRECTIONS) | ~(left > rtol * whole))
        stalls = (s.cycle > 0) & ~(size < 0.5 * s.length)
        over = ~(size > rtol * whole) | stalls | (s.cycle == MAX_CYCLES)
        return _Search(
            x=jnp.where(full, s.x + shares @ basis[:-1], s.x),
            basis=basis.at[s.known].set(unit),
            table=table,
            length=length,
            whole=whole,
            known=jnp.where(full, 0, s.known + 1),
            cycle=jnp.where(full, s.cycle + 1, s.cycle),
            ended=first & over,
        )

    found = jax.lax.while_loop(lambda s: ~s.ended, one, start)
    return jnp.where(found.length <= MAX_RELATIVE_ERROR * found.whole, found.x, jnp.nan)
