"""Stock solvers, as cross-checks and to be measured against; for small problems.

They see a flat step from the first state (poses do not add, steps do) and the lifted
residuals. The motion model's prediction is made anew, and held, in each step of Adam.
In the others it stays as it is at the start of a stage. Each is one program with all
that it needs.
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

ADAM_RATE = 1e-2
DENSE_LIMIT = 20_000_000
"""Entries of a dense Jacobian, 160 MB in double precision: above, `optimistix_lm` and
`jaxopt_lm` are refused."""
SETTLED = 10
"""First-order steps over which the cost must stay as it is."""


def run(name, problem, state, stage):
    """One stage of the solver of this name: state, its cost, steps and result.

    A state that is not finite, or whose cost is not, is not returned: the one that the
    stage began with is.
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
    if count * unknowns > DENSE_LIMIT:
        raise ValueError(
            f"solver: {name} is for small problems, as its Jacobian is dense: found "
            f"{count:,} residuals by {unknowns:,} unknowns ({len(state.cameras)} "
            f"frames, {len(state.landmarks)} landmarks), expected a product below "
            f"{DENSE_LIMIT:,}; use `structured` or `adam`."
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
        """With the motion predicted anew, and held."""
        return self.problem.cost(self.retract(step))


def _flat(problem, state):
    refreshed = problem.refresh(state)
    return _Flat(refreshed, state, mask_of(refreshed)), state.zero_step()


def _residual(step, flat):
    return flat.residual(step)


def _held_rows(step, flat):
    """Residuals, and rows that hold what no measurement sees: a dense system must not
    be singular."""
    held = jax.tree.map(lambda s: 1e-9 * s, step)
    return flat.residual(step), held


def optimistix_lm(problem, state, stage):
    """Stock Levenberg-Marquardt of optimistix, dense, by QR."""
    flat, zero = _flat(problem, state)
    method = optx.LevenbergMarquardt(
        rtol=stage.rtol, atol=stage.rtol, linear_solver=lx.QR()
    )
    found = optx.least_squares(
        _held_rows, method, zero, flat, max_steps=4 * stage.max_steps, throw=False
    )
    return flat.retract(found.value), found.stats["num_steps"], found.result


def optimistix_cg(problem, state, stage, inner_steps=500):
    """The same with conjugate gradients on the normal equations, of unknowns in units
    in which each matters as much: they do not converge in others."""
    flat, zero = _flat(problem, state)
    unit = _units(flat, zero)
    inner = lx.Normal(lx.CG(rtol=1e-6, atol=1e-6, max_steps=inner_steps))
    method = optx.LevenbergMarquardt(
        rtol=stage.rtol, atol=stage.rtol, linear_solver=inner
    )
    found = optx.least_squares(
        _scaled_rows, method, zero, (flat, unit), max_steps=stage.max_steps, throw=False
    )
    step = jax.tree.map(jnp.multiply, unit, found.value)
    return flat.retract(step), found.stats["num_steps"], found.result


def _scaled_rows(step, given):
    flat, unit = given
    return _held_rows(jax.tree.map(jnp.multiply, unit, step), flat)


PROBES = 64


@eqx.filter_jit
def _units(flat, zero):
    """One over the lengths of the columns of the Jacobian, by random signs: to about a
    tenth."""
    residual, pull = jax.vjp(flat.residual, zero)
    keys = jax.random.split(jax.random.key(0), PROBES)
    signs = lambda key: jax.random.rademacher(key, residual.shape, residual.dtype)
    squares = jax.lax.map(
        lambda key: jax.tree.map(jnp.square, pull(signs(key))[0]), keys
    )
    unit = lambda s: jnp.where(s.mean(0) > 0, jax.lax.rsqrt(s.mean(0)), 1.0)
    return jax.tree.map(unit, squares)


def jaxopt_lm(problem, state, stage):
    """Levenberg-Marquardt of jaxopt, dense."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        import jaxopt
    flat, zero = _flat(problem, state)
    start, unravel = ravel_pytree(zero)
    arrays, static = eqx.partition(flat, eqx.is_array)

    def residual(x, arrays):
        whole = eqx.combine(arrays, static)
        return jnp.concatenate([whole.residual(unravel(x)), 1e-9 * x])

    # Of the largest slope at the start: by itself it depends on what costs are of.
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
    # jaxopt multiplies truth values and numbers.
    with jax.numpy_dtype_promotion("standard"):
        found = method.run(start, arrays)
    # Where rounding lets no step lower the cost, it tries ever shorter ones.
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
    """First-order steps, as the paper took: `stage.max_steps` of them.

    Converged is what has kept its cost, within the stage's tolerance, for a while: the
    steps are of fixed length and never end by themselves.
    """
    state, costs = adam_curve(problem, state, stage, ADAM_RATE)
    finite, settled = jnp.isfinite(costs), jnp.array(False)
    if len(costs) >= SETTLED:
        enough = jnp.maximum(stage.rtol * costs[-1], stage.atol)
        settled = jnp.ptp(costs[-SETTLED:]) <= enough
    result = _result(settled)
    result = optx.RESULTS.where(finite.all(), result, optx.RESULTS.nonfinite)
    return state, finite.sum(), result


def adam_curve(problem, state, stage, rate, *, decays=False):
    """The state after these steps, and the cost before each; `decays`: the rate falls
    to 0 as a cosine does. Where the cost is not finite the steps end."""
    flat, zero = _flat(problem, state)
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
        # optax takes powers of Python's numbers.
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
