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

    cost: Float[Array, " n+1"]
    """Before each iteration, and after the last."""
    terms: Float[Array, "n+1 k"]
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
        struct = eqx.filter_eval_shape(linearise, args, observations, y)
        return _Loop(
            prediction=args.predict(y),
            observations=observations,
            lin=jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), struct),
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

        def anew(_):
            seen = args.predict(y)
            return linearise(args.with_prediction(seen), state.observations, y), seen

        lin, prediction = jax.lax.cond(
            state.stale, anew, lambda _: (state.lin, state.prediction), None
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
        trial = y.retract(move)
        terms = jnp.stack([f.cost(trial) for f in problem.factors])
        cost = jnp.sum(terms)
        gain = (known - cost) / jnp.where(predicted > 0, predicted, 1.0)
        accept = finite & (predicted > 0) & (gain > GAIN)
        shrink = jnp.maximum(1 - (2 * gain - 1) ** 3, 1 / 3)
        lower = jnp.maximum(state.damping * shrink, self.min_damping)
        higher = jnp.maximum(state.damping, self.min_damping) * state.growth
        # Below the rounding of the cost itself, no decrease can be seen.
        floor = 8 * jnp.finfo(dtype).eps * known
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
