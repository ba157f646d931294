"""The oldest frames of a problem as a Gaussian prior on what is left of it.

The measurements are split: `old` are those of the first frames and of all landmarks
that these frames observe, `rest` are the others. With the normal equations `H δ = -g`
of `old` at a state, E the variables of the oldest frames and landmarks, and R all
others that `old` depends on,

    Λ = H_RR - H_RE H_EE^-1 H_ER,    η = g_R - H_RE H_EE^-1 g_E,

and `½ δ_R^T Λ δ_R + η^T δ_R` is, up to a constant, the least cost of `old` over E: to
second order, and exactly where residuals are linear and losses squared. `H_EE^-1` is
the solver's own elimination with R held constant, one right-hand side for each
coordinate in R; so any factor that the solver takes may be in `old`. A fixed-lag
smoother that adds this prior to `rest` loses nothing but the relinearisation of E
(Sibley, Matthies, Sukhatme, Sliding window filter with application to planetary
landing, 2010).

R has the cameras, roots and poses of the last old frames that factors of later frames
reach back to, the cameras that observe old landmarks, and scale, shapes, intrinsics.
"""

import dataclasses
import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int

from bodyslam_jax.geometry.lengths import padded_rows
from bodyslam_jax.graph import (
    Factor,
    FrameFactor,
    LandmarkPrior,
    Problem,
    Reprojection,
    State,
    Step,
)
from bodyslam_jax.graph.padding import Masked
from bodyslam_jax.solver.blocks import mask_of
from bodyslam_jax.solver.compilation import compiled, in_full_precision
from bodyslam_jax.solver.implicit import diagonal_of, normal_solver
from bodyslam_jax.solver.levenberg_marquardt import lifted
from bodyslam_jax.solver.padding import pad
from bodyslam_jax.solver.solve import check_start

_REFINEMENTS = 2
"""Of each solution by `H_EE^-1`, which is hardly damped: to rounding."""


_GRADIENT, _NONE = -1, -2
"""In place of the number of a coordinate."""


class MarginalPrior(eqx.Module):
    """`½ δ^T Λ δ + η^T δ` for a step δ from the state where it was linearised."""

    information: Float[Array, "n n"]
    """Λ"""
    slope: Float[Array, " n"]
    """η"""
    coordinates: Int[Array, " n"]
    """Where R stands in a flattened `Step` of the problem (`ravel_pytree`)."""

    def cost(self, step: Step) -> Float[Array, ""]:
        """The cost of a step, less that of none: zero for the zero step."""
        moved = ravel_pytree(step)[0][self.coordinates]
        return moved @ (self.slope + 0.5 * self.information @ moved)


def marginalise(
    problem: Problem, state: State, frames: int
) -> tuple[MarginalPrior, Problem]:
    """The prior that the first `frames` frames leave, and the problem without them.

    The problem that is left has the same shapes: its old measurements have no weight,
    and the variables that were marginalised are held constant. Predictions of the
    motion model are those at `state`, and stay so in the prior.

    Not for use within `jit`: the number of coordinates depends on the tracks. Takes one
    elimination of the old frames for each of them.

    **Raises:** `ValueError` if `frames` is not between 1 and the number of frames less
    1, or if `state` does not fit the problem, as `solve` does.
    """
    check_start(problem, state)
    count = len(state.cameras)
    if not 0 < frames < count:
        raise ValueError(f"frames: {frames}, expected 1 to {count - 1}.")
    problem = problem.refresh(state)
    observed = _observed_landmarks(problem, frames)
    old, rest = (_split(problem, frames, observed, kept) for kept in (True, False))
    gone = _marginalised(problem, frames, observed)
    padded, start = pad(old, state)
    eliminated = eqx.tree_at(lambda p: p.free, old, gone)
    eliminated, _ = pad(eliminated, state)
    touched = _touched(padded, start, mask_of(eliminated))
    place = np.flatnonzero(ravel_pytree(touched)[0])
    columns = np.full(padded_rows(len(place) + 1), _NONE)
    columns[: len(place) + 1] = *place, _GRADIENT
    rows = _program()(padded, eliminated, start, jnp.asarray(columns))
    reduced = rows[: len(place) + 1, place]
    information, slope = reduced[:-1], reduced[-1]
    left = jax.tree.map(lambda free, old: free * (1 - old), mask_of(rest), gone)
    prior = MarginalPrior(
        information=(information + information.T) / 2,
        slope=slope,
        coordinates=jnp.asarray(np.flatnonzero(_of_size(touched, state))),
    )
    return prior, eqx.tree_at(lambda p: p.free, rest, left)


def _of_size(step: Step, state: State) -> np.ndarray:
    """A padded step cut to the sizes of a state, flattened."""
    t, l = len(state.cameras), len(state.landmarks)
    cut = dataclasses.replace(
        step,
        cameras=step.cameras[:t],
        roots=step.roots[:, :t],
        poses=step.poses[:, :t],
        landmarks=step.landmarks[:l],
    )
    return np.asarray(ravel_pytree(cut)[0])


