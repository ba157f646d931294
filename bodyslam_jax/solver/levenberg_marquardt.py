"""Levenberg-Marquardt on the factor graph, in optimistix's loop.

A stage begins at the best scale for its people (`best_scale`). Steps are damped, and
accepted on the true robust cost (`step.py`). The linearisation is kept after a rejected
step. The motion model's prediction is frozen within a step and computed anew after each
accepted one. Near convergence the Hessian includes the second-order term of the
keypoint factors (`second_order.py`). Landmarks in flat regions of their cost are
triangulated anew (`retriangulation.py`).

The stages of a schedule are phases of one loop that differ by a mask, so that they are
compiled once, together with the factorisation that covariances need.

`Loop` is the state of the loop, `History` its record, `Final` its last equations.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from bodyslam_jax.graph import VARIABLES, Problem, State, Step, residual_of, robustify
from bodyslam_jax.solver.best_scale import (
    MIN_SCALE_COST_DECREASE,
    best_scale,
    is_quadratic,
)
from bodyslam_jax.solver.block_cholesky import Factor
from bodyslam_jax.solver.blocks import Linearisation, Observations, sizes_of
from bodyslam_jax.solver.elimination.person import RootFactor
from bodyslam_jax.solver.linear_system import Eliminated, damped, diagonals, eliminate
from bodyslam_jax.solver.linearise import linearise
from bodyslam_jax.solver.linearise.landmark import gather
from bodyslam_jax.solver.retriangulation import triangulate_anew
from bodyslam_jax.solver.second_order import add_second_order, curvature_if, next_share
from bodyslam_jax.solver.step import Trial, attempt, least_damping

MAX_DAMPING = 1e12
"""Damping above which a stage ends without convergence."""
MIN_RETRIANGULATION_DECREASES = (10.0, 0.5)
"""Least decrease of the cost, a negative log-likelihood, for which a landmark is
triangulated anew: after the first step, and later."""
RETRIANGULATION_RTOL = 0.01
"""Landmarks are triangulated again after a step with a smaller relative decrease of the
cost, as cameras are about right by then, and at convergence."""


class StructuredLevenbergMarquardt(optx.AbstractLeastSquaresSolver):
    """The structured solver; `y` is a `State`, `args` a padded `Problem`.

    All settings but the length of the history are arrays, so that one compilation
    serves all schedules of as many stages.
    """

    free: Float[Array, "s v"]
    """1 for the groups among `VARIABLES` that a stage moves, else 0."""
    limit: Int[Array, " s"]
    """Maximum number of steps; a stage with none is left out."""
    rtol: Any
    """Shape (s,): a stage ends when an undisturbed step lowers the cost by less than
    this share."""
    atol: Any
    """Shape (s,): or by less than this. Optimistix annotates both as scalars."""
    damping: Float[Array, ""]
    """Damping of the first step of a stage; 0 is Gauss-Newton, with step control
    left to `MIN_GAIN_RATIO`."""
    keep: Bool[Array, ""]
    """Whether to factorise once more at the end, barely damped, for covariances."""
    length: int = eqx.field(static=True)
    """Number of rows of the history."""
    dtype: np.dtype = eqx.field(static=True)
    """Precision of blocks and factors (`blocks.Linearisation`)."""
    norm: Callable[..., Any] = optx.max_norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        dtype = y.scale.dtype
        s, n, k = len(self.limit), self.length, len(args.factors)
        observations = gather(args)
        # Empty until the first step, so that each part is compiled once.
        struct = eqx.filter_eval_shape(_first, args, observations, y, self.dtype)
        empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), struct)
        stage = self._after(jnp.array(-1))
        return Loop(
            stage=stage,
            prediction=empty[1],
            observations=observations,
            final=empty[0],
            stale=jnp.array(True),
            damping=jnp.asarray(self.damping, dtype),
            least_damping=jnp.asarray(least_damping(dtype), dtype),
            landmark_damping=jnp.zeros(len(y.landmarks), dtype),
            searched=jnp.array(0),
            nu=jnp.asarray(2.0, dtype),
            cost=jnp.asarray(jnp.inf, dtype),
            first_cost=jnp.asarray(jnp.inf, dtype),
            better_scale=jnp.asarray(jnp.nan, dtype),
            steps=jnp.zeros(s, int),
            share=jnp.zeros((), dtype),
            bent=jnp.array(True),
            finished=jnp.array(False),
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
        """Returns the next stage with steps; the number of stages if none has any."""
        count = len(self.limit)
        index = jnp.arange(count)
        return jnp.min(jnp.where((index > stage) & (self.limit > 0), index, count))

    def step(self, fn, y, args, options, state, tags):
        dtype = y.scale.dtype
        last = state.stage == len(self.limit)
        at = jnp.minimum(state.stage, len(self.limit) - 1)
        whole, args = args, _held(args, self.free[at])
        sizes = sizes_of(args, y, self.dtype)

        begins = (state.steps[at] == 0) & ~last
        lin, prediction, y, best_scale, gained = jax.lax.cond(
            state.stale,
            lambda _: _linearise_anew(
                *(args, state.observations, y, self.dtype, begins),
                last & (whole.free.scale > 0) & (not is_quadratic(whole)),
            ),
            lambda _: (
                *(state.final.lin, state.prediction, y),
                *(y.scale, jnp.zeros_like(y.scale)),
            ),
            None,
        )
        problem: Problem = args.with_prediction(prediction)
        share = jnp.where(last, state.bent.astype(dtype), state.share)
        curvature = curvature_if(share > 0, problem, lin, y, sizes)
        bent = add_second_order(lin, curvature, share)
        known = jnp.sum(lin.costs)
        trial = _attempt_if(
            ~last | self.keep,
            *(problem, y, bent, sizes, state.damping, state.landmark_damping, last),
        )
        accept, before = trial.accepted, jnp.sum(trial.terms)
        enough = jnp.maximum(self.rtol[at] * known, self.atol[at])
        done = _is_done(trial, known, enough)
        nth = state.searched
        near = accept & ((nth == 0) | (known - before < RETRIANGULATION_RTOL * known))
        look = trial.finite & (near & (nth < 2) | done & (nth < 3))
        least = jnp.where(nth == 0, *MIN_RETRIANGULATION_DECREASES).astype(dtype)
        new_y, terms = jax.lax.cond(
            look,
            lambda s, t: triangulate_anew(problem, s, t, least),
            lambda s, t: (s, t),
            *(trial.state, trial.terms),
        )
        cost = jnp.sum(terms)
        found = before - cost > enough
        done = done & ~found
        least_possible = trial.next_least(state.least_damping, self.dtype)
        damping = trial.next_damping(state.nu, least_possible)
        stuck = ~accept & ~done & ~found & (damping > MAX_DAMPING)
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
        # Away from a minimum the second-order term may leave the Hessian indefinite:
        # then it is factorised without the term.
        sound = ~state.bent | jnp.isfinite(trial.predicted)
        share = next_share(state.share, accept, known - before, known)
        share = jnp.where(self.damping > 0, share, 0.0)  # Gauss-Newton knows none
        i, old = state.steps[at], state.history
        put = lambda rows, i, value: rows.at[row, i].set(value, mode="drop")
        # The final cost is that with the motion predicted at the final state.
        ended = jnp.max(jnp.where(state.steps > 0, jnp.arange(len(steps)), -1))
        ended = jnp.where(last & (ended >= 0), ended, len(steps))
        end = lambda rows, value: rows.at[ended, state.steps[ended]].set(
            value, mode="drop"
        )
        moved = ((self.free[:, VARIABLES.index("scale")] > 0) & (steps > 0)).any()
        is_better = last & moved & (gained > MIN_SCALE_COST_DECREASE)
        history = History(
            end(put(put(old.cost, i, known), i + 1, cost), known),
            end(put(put(old.terms, i, lin.costs), i + 1, terms), lin.costs),
            put(old.damping, i, trial.damping),
            put(old.step, i, jnp.sqrt(trial.length)),
            put(old.accepted, i, accept | found),
        )
        loop = Loop(
            stage=following,
            prediction=prediction,
            observations=state.observations,
            final=final_of(lin, trial.eliminated),
            stale=accept | found | over | last,
            damping=jnp.where(over, self.damping, damping).astype(dtype),
            least_damping=jnp.where(over, least_damping(dtype), least_possible).astype(
                dtype
            ),
            landmark_damping=trial.landmark_damping,
            searched=jnp.where(over, 0, jnp.where(look, nth + 1, nth)),
            nu=jnp.where(accept | over, 2.0, 2 * state.nu).astype(dtype),
            cost=cost,
            first_cost=jnp.where(
                jnp.sum(state.steps) == 0,
                known + jnp.where(begins, gained, 0.0),
                state.first_cost,
            ),
            better_scale=jnp.where(is_better, best_scale, state.better_scale),
            steps=steps,
            share=jnp.where(over, 0.0, share).astype(dtype),
            bent=state.bent & ~last,
            finished=last & (sound | ~self.keep),
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
        names = ("history", "cost", "first_cost", "better_scale", "steps", "final")
        return y, aux, {name: getattr(state, name) for name in names}


def _held(problem: Problem, free: Float[Array, " v"]) -> Problem:
    """Returns the problem with the groups whose `free` is 0 held as well."""
    parts = {n: free[i] * getattr(problem.free, n) for i, n in enumerate(VARIABLES)}
    return eqx.tree_at(lambda p: p.free, problem, Step(**parts))


def _is_done(
    trial: Trial, known: Float[Array, ""], enough: Float[Array, ""]
) -> Bool[Array, ""]:
    """Returns True if a step would lower the cost by less than the tolerance."""
    eps = float(jnp.finfo(known.dtype).eps)
    # Decreases below the rounding of the cost, or of residuals near 0, are invisible.
    floor = 8 * eps * known + eps**1.25
    small = trial.predicted <= jnp.maximum(enough, floor)
    undisturbed = trial.accepted & (trial.damping <= 1e-2)
    return trial.finite & ((trial.predicted <= floor) | (small & undisturbed))


def _attempt_if(needed: Bool[Array, ""], *given: Any) -> Trial:
    """Returns `attempt`, or no step where only the cost is needed."""
    problem, state, lin, *_ = given
    some = lambda _: attempt(*given)
    like = eqx.filter_eval_shape(some, None)
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)
    none = blank._replace(state=state, terms=lin.costs)
    return jax.lax.cond(needed, some, lambda _: none, None)


def _first(problem, observations, state, dtype):
    no = jnp.array(False)
    lin, prediction, *_ = _linearise_anew(problem, observations, state, dtype, no, no)
    sizes = sizes_of(problem, state, dtype)
    extra = damped(diagonals(lin, sizes), jnp.ones_like(state.scale))
    return final_of(lin, eliminate(problem, lin, sizes, extra)), prediction


class Final(eqx.Module):
    """The factorised normal equations, barely damped, where the solver stopped."""

    lin: Linearisation
    """Without the second-order term of keypoints, which `factor` may include."""
    factor: Factor
    roots: RootFactor | None
    """Factor of the people's roots that were eliminated within chunks."""


