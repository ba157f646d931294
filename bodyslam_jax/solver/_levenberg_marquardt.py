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
    """One row an iteration, of which the first `num_steps` are filled."""

    cost: Float[Array, " n"]
    terms: Float[Array, "n k"]
    """By factor, in the order of the problem."""
    damping: Float[Array, " n"]
    step: Float[Array, " n"]
    """Length of the step in standard deviations: `sqrt(δ^T diag(H) δ)`."""
    accepted: Bool[Array, " n"]


class _Loop(eqx.Module):
    prediction: Any
    observations: tuple[Observations, ...]
    lin: Linearisation
    cost: Float[Array, ""]
    damping: Float[Array, ""]
    growth: Float[Array, ""]
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
        prediction = args.predict(y)
        problem: Problem = args.with_prediction(prediction)
        observations = gather(problem)
        dtype = y.scale.dtype
        n, k = self.max_history, len(problem.factors)
        cost = problem.cost(y)
        return _Loop(
            prediction=prediction,
            observations=observations,
            lin=linearise(problem, observations, y),
            cost=cost,
            damping=jnp.asarray(self.damping, dtype),
            growth=jnp.asarray(2.0, dtype),
            steps=jnp.array(0),
            done=jnp.array(False),
            result=optx.RESULTS.where(
                jnp.isfinite(cost), optx.RESULTS.successful, optx.RESULTS.nonfinite
            ),
            history=History(
                jnp.zeros(n, dtype),
                jnp.zeros((n, k), dtype),
                jnp.zeros(n, dtype),
                jnp.zeros(n, dtype),
                jnp.zeros(n, bool),
            ),
        )

    def step(self, fn, y, args, options, state, tags):
        problem: Problem = args.with_prediction(state.prediction)
        lin, dtype = state.lin, y.scale.dtype
        sizes = sizes_of(problem, y)
        diagonal = diagonals(lin, sizes)
        extra = damped(diagonal, state.damping)
        eliminated = eliminate(problem, lin, sizes, extra)
        move = solve_step(problem, y, lin, sizes, eliminated)
        length = _quadratic(problem, diagonal, move)
        predicted = 0.5 * (state.damping * length - _slope(problem, lin, sizes, move))
        finite = jnp.isfinite(predicted) & jnp.isfinite(length)
        move = jax.tree.map(lambda x: jnp.where(finite, x, 0.0), move)
        trial = y.retract(move)
        terms = jnp.stack([f.cost(trial) for f in problem.factors])
        cost = jnp.sum(terms)
        decrease = state.cost - cost
        gain = decrease / jnp.where(predicted > 0, predicted, 1.0)
        accept = finite & (predicted > 0) & (gain > GAIN)

        def accepted(_):
            seen = problem.predict(trial)
            new = problem.with_prediction(seen)
            fresh = linearise(new, state.observations, trial)
            return trial, seen, fresh, cost if seen is None else new.cost(trial)

        def rejected(_):
            return y, state.prediction, lin, state.cost

        new_y, prediction, lin, new_cost = jax.lax.cond(
            accept, accepted, rejected, None
        )
        shrink = jnp.maximum(1 - (2 * gain - 1) ** 3, 1 / 3)
        lower = jnp.maximum(state.damping * shrink, self.min_damping)
        raise_ = jnp.maximum(state.damping, self.min_damping) * state.growth
        floor = 4 * jnp.finfo(dtype).eps
        small = predicted <= jnp.maximum(self.rtol, floor) * state.cost
        done = finite & small & (accept | (predicted <= floor * state.cost))
        done = done & ((state.damping <= 1e-2) | (predicted <= floor * state.cost))
        stuck = ~accept & (raise_ > MAX_DAMPING)
        at = state.steps
        history = History(
            state.history.cost.at[at].set(cost, mode="drop"),
            state.history.terms.at[at].set(terms, mode="drop"),
            state.history.damping.at[at].set(state.damping, mode="drop"),
            state.history.step.at[at].set(jnp.sqrt(length), mode="drop"),
            state.history.accepted.at[at].set(accept, mode="drop"),
        )
        loop = _Loop(
            prediction=prediction,
            observations=state.observations,
            lin=lin,
            cost=new_cost,
            damping=jnp.where(accept, lower, raise_),
            growth=jnp.where(accept, 2.0, 2 * state.growth).astype(dtype),
            steps=state.steps + 1,
            done=done,
            result=optx.RESULTS.where(
                stuck, optx.RESULTS.nonlinear_divergence, state.result
            ),
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


def _slope(problem, lin, sizes, step):
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
