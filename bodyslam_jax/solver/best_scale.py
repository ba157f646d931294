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
from jaxtyping import Array, Float

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

_STEPS = 20
"""Of the search, at most: one for squared losses, some for robust ones."""
_AROUND = tuple(2.0 ** (k / 2) for k in range(-10, 11))
"""Where robust losses may have several minima, as shares of the s of least squares:
between 1/32 and 32 of it, in steps that are narrower than what robust losses of sizes
known to some ten per cent leave between two minima."""
WORTH = 0.005
"""Decrease of the cost, a negative log-likelihood, from which another s is better."""


class _Model(NamedTuple):
    """The terms that see s, at one s."""

    cost: Float[Array, ""]
    step: Float[Array, ""]
    """To the minimum of the squares, weighted by the robust losses."""
    plain: Float[Array, ""]
    """To the minimum of the squares, each with weight 1."""


def at_best_scale(problem: Problem, state: State) -> tuple[State, Float[Array, ""]]:
    """The state with the s of least cost given all else, and by how much less.

    The motion model's prediction is that in `problem`. A held scale stays, and so does
    one that no other is better than.
    """
    sees = _factors_of_scale(problem)
    none = jnp.zeros_like(state.scale)
    if not sees:
        return state, none
    start = _model(sees, state, state.scale)
    first = start.plain
    if not is_quadratic(problem):
        around = state.scale + start.plain
        grid = jnp.append(around * jnp.asarray(_AROUND, none.dtype), state.scale)
        costs = jax.lax.map(lambda s: _model(sees, state, s).cost, grid)
        costs = jnp.where(jnp.isfinite(costs), costs, jnp.inf)
        first = grid[jnp.argmin(costs)] - state.scale
    eps = float(jnp.finfo(state.scale.dtype).eps)

    def goes_on(carry):
        count, _, step, scale = carry
        return (count < _STEPS) & (jnp.abs(step) > 4 * eps * jnp.abs(scale))

    def once(carry):
        count, _, step, scale = carry
        moved = scale + step
        there = _model(sees, state, moved)
        return count + 1, there.cost, there.step, moved

    begin = jnp.array(0), start.cost, first, state.scale
    _, cost, _, scale = jax.lax.while_loop(goes_on, once, begin)
    better = (problem.free.scale > 0) & (cost < start.cost)
    scale = jnp.where(better, scale, state.scale)
    gain = jnp.where(better, start.cost - cost, none)
    return dataclasses.replace(state, scale=scale), gain


def is_quadratic(problem: Problem) -> bool:
    """Whether no factor that sees s has a robust loss, so that there is one best s."""
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
    """The step to the minimum of a parabola; 0 if it is none."""
    seen = bend > 0
    step = -slope / jnp.where(seen, bend, 1.0)
    return jnp.where(seen & jnp.isfinite(step), step, 0.0)
