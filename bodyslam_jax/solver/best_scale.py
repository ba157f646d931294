"""The scale s that is best where everything else stays, for the start of a solve.

People are anchored in the camera, so residuals are linear in s, and how wrong a start's
s is says nothing of the rest. The best s for the given people is found here in one step
from anywhere, or, where a factor that sees s has a robust loss, as the best of several.
Were s and people moved together from an s that is off by ten times, people would be
moved to suit it first, and solves from several starts would end apart by what the last
step leaves, or in several minima.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from bodyslam_jax.graph import (
    Factor,
    FrameFactor,
    MarginalPrior,
    Problem,
    Squared,
    State,
    residual_of,
    squared_norm,
)

_MAX_NEWTON_STEPS = 20
"""Maximum number of Newton steps: one suffices for squared losses."""
_SCALE_GRID = tuple(2.0 ** (k / 2) for k in range(-10, 11))
"""Starts for robust losses, which may have several minima, as shares of the s of least
squares: between 1/32 and 32 of it, in steps narrower than the distance of two minima
where sizes are known to some ten per cent."""
MIN_SCALE_COST_DECREASE = 0.005
"""Least decrease of the cost (negative log-likelihood) that makes another s better."""


class _Model(NamedTuple):
    """Cost and Newton steps, at one s, of the factors that depend on s."""

    cost: Float[Array, ""]
    step: Float[Array, ""]
    """Step to the minimum of the squares, weighted by the robust losses."""
    plain: Float[Array, ""]
    """Step to the minimum of the squares, each with weight 1."""


class _Search(NamedTuple):
    """State of the search for s."""

    looked: Int[Array, ""]
    """Number of s that were evaluated."""
    scale: Float[Array, ""]
    """The s to be evaluated next."""
    last: Float[Array, ""]
    """The s evaluated before, with its `step` and `cost`."""
    step: Float[Array, ""]
    cost: Float[Array, ""]
    start: Float[Array, ""]
    """Cost at the first s."""
    around: Float[Array, ""]
    """The s of least squares, at the centre of the grid."""
    least: Float[Array, ""]
    """Cost of the `best` so far."""
    best: Float[Array, ""]


def best_scale(
    problem: Problem, state: State, free: Bool[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Returns the s of least cost given all else, and the decrease of the cost.

    The motion model's prediction is that in `problem`. The scale of `state` is returned
    where it is not `free`, and where no other is better.
    """
    sees = _factors_of_scale(problem)
    none = jnp.zeros_like(state.scale)
    if not sees or "scale" not in problem.variables:
        return state.scale, none
    grid = jnp.asarray(() if is_quadratic(problem) else _SCALE_GRID, none.dtype)
    eps = float(jnp.finfo(none.dtype).eps)
    # The start, the grid, and Newton's steps from the best of these are one loop, so
    # that the model is compiled once.
    known = 1 + len(grid)

    def goes_on(search: _Search):
        small = jnp.abs(search.step) <= 4 * eps * jnp.abs(search.last)
        return (search.looked < known + _MAX_NEWTON_STEPS) & (
            (search.looked < known) | ~small
        )

    def once(search: _Search):
        count, scale = search.looked, search.scale
        there = _model(sees, state, scale)
        first = count == 0
        around = jnp.where(first, scale + there.plain, search.around)
        cost = jnp.where(jnp.isfinite(there.cost), there.cost, jnp.inf)
        lower = cost < search.least
        least = jnp.where(lower, cost, search.least)
        best = jnp.where(lower, scale, search.best)
        step, following = there.step, scale + there.step
        if len(grid):
            named = jnp.append(around * grid, best)[jnp.minimum(count, len(grid))]
            following = jnp.where(count <= len(grid), named, following)
            step = jnp.where(count <= len(grid), jnp.inf, step)
        start = jnp.where(first, there.cost, search.start)
        return _Search(
            count + 1, following, scale, step, there.cost, start, around, least, best
        )

    infinite = jnp.full_like(none, jnp.inf)
    begin = _Search(
        jnp.array(0), state.scale, none, infinite, none, none, none, infinite, none
    )
    found = jax.lax.while_loop(goes_on, once, begin)
    better = free & (found.cost < found.start)
    gain = jnp.where(better, found.start - found.cost, none)
    return jnp.where(better, found.last, state.scale), gain


def is_quadratic(problem: Problem) -> bool:
    """Returns True if no factor that depends on s is robust: s is unique then."""
    return all(isinstance(f.loss, Squared) for f in _factors_of_scale(problem))


def _factors_of_scale(problem: Problem) -> list[Factor]:
    return [factor for factor in problem.factors if _sees_scale(factor)]


def _sees_scale(factor: Factor) -> bool:
    if isinstance(factor, FrameFactor):
        return ("scale", 0) in factor.keys
    return isinstance(factor, MarginalPrior)


def _model(factors: list[Factor], state: State, scale: Float[Array, ""]) -> _Model:
    def residuals(s):
        there = dataclasses.replace(state, scale=s)
        return [residual_of(factor, there) for factor in factors]

    found, slopes = jax.jvp(residuals, (scale,), (jnp.ones_like(scale),))
    zero = jnp.zeros_like(scale)
    cost, sums = zero, [zero] * 4
    for factor, r, by_scale in zip(factors, found, slopes, strict=True):
        square = squared_norm(r)
        along, bend = jnp.sum(r * by_scale, axis=-1), squared_norm(by_scale)
        cost = cost + 0.5 * jnp.sum(factor.loss.rho(square))
        weight = factor.loss.weight(square)
        parts = weight * along, weight * bend, along, bend
        sums = [total + jnp.sum(part) for total, part in zip(sums, parts, strict=True)]
    return _Model(cost, _newton(*sums[:2]), _newton(*sums[2:]))


def _newton(slope: Float[Array, ""], bend: Float[Array, ""]) -> Float[Array, ""]:
    """Returns the step to the minimum of a parabola; 0 if it has none."""
    seen = bend > 0
    step = -slope / jnp.where(seen, bend, 1.0)
    return jnp.where(seen & jnp.isfinite(step), step, 0.0)
