"""Levenberg-Marquardt on the factor graph, in optimistix's loop.

Marquardt's damping (in proportion to each variable's own curvature, as units here mix
m, rad and shape) with Nielsen's update; steps are accepted on the true robust cost. The
linearisation is kept after a rejected step. The motion model's prediction is frozen
within a step and made anew after each accepted one.

The stages of a schedule are phases of one loop, and differ by a mask: what they do is
compiled once, and so is what covariances need of the last linearisation.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from bodyslam_jax.graph import (
    VARIABLES,
    Problem,
    Reprojection,
    State,
    Step,
    lift,
    residual_of,
)
from bodyslam_jax.solver._blocks import Linearisation, Observations, sizes_of
from bodyslam_jax.solver._chunks import Factor
from bodyslam_jax.solver._linearise import linearise
from bodyslam_jax.solver._normal import damped, diagonals, eliminate, solve_step
from bodyslam_jax.solver._tables import gather

GAIN = 1e-4
"""Least share of the predicted decrease at which a step is accepted."""
MAX_DAMPING = 1e12
CAUTION = (1e-2, 1e4)
"""Least and greatest damping of a landmark that a step would have thrown off."""
SHRINK = 0.1
"""Least factor of the damping after a good step."""


class History(eqx.Module):
    """One entry an iteration, of which the first `num_steps` are filled."""

    cost: Float[Array, "*s _"]
    """Before each iteration, and after the last."""
    terms: Float[Array, "*s _ k"]
    """By factor, in the order of the problem."""
    damping: Float[Array, "*s n"]
    step: Float[Array, "*s n"]
    """Length of the step in standard deviations: `sqrt(δ^T diag(H) δ)`."""
    accepted: Bool[Array, "*s n"]


class Final(eqx.Module):
    """The normal equations where the solver stopped, hardly damped, factorised."""

    lin: Linearisation
    factor: Factor


class _Loop(eqx.Module):
    stage: Int[Array, ""]
    """That runs now; the number of stages while the last factorisation is made."""
    prediction: Any
    observations: Observations | None
    final: Final
    stale: Bool[Array, ""]
    """Whether `final.lin` is of an earlier state or stage."""
    damping: Float[Array, ""]
    caution: Float[Array, " l"]
    """Damping that landmarks have at least, each by itself."""
    growth: Float[Array, ""]
    cost: Float[Array, ""]
    first_cost: Float[Array, ""]
    steps: Int[Array, " s"]
    finished: Bool[Array, ""]
    result: optx.RESULTS
    history: History


class StructuredLevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """The structured solver; `y` is a `State`, `args` a padded `Problem`.

    All settings but the length of the history are arrays, so that one compilation
    serves all schedules of as many stages.
    """

    free: Float[Array, "s v"]
    """1 for the groups among `VARIABLES` that a stage moves."""
    limit: Int[Array, " s"]
    """Steps at most; a stage with none is left out."""
    rtol: Float[Array, " s"]
    """A stage ends when an undisturbed step lowers the cost by less than this share."""
    damping: Float[Array, ""]
    """At the first step of a stage; 0 is Gauss-Newton, with step control left to
    `GAIN`."""
    keep: Bool[Array, ""]
    """Whether to factorise once more at the end, hardly damped, for covariances."""
    length: int = eqx.field(static=True)
    """Of the history."""
    atol: float = 0.0
    norm: Callable[..., Any] = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        dtype = y.scale.dtype
        s, n, k = len(self.limit), self.length, len(args.factors)
        observations = gather(args)
        # Filled in by the first step: each part is compiled once.
        struct = eqx.filter_eval_shape(_first, args, observations, y)
        empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), struct)
        stage = self._after(jnp.array(-1))
        return _Loop(
            stage=stage,
            prediction=empty[1],
            observations=observations,
            final=empty[0],
            stale=jnp.array(True),
            damping=jnp.asarray(self.damping, dtype),
            caution=jnp.zeros(len(y.landmarks), dtype),
            growth=jnp.asarray(2.0, dtype),
            cost=jnp.asarray(jnp.inf, dtype),
            first_cost=jnp.asarray(jnp.inf, dtype),
            steps=jnp.zeros(s, int),
            finished=(stage == s) & ~self.keep,
            result=optx.RESULTS.successful,
            history=History(
                jnp.zeros((s, n + 1), dtype),
                jnp.zeros((s, n + 1, k), dtype),
                jnp.zeros((s, n), dtype),
                jnp.zeros((s, n), dtype),
                jnp.zeros((s, n), bool),
            ),
        )

    def _after(self, stage: Int[Array, ""]) -> Int[Array, ""]:
        """The next stage that takes steps; their number if there is none."""
        count = len(self.limit)
        index = jnp.arange(count)
        return jnp.min(jnp.where((index > stage) & (self.limit > 0), index, count))

    def step(self, fn, y, args, options, state, tags):
        dtype = y.scale.dtype
        last = state.stage == len(self.limit)
        at = jnp.minimum(state.stage, len(self.limit) - 1)
        args = _held(args, self.free[at])
        sizes = sizes_of(args, y)

        lin, prediction = jax.lax.cond(
            state.stale,
            lambda _: _linearise_anew(args, state.observations, y),
            lambda _: (state.final.lin, state.prediction),
            None,
        )
        problem: Problem = args.with_prediction(prediction)
        known = jnp.sum(lin.costs)
        diagonal = diagonals(lin, sizes)
        damping = jnp.where(last, little(dtype), state.damping)
        extra = damped(diagonal, damping)
        least = jnp.where(last, 0.0, state.caution)
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
        move = solve_step(problem, y, lin, sizes, eliminated)
        length = _quadratic(problem, diagonal, move)
        slope = -_slope(problem, lin, move)
        predicted = 0.5 * (_quadratic(problem, extra, move) + slope)
        finite = jnp.isfinite(predicted) & jnp.isfinite(length) & ~last
        move = jax.tree.map(lambda x: jnp.where(finite, x, 0.0), move)
        slope = jnp.where(finite, slope, 0.0)
        trial, thrown, best, terms, gain = _search(
            problem, y, move, slope, predicted, lin.costs
        )
        more = jnp.clip(10 * state.caution, *CAUTION)
        caution = jnp.where(thrown, more, 0.1 * state.caution)
        cost = jnp.sum(terms)
        accept = finite & (predicted > 0) & (known - cost > GAIN * best * predicted)
        shrink = jnp.maximum(1 - (2 * gain - 1) ** 3, SHRINK)
        shrink = jnp.where(gain < 0.25, 2.0, shrink)
        lower = jnp.maximum(damping * shrink, least_damping(dtype))
        higher = jnp.maximum(damping, least_damping(dtype)) * state.growth
        # Below the rounding of the cost, or of residuals near 0, no decrease is seen.
        eps = float(jnp.finfo(dtype).eps)
        floor = 8 * eps * known + eps**1.25
        tiny = predicted <= floor
        small = predicted <= jnp.maximum(self.rtol[at] * known, floor)
        done = finite & (tiny | (small & accept & (damping <= 1e-2)))
        stuck = ~accept & ~done & (higher > MAX_DAMPING)
        broken = ~jnp.isfinite(known)
        row = jnp.where(last, len(self.limit), at)
        steps = state.steps.at[row].add(1, mode="drop")
        spent = ~done & (steps[at] >= self.limit[at])
        result = optx.RESULTS.where(
            spent, optx.RESULTS.nonlinear_max_steps_reached, optx.RESULTS.successful
        )
        result = optx.RESULTS.where(stuck, optx.RESULTS.nonlinear_divergence, result)
        result = optx.RESULTS.where(broken, optx.RESULTS.nonfinite, result)
        over = done | stuck | broken | spent
        following = jnp.where(over, self._after(at), state.stage)
        i, old = state.steps[at], state.history
        put = lambda rows, i, value: rows.at[row, i].set(value, mode="drop")
        history = History(
            put(put(old.cost, i, known), i + 1, jnp.where(accept, cost, known)),
            put(put(old.terms, i, lin.costs), i + 1, terms),
            put(old.damping, i, damping),
            put(old.step, i, jnp.sqrt(length)),
            put(old.accepted, i, accept),
        )
        new_y = jax.tree.map(lambda a, b: jnp.where(accept, a, b), trial, y)
        new_damping = jnp.where(accept, lower, higher)
        loop = _Loop(
            stage=following,
            prediction=prediction,
            observations=state.observations,
            final=Final(lin, eliminated.factor),
            stale=accept | over,
            damping=jnp.where(over, self.damping, new_damping).astype(dtype),
            caution=jnp.where(accept, caution, state.caution),
            growth=jnp.where(accept | over, 2.0, 2 * state.growth).astype(dtype),
            cost=jnp.where(accept, cost, known),
            first_cost=jnp.where(jnp.sum(state.steps) == 0, known, state.first_cost),
            steps=steps,
            finished=last | ((following == len(self.limit)) & ~self.keep),
            result=optx.RESULTS.where(last, state.result, result),
            history=history,
        )
        return new_y, loop, None

    def terminate(self, fn, y, args, options, state, tags):
        result = optx.RESULTS.where(
            state.finished, state.result, optx.RESULTS.successful
        )
        return state.finished, result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        names = ("history", "cost", "first_cost", "steps", "final")
        return y, aux, {name: getattr(state, name) for name in names}


def _held(problem: Problem, free: Float[Array, " v"]) -> Problem:
    """The problem with whole groups held besides those that are."""
    parts = {n: free[i] * getattr(problem.free, n) for i, n in enumerate(VARIABLES)}
    return eqx.tree_at(lambda p: p.free, problem, Step(**parts))


def least_damping(dtype) -> float:
    """Far below the stiffness of the softest bend of a long path of cameras, which
    falls with the fourth power of its length: 1e-10 of a camera's own at 1,000 frames.
    """
    return 1e-12 if dtype == jnp.float64 else 1e-8


def little(dtype) -> float:
    """Damping that keeps a direction which nothing determines finite, and its variance
    enormous."""
    return 1e-11 if dtype == jnp.float64 else 1e-6


def _first(problem, observations, state):
    lin, prediction = _linearise_anew(problem, observations, state)
    sizes = sizes_of(problem, state)
    extra = damped(diagonals(lin, sizes), jnp.ones_like(state.scale))
    return Final(lin, eliminate(problem, lin, sizes, extra).factor), prediction


def _linearise_anew(problem, observations, state):
    seen = problem.predict(state)
    return linearise(problem.with_prediction(seen), observations, state), seen


def _search(problem, state, move, slope, predicted, terms):
    """The full step, and the one that a parabola through its cost finds better.

    Robust losses bend more than `J^T J` knows: full steps then overshoot to and fro.
    The second evaluation is a few per cent of an iteration. Returns the better state,
    landmarks left behind, the share of the step, the terms there, and actual over
    predicted decrease of the full step.
    """
    known = jnp.sum(terms)

    def one(carry, _):
        share, place, thrown, best, best_terms, full = carry
        moved = state.retract(jax.tree.map(lambda x: share * x, move))
        moved, off, new = _settle(problem, state, moved)
        cost = jnp.sum(new)
        cost = jnp.where(jnp.isfinite(cost), cost, jnp.inf)
        better = cost < jnp.sum(best_terms)
        best = jnp.where(better, share, best)
        best_terms = jnp.where(better, new, best_terms)
        place = jax.tree.map(lambda a, b: jnp.where(better, a, b), moved, place)
        thrown = jnp.where(better, off, thrown)
        full = jnp.where(jnp.isnan(full), cost, full)
        # cost(a) = known - slope a + bend a^2, through the full step
        bend = full - known + slope
        vertex = slope / jnp.where(bend > 0, 2 * bend, 1.0)
        vertex = jnp.where(bend > 0, vertex, 2.0)
        share = jnp.clip(vertex, 0.1, 2.0)
        return (share, place, thrown, best, best_terms, full), None

    one_ = jnp.ones_like(known)
    none = jnp.zeros(len(state.landmarks), bool)
    start = (one_, state, none, one_, terms, jnp.nan * one_)
    found, _ = jax.lax.scan(one, start, length=2)
    _, place, thrown, best, best_terms, full = found
    gain = (known - full) / jnp.where(predicted > 0, predicted, 1.0)
    return place, thrown, best, best_terms, jnp.clip(gain, -1.0, 2.0)


def _settle(
    problem: Problem, state: State, moved: State
) -> tuple[State, Bool[Array, " l"], Float[Array, " k"]]:
    """A trial in which landmarks that the step throws off stay behind; which they are;
    and its costs.

    A point that few frames see, or that an outlier pulls, may be sent behind the
    cameras; given the cameras its cost is its own, so that it need not hold up the
    step of all others.
    """
    costs = []
    keep = jnp.zeros(len(state.landmarks), bool)
    for factor in problem.factors:
        if not isinstance(factor, Reprojection):
            costs.append(factor.cost(moved))
            continue
        old = eqx.tree_at(lambda s: s.landmarks, moved, state.landmarks)
        count = len(state.landmarks)
        ahead, behind = (
            jnp.zeros(count, moved.scale.dtype)
            .at[factor.landmark]
            .add(factor.loss.rho(jnp.sum(residual_of(factor, s) ** 2, axis=-1)))
            for s in (moved, old)
        )
        keep = ~(ahead <= behind)
        landmarks = jnp.where(keep[:, None], state.landmarks, moved.landmarks)
        moved = eqx.tree_at(lambda s: s.landmarks, moved, landmarks)
        costs.append(0.5 * jnp.sum(jnp.where(keep, behind, ahead)))
    return moved, keep, jnp.stack(costs)


def _quadratic(problem: Problem, diagonal: dict, step: Step) -> Float[Array, ""]:
    """`δ^T diag(H) δ`"""
    total = jnp.sum(diagonal["camera"] * step.cameras**2)
    total = total + jnp.sum(diagonal["root"] * step.roots**2)
    total = total + jnp.sum(diagonal["globals"] * _globals(diagonal, step) ** 2)
    if "pose" in diagonal:
        poses = step.poses.reshape(*step.poses.shape[:2], -1)
        total = total + jnp.sum(diagonal["pose"] * poses**2)
    for bucket, own in zip(problem.layout.buckets, diagonal["landmarks"], strict=True):
        moved = step.landmarks[bucket.landmark]
        total = total + jnp.sum(own * jnp.moveaxis(moved, 2, 1) ** 2)
    return total


def _slope(problem, lin, step):
    """`g^T δ`"""
    total = jnp.sum(lin.globals_gradient * _globals({"globals": lin.globals}, step))
    gradient = lin.gradient
    if "camera_alone" in gradient:
        total = total + jnp.sum(gradient["camera_alone"] * step.cameras)
    if "camera" in gradient:
        total = total + jnp.sum(gradient["camera"] * step.cameras)
    if "root" in gradient:
        total = total + jnp.sum(gradient["root"] * step.roots)
    if "pose" in gradient:
        poses = step.poses.reshape(*step.poses.shape[:2], -1)
        total = total + jnp.sum(gradient["pose"] * poses)
    for bucket, table in zip(problem.layout.buckets, lin.landmarks, strict=True):
        moved = jnp.moveaxis(step.landmarks[bucket.landmark], 2, 1)
        total = total + jnp.sum(table.gradient * moved)
    return total


def _globals(like, step):
    """Globals in one vector; intrinsics only if they are among them."""
    count = like["globals"].shape[0] - 1 - step.shapes.size
    return jnp.concatenate(
        [step.scale[None], step.intrinsics[:count], step.shapes.reshape(-1)]
    )


def lifted(state: State, problem: Problem) -> list[Array]:
    """Lifted residuals of all factors, as a stock solver sees them."""
    return [lift(f.loss, residual_of(f, state)) for f in problem.factors]
