"""Stock solvers for small problems, as cross-checks and baselines of benchmarks.

They see a flat step from the first state (poses do not add, steps do) and the lifted
residuals. Adam predicts the motion anew in each step, and holds the prediction in its
gradient. The others keep the prediction at the start of a stage. Each is one compiled
program.
"""

import math
import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optax
import optimistix as optx
from jax.flatten_util import ravel_pytree

from bodyslam_jax.graph import Problem, State, Step
from bodyslam_jax.solver.blocks import mask_of
from bodyslam_jax.solver.levenberg_marquardt import lifted
from bodyslam_jax.solver.solution import is_finite

ADAM_LEARNING_RATE = 1e-2
"""Length of a step, in the units of each coordinate of a step."""
MAX_DENSE_ENTRIES = 20_000_000
"""Largest number of entries of a dense Jacobian, 160 MB in double precision; for more,
`optimistix_lm` and `jaxopt_lm` are refused."""
SETTLING_STEPS = 10
"""Number of first-order steps over which the cost of a converged solve is constant."""


def run(name, problem, state, stage):
    """Runs one stage of a solver; returns the state, its cost,
    the steps and the result.

    In place of a state that is not finite, or whose cost is not, it returns the one
    that the stage began with.
    """
    cost_of = problem.cost
    before = cost_of(state)
    found, count, result = _METHODS[name](problem, state, stage)
    cost = cost_of(found)
    good = jnp.isfinite(cost) & is_finite(found)
    state = jax.tree.map(lambda new, old: jnp.where(good, new, old), found, state)
    result = optx.RESULTS.where(good, result, optx.RESULTS.nonfinite)
    return state, jnp.where(good, cost, before), count, result


def check_size(name: str, problem: Problem, state: State) -> None:
    """Refuses a problem whose dense Jacobian would be too large.

    **Raises:** `ValueError` with the size of the Jacobian and the largest allowed.
    """
    if name == "adam":
        return
    rows = jax.eval_shape(lambda s: lifted(s, problem), state)
    count = sum(math.prod(row.shape) for row in rows)
    unknowns = sum(x.size for x in jax.tree.leaves(problem.free))
    if count * unknowns > MAX_DENSE_ENTRIES:
        raise ValueError(
            f"solver: {name} is for small problems, as its Jacobian is dense: found "
            f"{count:,} residuals by {unknowns:,} unknowns ({len(state.cameras)} "
            f"frames, {len(state.landmarks)} landmarks), expected a product below "
            f"{MAX_DENSE_ENTRIES:,}; use `structured` or `adam`."
        )


class _Flat(eqx.Module):
    """A problem around a first state, in free coordinates only."""

    problem: Problem
    state: State
    mask: Step

    def retract(self, step):
        held = jax.tree.map(lambda m, s: m * s, self.mask, step)
        return self.state.retract(held)

    def residual(self, step):
        place = self.retract(step)
        rows = lifted(place, self.problem)
        return jnp.concatenate([r.reshape(-1) for r in rows])

    def cost(self, step):
        """Returns the cost after a step, with the motion predicted there, and held."""
        return self.problem.cost(self.retract(step))


def flat_problem(problem, state):
    refreshed = problem.refresh(state)
    return _Flat(refreshed, state, mask_of(refreshed)), state.zero_step()


def _residual(step, flat):
    return flat.residual(step)


def held_rows(step, flat):
    """Returns residuals, and weak rows on all coordinates, without which those that no
    measurement sees would make a dense system singular."""
    held = jax.tree.map(lambda s: 1e-9 * s, step)
    return flat.residual(step), held


def optimistix_lm(problem, state, stage):
    """Runs the Levenberg-Marquardt of optimistix, dense, by QR."""
    flat, zero = flat_problem(problem, state)
    method = optx.LevenbergMarquardt(
        rtol=stage.rtol, atol=stage.rtol, linear_solver=lx.QR()
    )
    found = optx.least_squares(
        held_rows, method, zero, flat, max_steps=4 * stage.max_steps, throw=False
    )
    return flat.retract(found.value), found.stats["num_steps"], found.result


