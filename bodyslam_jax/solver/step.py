"""One damped step, tried on the true robust cost; the damping after it.

Marquardt's damping, in proportion to each variable's own curvature, with Nielsen's
update. Landmarks whose cost the step would have increased are damped individually.

A line search (`search`) then follows the step on the true robust cost. It rejects the
updates of landmarks whose cost they would increase, so that a few bad points do not
hold up the step of all others.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from bodyslam_jax.graph import Problem, Reprojection, State
from bodyslam_jax.solver.blocks import Linearisation, Sizes
from bodyslam_jax.solver.linear_system import (
    UNOBSERVED_DIAGONAL,
    Eliminated,
    along,
    damped,
    diagonals,
    eliminate,
    gradient_in_line,
    in_line,
    solve_step,
)
from bodyslam_jax.solver.retriangulation import cost_by_landmark, tracks_of

MIN_GAIN_RATIO = 1e-4
"""Least ratio of actual to predicted decrease at which a step is accepted."""
LANDMARK_DAMPING_RANGE = (1e-2, 1e4)
"""Least and greatest damping of a landmark whose cost a step would have increased."""
MIN_DAMPING_FACTOR = 0.1
"""Least factor by which a good step lowers the damping (Nielsen)."""
FAILED_DAMPING_FACTOR = 10.0
"""Ratio of the least damping to one at which a factorisation failed: one step of
`MIN_DAMPING_FACTOR`, so that damping does not come back to it."""
MAX_LEAST_DAMPING = 1e-6
"""Greatest least damping. Equations that fail above it do so for another reason than
rounding, which is 6e-8 in single precision."""


class Trial(NamedTuple):
    """A trial step, with its true robust cost and whether it is accepted."""

    eliminated: Eliminated
    damping: Float[Array, ""]
    """Damping with which the step was computed."""
    length: Float[Array, ""]
    """Squared length of the step, in standard deviations: `δ^T diag(H) δ`."""
    predicted: Float[Array, ""]
    """Decrease of the cost that the quadratic model predicts."""
    finite: Bool[Array, ""]
    accepted: Bool[Array, ""]
    state: State
    """State after the step if it is accepted, else before it."""
    terms: Float[Array, " k"]
    """Cost by factor at `state`."""
    gain: Float[Array, ""]
    """Actual over predicted decrease of the full step."""
    landmark_damping: Float[Array, " l"]
    """Damping of individual landmarks for the next step."""

    def next_least(self, least: Float[Array, ""], dtype: Any) -> Float[Array, ""]:
        """Returns the least damping of later steps with factors of this precision: in
        single precision it is higher where rounding left the equations without a
        factorisation, so that they do not fail again."""
        if dtype == jnp.float64:
            return least
        failed = jnp.minimum(FAILED_DAMPING_FACTOR * self.damping, MAX_LEAST_DAMPING)
        return jnp.where(self.finite, least, jnp.maximum(least, failed))

    def next_damping(
        self, nu: Float[Array, ""], least: Float[Array, ""]
    ) -> Float[Array, ""]:
        """Returns the next damping: by Nielsen's factor, or `nu` times if rejected."""
        shrink = jnp.maximum(1 - (2 * self.gain - 1) ** 3, MIN_DAMPING_FACTOR)
        shrink = jnp.where(self.gain < 0.25, 2.0, shrink)
        lower = jnp.maximum(self.damping * shrink, least)
        return jnp.where(self.accepted, lower, jnp.maximum(self.damping, least) * nu)


def attempt(
    problem: Problem,
    state: State,
    lin: Linearisation,
    sizes: Sizes,
    damping: Float[Array, ""],
    landmark_damping: Float[Array, " l"],
    last: Bool[Array, ""],
) -> Trial:
    """Solves for a step and evaluates it; with `last` only
    factorises, barely damped."""
    damping = jnp.where(last, little(sizes.dtype), damping)
    diagonal = diagonals(lin, sizes)
    extra = damped(
        diagonal,
        damping,
        jnp.where(last, UNOBSERVED_DIAGONAL, 1.0).astype(damping.dtype),
    )
    least = jnp.where(last, 0.0, landmark_damping)
    extra["landmarks"] = tuple(
        jnp.maximum(more, least[bucket.landmark][:, None] * own)
        for more, own, bucket in zip(
            extra["landmarks"],
            diagonal["landmarks"],
            problem.layout.buckets,
            strict=True,
        )
    )
    eliminated = eliminate(problem, lin, sizes, extra)
    move = solve_step(problem, state, lin, sizes, eliminated)
    # In one vector each, as every sum of a group would be a loop to be compiled.
    moved = along(problem, sizes, move)
    line = lambda known: in_line(known, moved.dtype, move.postures)
    length = jnp.sum(line(diagonal) * moved**2)
    slope = -jnp.sum(gradient_in_line(lin, move) * moved)
    predicted = 0.5 * (jnp.sum(line(extra) * moved**2) + slope)
    finite = jnp.isfinite(predicted) & jnp.isfinite(length) & ~last
    move = jax.tree.map(lambda x: jnp.where(finite, x, 0.0), move)
    slope = jnp.where(finite, slope, 0.0)
    there, rejected, share, terms, gain = search(
        problem, state, move.step, slope, predicted, lin.costs
    )
    decrease = jnp.sum(lin.costs) - jnp.sum(terms)
    accepted = (
        finite & (predicted > 0) & (decrease > MIN_GAIN_RATIO * share * predicted)
    )
    more = jnp.clip(10 * landmark_damping, *LANDMARK_DAMPING_RANGE)
    after = jnp.where(rejected, more, 0.1 * landmark_damping)
    return Trial(
        eliminated=eliminated,
        damping=damping,
        length=length,
        predicted=predicted,
        finite=finite,
        accepted=accepted,
        state=jax.tree.map(lambda a, b: jnp.where(accepted, a, b), there, state),
        terms=jnp.where(accepted, terms, lin.costs),
        gain=gain,
        landmark_damping=jnp.where(accepted, after, landmark_damping),
    )


