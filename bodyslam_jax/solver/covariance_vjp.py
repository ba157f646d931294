"""Covariances as a function of problem and state that can be differentiated.

`marginals` takes its equations from the loop that `solve` has compiled, and a loop of
unknown length has no derivative backwards. Here are the same equations without it, for
the derivative alone: they take a compilation of their own.
"""

import equinox as eqx
import jax
import jax.numpy as jnp

from bodyslam_jax.graph import Problem, State
from bodyslam_jax.solver.blocks import Linearisation, Sizes, sizes_of
from bodyslam_jax.solver.compilation import in_full_precision
from bodyslam_jax.solver.levenberg_marquardt import final_of
from bodyslam_jax.solver.linear_system import UNSEEN, damped, diagonals, eliminate
from bodyslam_jax.solver.linearise import linearise
from bodyslam_jax.solver.linearise.landmark import gather
from bodyslam_jax.solver.lm_state import Final
from bodyslam_jax.solver.second_order import add_second_order, curvature_of
from bodyslam_jax.solver.step import little


@in_full_precision
def equations(problem: Problem, state: State) -> Final:
    """What the loop leaves after its last factorisation, of a padded problem."""
    problem = problem.with_prediction(problem.predict(state))
    sizes = sizes_of(problem, state)
    lin = linearise(problem, gather(problem), state, sizes.dtype)
    lin = _bent(problem, lin, state, sizes)
    return final_of(lin, eliminate(problem, lin, sizes, _damping(lin, sizes)))


def _damping(lin: Linearisation, sizes: Sizes) -> dict:
    return damped(
        diagonals(lin, sizes), jnp.asarray(little(sizes.dtype), sizes.dtype), UNSEEN
    )


def _bent(
    problem: Problem, lin: Linearisation, state: State, sizes: Sizes
) -> Linearisation:
    """With the curvature of keypoints where there is an inverse, as in the loop."""
    bent = add_second_order(lin, curvature_of(problem, lin, state, sizes))
    tried = jax.lax.stop_gradient(bent)
    factor = eliminate(problem, tried, sizes, _damping(tried, sizes)).factor
    sound = jnp.all(jnp.isfinite(factor.half))
    # A sum, not a choice of factorisations: that which fails would spread its NaN.
    mixed = lambda a, b: a + jnp.where(sound, b - a, 0.0).astype(a.dtype)
    return jax.tree.map(
        lambda a, b: mixed(a, b) if eqx.is_inexact_array(a) else a, lin, bent
    )