def jaxopt_lm(problem, state, stage):
    """Runs the Levenberg-Marquardt of jaxopt, dense."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        import jaxopt
    flat, zero = flat_problem(problem, state)
    start, unravel = ravel_pytree(zero)
    arrays, static = eqx.partition(flat, eqx.is_array)

    def residual(x, arrays):
        whole = eqx.combine(arrays, static)
        return jnp.concatenate([whole.residual(unravel(x)), 1e-9 * x])

    # Relative to the largest slope at the start: an absolute one has the cost's units.
    slope = jax.lax.stop_gradient(jax.grad(flat.cost)(zero))
    slope = jnp.abs(ravel_pytree(slope)[0]).max()
    method = jaxopt.LevenbergMarquardt(
        residual,
        maxiter=4 * stage.max_steps,
        tol=stage.rtol * slope,
        xtol=1e-14,
        solver="cholesky",
        materialize_jac=True,
    )
    # jaxopt multiplies booleans and numbers.
    with jax.numpy_dtype_promotion("standard"):
        found = method.run(start, arrays)
    # Where rounding hides any decrease, it tries ever shorter steps: converged, too.
    last = found.state
    least = 1e-12 * jnp.diag(jnp.max(jnp.diag(last.jtj)) * jnp.ones_like(start))
    step = jnp.linalg.solve(last.jtj + least, last.gradient)
    gain = 0.5 * last.gradient @ step
    converged = last.error <= stage.rtol * slope
    converged |= gain <= jnp.maximum(stage.rtol * last.value, stage.atol)
    return flat.retract(unravel(found.params)), found.state.iter_num, _result(converged)


def _result(converged):
    return optx.RESULTS.where(
        converged,
        optx.RESULTS.successful,
        optx.RESULTS.nonlinear_max_steps_reached,
    )


def adam(problem, state, stage):
    """Takes `stage.max_steps` first-order steps, as the paper does.

    It counts as converged if the cost stayed within the stage's tolerance over the last
    `SETTLING_STEPS`: the steps are of fixed length and never end by themselves.
    """
    state, costs = adam_curve(problem, state, stage, ADAM_LEARNING_RATE)
    finite, settled = jnp.isfinite(costs), jnp.array(False)
    if len(costs) >= SETTLING_STEPS:
        enough = jnp.maximum(stage.rtol * costs[-1], stage.atol)
        settled = jnp.ptp(costs[-SETTLING_STEPS:]) <= enough
    result = _result(settled)
    result = optx.RESULTS.where(finite.all(), result, optx.RESULTS.nonfinite)
    return state, finite.sum(), result


def adam_curve(problem, state, stage, rate, *, decays=False):
    """Returns the state after `stage.max_steps` of Adam, and the cost before each.

    With `decays` the rate falls to 0 as a cosine does. Where the cost is not finite the
    last state with a finite one is kept.
    """
    flat, zero = flat_problem(problem, state)
    rate = jnp.asarray(rate, state.scale.dtype)
    found, costs = _adam(flat, zero, rate, stage.max_steps, decays)
    return flat.retract(found), costs


@eqx.filter_jit
def _adam(flat, start, rate, count, decays):
    method = optax.scale_by_adam()
    falls = optax.cosine_decay_schedule(1.0, max(count, 1))

    def one(carry, k):
        step, known, memory = carry
        cost, gradient = jax.value_and_grad(flat.cost)(step)
        good = jnp.isfinite(cost)
        known = jax.tree.map(lambda new, old: jnp.where(good, new, old), step, known)
        # optax mixes arrays with Python numbers of other types.
        with jax.numpy_dtype_promotion("standard"):
            change, memory = method.update(gradient, memory)
            length = rate * falls(k) if decays else rate
        length = length.astype(rate.dtype)
        step = jax.tree.map(lambda s, c: s - length * c, known, change)
        return (step, known, memory), cost

    carry = start, start, method.init(start)
    (step, known, _), costs = jax.lax.scan(one, carry, jnp.arange(count))
    good = jnp.isfinite(flat.cost(step))
    return jax.tree.map(lambda a, b: jnp.where(good, a, b), step, known), costs


_METHODS = {
    "optimistix_lm": optimistix_lm,
    "jaxopt_lm": jaxopt_lm,
    "adam": adam,
}