def _observed_landmarks(problem: Problem, frames: int) -> Bool[np.ndarray, " l"]:
    """Landmarks with an observation in the first frames."""
    observed = np.zeros(len(problem.free.landmarks), bool)
    for factor in problem.factors:
        if isinstance(factor, Reprojection):
            early = np.asarray(factor.frame) < frames
            early &= np.isfinite(np.asarray(factor.sigma))
            observed[np.asarray(factor.landmark)[early]] = True
    return observed


def _split(
    problem: Problem, frames: int, observed: Bool[np.ndarray, " l"], old: bool
) -> Problem:
    """The problem with the old measurements alone, or with the others alone.

    Measurements of scale, shapes or intrinsics alone are none of the old ones.
    """
    early = np.arange(len(problem.free.cameras)) < frames
    chosen = [f for f in problem.factors if not (old and _is_once(f))]
    people = len(problem.free.roots)
    factors = tuple(_part(f, early, observed, people, old) for f in chosen)
    return dataclasses.replace(problem, factors=factors)


def _is_once(factor: Factor) -> bool:
    return isinstance(factor, FrameFactor) and factor.once


def _part(
    factor: Factor,
    early: Bool[np.ndarray, " t"],
    observed: Bool[np.ndarray, " l"],
    people: int,
    old: bool,
) -> Factor:
    if isinstance(factor, Reprojection):
        kept = jnp.asarray(observed == old)[factor.landmark]
        return _filled(factor, "sigma", kept, jnp.inf)
    if isinstance(factor, LandmarkPrior):
        return _filled(factor, "whitening", jnp.asarray(observed == old), 0.0)
    if isinstance(factor, FrameFactor) and not factor.once:
        kept = jnp.asarray(early == old)
        if not factor.padding or factor.num_lags > 1:
            # A row may weigh the residual of the row before it, whose measurement
            # must therefore stay.
            shape = (people, len(kept)) if factor.of_people else kept.shape
            return Masked(factor=factor, present=jnp.broadcast_to(kept, shape))
        axis = 1 if factor.of_people else 0
        for name, value in factor.padding.items():
            factor = _filled(factor, name, kept, value, axis)
        return factor
    return factor


def _filled(factor, name, kept, value, axis=0):
    """The factor with `value` where an array is not kept along an axis."""
    array = getattr(factor, name)
    shape = [1] * array.ndim
    shape[axis] = len(kept)
    filled = jnp.where(kept.reshape(shape), array, jnp.asarray(value, array.dtype))
    return eqx.tree_at(lambda f: getattr(f, name), factor, filled)


def _marginalised(
    problem: Problem, frames: int, observed: Bool[np.ndarray, " l"]
) -> Step:
    """1 for the free coordinates in E."""
    lags = [f.num_lags - 1 for f in problem.factors if isinstance(f, FrameFactor)]
    mask = mask_of(problem)
    early = np.arange(len(mask.cameras)) < frames - max(lags, default=0)
    early, seen = (jnp.asarray(x, mask.cameras.dtype) for x in (early, observed))
    none = jax.tree.map(jnp.zeros_like, mask)
    return dataclasses.replace(
        none,
        cameras=mask.cameras * early[:, None],
        roots=mask.roots * early[:, None],
        poses=mask.poses * early[:, None, None],
        landmarks=mask.landmarks * seen[:, None],
    )


@eqx.filter_jit
def _touched(problem: Problem, state: State, gone: Step) -> Step:
    """1 for the coordinates in R: free, measured, and not in E."""
    pairs = mask_of(problem), diagonal_of(problem, state), gone
    return jax.tree.map(
        lambda free, d, e: jnp.where((d > 0) & (e == 0), free, 0.0), *pairs
    )


@functools.cache
def _program() -> Callable[..., Array]:
    return compiled(_reduced)


@in_full_precision
def _reduced(
    problem: Problem, eliminated: Problem, state: State, columns: Int[Array, " n"]
) -> Float[Array, "n m"]:
    """Rows of `H - H_E H_EE^-1 H_E^T` for some coordinates, and the gradient's."""
    gone = mask_of(eliminated)
    free = mask_of(problem)
    masked = functools.partial(jax.tree.map, jnp.multiply)

    def residual(step):
        return lifted(state.retract(masked(free, step)), problem)

    found, along = jax.linearize(residual, state.zero_step())
    transpose = jax.linear_transpose(along, state.zero_step())
    product = lambda step: transpose(along(step))[0]
    solve = normal_solver(eliminated, state)

    def refined(_, given):
        image, moved = given
        wrong = jax.tree.map(jnp.subtract, image, product(moved))
        more = masked(gone, solve(masked(gone, wrong)))
        return image, jax.tree.map(jnp.add, moved, more)

    flat, unravel = ravel_pytree(state.zero_step())
    gradient = transpose(found)[0]

    def without_gone(k):
        """A column of H, or the gradient, less what E explains of it."""
        unit = flat.at[k].set(jnp.where(k >= 0, 1.0, 0.0))
        image = jax.tree.map(
            lambda column, slope: jnp.where(k == _GRADIENT, slope, column),
            *(product(unravel(unit)), gradient),
        )
        start = image, state.zero_step()
        _, moved = jax.lax.fori_loop(0, _REFINEMENTS + 1, refined, start)
        return ravel_pytree(jax.tree.map(jnp.subtract, image, product(moved)))[0]

    return jax.lax.map(without_gone, columns)
