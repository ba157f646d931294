"""Levenberg-Marquardt on the factor graph, in optimistix's loop.

Marquardt's damping (in proportion to each variable's own curvature, as units here mix
m, rad and shape) with Nielsen's update; steps are accepted on the true robust cost. The
linearisation is kept after a rejected step. The motion model's prediction is frozen
within a step and made anew after each accepted one.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from bodyslam_jax.graph import Problem, State, Step, lift
from bodyslam_jax.solver._linearise import (
    Linearisation,
    Observations,
    gather,
    linearise,
    sizes_of,
)
from bodyslam_jax.solver._normal import damped, diagonals, eliminate, solve_step

GAIN = 1e-4
"""Least share of the predicted decrease at which a step is accepted."""
MAX_DAMPING = 1e12


class History(eqx.Module):
    """One entry an iteration, of which the first `num_steps` are filled."""

    cost: Float[Array, " _"]
    """Before each iteration, and after the last."""
    terms: Float[Array, "_ k"]
    """By factor, in the order of the problem."""
    damping: Float[Array, " n"]
    step: Float[Array, " n"]
    """Length of the step in standard deviations: `sqrt(δ^T diag(H) δ)`."""
    accepted: Bool[Array, " n"]


class _Loop(eqx.Module):
    prediction: Any
    observations: tuple[Observations, ...]
    lin: Linearisation
    stale: Bool[Array, ""]
    """Whether `lin` is of an earlier state."""
    damping: Float[Array, ""]
    growth: Float[Array, ""]
    cost: Float[Array, ""]
    steps: Int[Array, ""]
    done: Bool[Array, ""]
    result: optx.RESULTS
    history: History


class StructuredLevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """The structured solver; `y` is a `State`, `args` a padded `Problem`."""

    rtol: float = 1e-8
    """Stops when an undisturbed step lowers the cost by less than this share."""
    atol: float = 0.0
    norm: Callable[..., Any] = optx.max_norm
    damping: float = 1e-4
    """At the first step; 0 is Gauss-Newton with step control left to `GAIN`."""
    min_damping: float = 1e-9
    max_history: int = eqx.field(static=True, default=256)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        dtype = y.scale.dtype
        n, k = self.max_history, len(args.factors)
        observations = gather(args)
        # Filled in by the first step: each part is compiled once.
        struct = eqx.filter_eval_shape(_linearise_anew, args, observations, y)
        empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), struct)
        return _Loop(
            prediction=empty[1],
            observations=observations,
            lin=empty[0],
            stale=jnp.array(True),
            damping=jnp.asarray(self.damping, dtype),
            growth=jnp.asarray(2.0, dtype),
            cost=jnp.asarray(jnp.inf, dtype),
            steps=jnp.array(0),
            done=jnp.array(False),
            result=optx.RESULTS.successful,
            history=History(
                jnp.zeros(n + 1, dtype),
                jnp.zeros((n + 1, k), dtype),
                jnp.zeros(n, dtype),
                jnp.zeros(n, dtype),
                jnp.zeros(n, bool),
            ),
        )

    def step(self, fn, y, args, options, state, tags):
        dtype = y.scale.dtype
        sizes = sizes_of(args, y)

        lin, prediction = jax.lax.cond(
            state.stale,
            lambda _: _linearise_anew(args, state.observations, y),
            lambda _: (state.lin, state.prediction),
            None,
        )
        problem: Problem = args.with_prediction(prediction)
        known = jnp.sum(lin.costs)
        diagonal = diagonals(lin, sizes)
        extra = damped(diagonal, state.damping)
        eliminated = eliminate(problem, lin, sizes, extra)
        move = solve_step(problem, y, lin, sizes, eliminated)
        length = _quadratic(problem, diagonal, move)
        predicted = 0.5 * (state.damping * length - _slope(problem, lin, move))
        finite = jnp.isfinite(predicted) & jnp.isfinite(length)
        move = jax.tree.map(lambda x: jnp.where(finite, x, 0.0), move)
        slope = -_slope(problem, lin, move)
        best, terms, gain = _search(problem, y, move, slope, predicted, lin.costs)
        cost = jnp.sum(terms)
        accept = finite & (predicted > 0) & (known - cost > GAIN * best * predicted)
        trial = y.retract(jax.tree.map(lambda x: best * x, move))
        shrink = jnp.maximum(1 - (2 * gain - 1) ** 3, 1 / 3)
        shrink = jnp.where(gain < 0.25, 2.0, shrink)
        lower = jnp.maximum(state.damping * shrink, self.min_damping)
        higher = jnp.maximum(state.damping, self.min_damping) * state.growth
        # Below the rounding of the cost, or of residuals near 0, no decrease is seen.
        eps = float(jnp.finfo(dtype).eps)
        floor = 8 * eps * known + eps**1.25
        tiny = predicted <= floor
        small = predicted <= jnp.maximum(self.rtol * known, floor)
        done = finite & (tiny | (small & accept & (state.damping <= 1e-2)))
        stuck = ~accept & ~done & (higher > MAX_DAMPING)
        broken = ~jnp.isfinite(known)
        result = optx.RESULTS.where(
            stuck, optx.RESULTS.nonlinear_divergence, optx.RESULTS.successful
        )
        result = optx.RESULTS.where(broken, optx.RESULTS.nonfinite, result)
        old, at = state.history, state.steps
        put = lambda rows, i, value: rows.at[i].set(value, mode="drop")
        history = History(
            put(put(old.cost, at, known), at + 1, jnp.where(accept, cost, known)),
            put(put(old.terms, at, lin.costs), at + 1, terms),
            put(old.damping, at, state.damping),
            put(old.step, at, jnp.sqrt(length)),
            put(old.accepted, at, accept),
        )
        new_y = jax.tree.map(lambda a, b: jnp.where(accept, a, b), trial, y)
        loop = _Loop(
            prediction=prediction,
            observations=state.observations,
            lin=lin,
            stale=accept,
            damping=jnp.where(accept, lower, higher),
            growth=jnp.where(accept, 2.0, 2 * state.growth).astype(dtype),
            cost=jnp.where(accept, cost, known),
            steps=state.steps + 1,
            done=done,
            result=result,
            history=history,
        )
        return new_y, loop, None

    def terminate(self, fn, y, args, options, state, tags):
        return state.done, state.result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {"history": state.history, "cost": state.cost}


def _linearise_anew(problem, observations, state):
    seen = problem.predict(state)
    return linearise(problem.with_prediction(seen), observations, state), seen


def _search(problem, state, move, slope, predicted, terms):
    """The full step, and the one that a parabola through its cost finds better.

    Robust losses bend more than `J^T J` knows: full steps then overshoot to and fro.
    The second evaluation is a few per cent of an iteration. Returns the share of the
    step, the terms there, and actual over predicted decrease of the full step.
    """
    known = jnp.sum(terms)

    def one(carry, _):
        share, best, best_terms, full = carry
        moved = state.retract(jax.tree.map(lambda x: share * x, move))
        new = jnp.stack([f.cost(moved) for f in problem.factors])
        cost = jnp.sum(new)
        cost = jnp.where(jnp.isfinite(cost), cost, jnp.inf)
        better = cost < jnp.sum(best_terms)
        best = jnp.where(better, share, best)
        best_terms = jnp.where(better, new, best_terms)
        full = jnp.where(jnp.isnan(full), cost, full)
        # cost(a) = known - slope a + bend a^2, through the full step
        bend = full - known + slope
        vertex = slope / jnp.where(bend > 0, 2 * bend, 1.0)
        vertex = jnp.where(bend > 0, vertex, 2.0)
        return (jnp.clip(vertex, 0.1, 2.0), best, best_terms, full), None

    one_ = jnp.ones_like(known)
    start = (one_, one_, terms, jnp.nan * one_)
    (_, best, best_terms, full), _ = jax.lax.scan(one, start, length=2)
    gain = (known - full) / jnp.where(predicted > 0, predicted, 1.0)
    return best, best_terms, jnp.clip(gain, -1.0, 2.0)


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
    return [lift(f.loss, f.residual(state)) for f in problem.factors]