def least_damping(dtype) -> float:
    """Returns the least damping of a step, by the precision of the state.

    In double precision it is far below the stiffness of the softest bending mode of a
    long path of cameras, which falls with the fourth power of its length: 1e-10 of a
    camera's own at 1,000 frames. Factors in single precision follow nearly as far, as
    landmarks' own blocks have the precision of the state; where one fails,
    `Trial.next_least` raises the least damping. With a state in single precision it is
    the least that rounding leaves positive definite: with a tenth of it every third
    factorisation fails, and there are no fewer steps.
    """
    return 1e-12 if dtype == jnp.float64 else 3e-7


def little(dtype) -> float:
    """Returns the damping of the last factorisation, which keeps the variance of an
    undetermined direction finite, but enormous."""
    return 1e-11 if dtype == jnp.float64 else 1e-6


def search(problem, state, move, slope, predicted, terms):
    """Evaluates the full step and the minimum of a parabola through its cost.

    Robust losses have more curvature than `J^T J`, so that full steps overshoot to and
    fro. The second evaluation costs a few per cent of an iteration. Returns the better
    state, which landmarks rejected their update, the share of the step, the cost by
    factor there, and actual over predicted decrease of the full step.
    """
    known = jnp.sum(terms)

    def one(carry, _):
        share, place, rejected, best, best_terms, full = carry
        moved = state.retract(jax.tree.map(lambda x: share * x, move))
        moved, off, new = _settle(problem, state, moved)
        cost = jnp.sum(new)
        cost = jnp.where(jnp.isfinite(cost), cost, jnp.inf)
        better = cost < jnp.sum(best_terms)
        best = jnp.where(better, share, best)
        best_terms = jnp.where(better, new, best_terms)
        place = jax.tree.map(lambda a, b: jnp.where(better, a, b), moved, place)
        rejected = jnp.where(better, off, rejected)
        full = jnp.where(jnp.isnan(full), cost, full)
        # cost(a) = known - slope a + bend a^2, through the full step
        bend = full - known + slope
        vertex = slope / jnp.where(bend > 0, 2 * bend, 1.0)
        vertex = jnp.where(bend > 0, vertex, 2.0)
        share = jnp.clip(vertex, 0.1, 2.0)
        return (share, place, rejected, best, best_terms, full), None

    one_ = jnp.ones_like(known)
    none = jnp.zeros(len(state.landmarks), bool)
    start = (one_, state, none, one_, terms, jnp.nan * one_)
    found, _ = jax.lax.scan(one, start, length=2)
    _, place, rejected, best, best_terms, full = found
    gain = (known - full) / jnp.where(predicted > 0, predicted, 1.0)
    return place, rejected, best, best_terms, jnp.clip(gain, -1.0, 2.0)


def _settle(
    problem: Problem, state: State, moved: State
) -> tuple[State, Bool[Array, " l"], Float[Array, " k"]]:
    """Returns the moved state without those updates of landmarks that increase their
    cost, the mask of these landmarks, and the cost by factor.

    A point that few frames see, or that an outlier pulls, may be sent behind the
    cameras. Given the cameras, landmarks are independent: rejecting one does not affect
    the step of the others.
    """
    tracks = tracks_of(problem)
    keep = jnp.zeros(len(state.landmarks), bool)
    of_tracks = jnp.zeros_like(state.scale)
    if tracks is not None:
        # One `vmap` over both, so that cameras are gathered once for all observations.
        both = jnp.stack([state.landmarks, moved.landmarks])
        at = lambda x: eqx.tree_at(lambda s: s.landmarks, moved, x)
        found = jax.vmap(lambda x: cost_by_landmark(problem, tracks, at(x)))(both)
        here, there = zip(*found, strict=True)
        keep = ~(there[0] + there[1] <= here[0] + here[1])
        landmarks = jnp.where(keep[:, None], state.landmarks, moved.landmarks)
        moved = eqx.tree_at(lambda s: s.landmarks, moved, landmarks)
        of_tracks = 0.5 * jnp.sum(jnp.where(keep, here[0], there[0]))
    costs = [
        of_tracks if isinstance(f, Reprojection) else f.cost(moved)
        for f in problem.factors
    ]
    return moved, keep, jnp.stack(costs)