def final_of(lin: Linearisation, eliminated: Eliminated) -> Final:
    """Returns the parts of a factorisation that a solve keeps."""
    people = eliminated.people
    return Final(lin, eliminated.factor, None if people is None else people.roots)


def _linearise_anew(problem, observations, state, dtype, begins, ends):
    """Predicts the motion anew and linearises there.

    Returns the normal equations, the prediction, the state, the best scale and the
    decrease of the cost that it brings. Where a stage `begins` the state takes the best
    scale; where all stages have come to their `ends` it is only reported.
    """
    seen = problem.predict(state)
    problem = problem.with_prediction(seen)
    best, gained = jax.lax.cond(
        begins | ends,
        lambda s: best_scale(problem, s, ends | (problem.free.scale > 0)),
        lambda s: (s.scale, jnp.zeros_like(s.scale)),
        state,
    )
    scale = jnp.where(begins, best, state.scale)
    state = dataclasses.replace(state, scale=scale)
    return linearise(problem, observations, state, dtype), seen, state, best, gained


def lifted(state: State, problem: Problem) -> list[Array]:
    """Returns the lifted residuals of all factors, as a stock solver sees them."""
    return [robustify(f.loss, residual_of(f, state)) for f in problem.factors]


class History(eqx.Module):
    """One row an iteration, of which the first `num_steps` are filled.

    Times are not recorded: the loop is one compiled program.
    """

    cost: Float[Array, "*s _"]
    """Cost before each iteration, and after the last."""
    terms: Float[Array, "*s _ k"]
    """Cost by factor, in the order of the problem."""
    damping: Float[Array, "*s n"]
    step: Float[Array, "*s n"]
    """Length of the step in standard deviations: `sqrt(δ^T diag(H) δ)`."""
    accepted: Bool[Array, "*s n"]


class Loop(eqx.Module):
    """The state of `StructuredLevenbergMarquardt` between two iterations."""

    stage: Int[Array, ""]
    """Stage that runs now; the number of stages in the last rounds, which evaluate the
    cost and factorise for covariances."""
    prediction: Any
    observations: Observations | None
    final: Final
    stale: Bool[Array, ""]
    """Whether `final.lin` belongs to an earlier state or stage."""
    damping: Float[Array, ""]
    least_damping: Float[Array, ""]
    """Least damping in this stage, above those at which factorisations failed."""
    landmark_damping: Float[Array, " l"]
    """Least damping of each landmark, as a share of its own diagonal."""
    searched: Int[Array, ""]
    """Number of retriangulations of landmarks in this stage."""
    nu: Float[Array, ""]
    cost: Float[Array, ""]
    first_cost: Float[Array, ""]
    better_scale: Float[Array, ""]
    """Another s with a lower cost where the solve ended; NaN if none is known."""
    steps: Int[Array, " s"]
    share: Float[Array, ""]
    """Share of the second-order term of keypoints in the next step."""
    bent: Bool[Array, ""]
    """Whether the last factorisation includes all of the second-order term."""
    finished: Bool[Array, ""]
    result: optx.RESULTS
    history: History
