"""Stock solvers, as cross-checks and to be measured against; for small problems.

They see a flat step from the first state (poses do not add, steps do) and the lifted
residuals; the motion model's prediction stays as it is at the start, but for what is
coupled, which they differentiate in full.
"""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optax
import optimistix as optx
from jax.flatten_util import ravel_pytree

from bodyslam_jax.graph import Problem, State, Step
from bodyslam_jax.solver._blocks import mask_of
from bodyslam_jax.solver._levenberg_marquardt import lifted

ADAM_RATE = 1e-2


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
        rows = lifted(place, self.problem.follow(place))
        return jnp.concatenate([r.reshape(-1) for r in rows])

    def cost(self, step):
        place = self.retract(step)
        return self.problem.follow(place).cost(place)


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


def optimistix(problem, state, stage):
    """Stock Levenberg-Marquardt of optimistix, dense, by QR."""
    flat, zero = _flat(problem, state)
    method = optx.LevenbergMarquardt(
        rtol=stage.rtol, atol=stage.rtol, linear_solver=lx.QR()
    )
    found = optx.least_squares(
        _held_rows, method, zero, flat, max_steps=4 * stage.max_steps, throw=False
    )
    return flat.retract(found.value), found.stats["num_steps"], found.result


def optimistix_cg(problem, state, stage):
    """The same with conjugate gradients on the normal equations."""
    flat, zero = _flat(problem, state)
    inner = lx.Normal(lx.CG(rtol=1e-6, atol=1e-6, max_steps=500))
    method = optx.LevenbergMarquardt(
        rtol=stage.rtol, atol=stage.rtol, linear_solver=inner
    )
    found = optx.least_squares(
        _held_rows, method, zero, flat, max_steps=stage.max_steps, throw=False
    )
    return flat.retract(found.value), found.stats["num_steps"], found.result


def jaxopt_lm(problem, state, stage):
    """Levenberg-Marquardt of jaxopt, dense."""
    return _jaxopt("LevenbergMarquardt", problem, state, stage)


def jaxopt_gn(problem, state, stage):
    """Gauss-Newton of jaxopt."""
    return _jaxopt("GaussNewton", problem, state, stage)


def _jaxopt(name, problem, state, stage):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        import jaxopt
    flat, zero = _flat(problem, state)
    start, unravel = ravel_pytree(zero)
    arrays, static = eqx.partition(flat, eqx.is_array)

    def residual(x, arrays):
        whole = eqx.combine(arrays, static)
        return jnp.concatenate([whole.residual(unravel(x)), 1e-9 * x])

    options = {"maxiter": 4 * stage.max_steps, "tol": 1e-10}
    if name == "LevenbergMarquardt":
        options |= {"solver": "cholesky", "materialize_jac": True, "xtol": 1e-14}
    method = getattr(jaxopt, name)(residual, **options)
    # jaxopt multiplies truth values and numbers.
    with jax.numpy_dtype_promotion("standard"):
        found = method.run(start, arrays)
    count = found.state.iter_num
    return flat.retract(unravel(found.params)), count, optx.RESULTS.successful


def adam(problem, state, stage):
    """First-order steps, as the paper took: `stage.max_steps` of them."""
    flat, zero = _flat(problem, state)
    found = _adam(flat, zero, stage.max_steps)
    return flat.retract(found), jnp.array(stage.max_steps), optx.RESULTS.successful


@eqx.filter_jit
def _adam(flat, start, count):
    method = optax.adam(ADAM_RATE)

    def one(carry, _):
        step, memory = carry
        gradient = jax.grad(flat.cost)(step)
        # optax takes powers of Python's numbers.
        with jax.numpy_dtype_promotion("standard"):
            change, memory = method.update(gradient, memory)
        return (optax.apply_updates(step, change), memory), None

    (step, _), _ = jax.lax.scan(one, (start, method.init(start)), length=count)
    return step
