"""The result of `solve`: state, status, cost and history."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from bodyslam_jax.graph import State
from bodyslam_jax.solver.levenberg_marquardt import Final, History

_STATUS_BY_RESULT = (
    (optx.RESULTS.successful, "converged"),
    (optx.RESULTS.nonlinear_max_steps_reached, "ran out of steps"),
    (optx.RESULTS.nonfinite, "cost is not finite"),
)
_DIVERGENCE_STATUS = "no step lowers the cost"
_BETTER_SCALE_STATUS = "converged, but a better scale is known: {:.6g}"


class Solution(eqx.Module):
    """The best state found, and how the solve ended.

    A failure is reported by `status`. The state is finite, unless the start was not,
    within `jit` or `vmap`: such a start is returned as it is.
    """

    state: State
    result: optx.RESULTS
    cost: Float[Array, ""]
    """Negative log-likelihood at `state`."""
    histories: tuple[History, ...]
    """History of each stage."""
    num_steps: tuple[Array, ...]
    """Iterations of each stage, accepted or not."""
    first_cost: Float[Array, ""]
    """Negative log-likelihood at the start, with the motion predicted there."""
    better_scale: Float[Array, ""] = eqx.field(
        default_factory=lambda: jnp.array(jnp.nan)
    )
    """Another s with a lower cost, all else as in `state`; NaN if none is known."""

    @property
    def status(self) -> str | np.ndarray:
        """Returns `converged`, or the reason of failure; an array of such for mapped
        solves. Where robust losses leave several scales, it says if a better one is
        known."""
        found = np.array(_DIVERGENCE_STATUS)
        for result, words in _STATUS_BY_RESULT:
            found = np.where(self.result == result, words, found)
        better = np.asarray(self.better_scale)
        known = [_BETTER_SCALE_STATUS.format(x) for x in better.ravel()]
        other = np.isfinite(better) & (found == "converged")
        found = np.where(other, np.reshape(known, better.shape), found)
        return found if found.ndim else str(found)


def is_finite(state: State) -> Bool[Array, ""]:
    """Returns True if every array of the state is finite."""
    return jnp.isfinite(ravel_pytree(state)[0]).all()


def outcome(start, best, result, stats) -> tuple[Solution, Final]:
    """Converts the result of the loop; the start, if no cost was finite."""
    better = jnp.isfinite(stats["cost"]) & is_finite(best)
    best = jax.tree.map(lambda new, old: jnp.where(better, new, old), best, start)
    # A coordinate that no measurement sees may be NaN while the cost is finite.
    result = optx.RESULTS.where(is_finite(best), result, optx.RESULTS.nonfinite)
    stages = range(len(stats["steps"]))
    histories = tuple(jax.tree.map(lambda x: x[i], stats["history"]) for i in stages)
    counts = tuple(stats["steps"][i] for i in stages)
    solution = Solution(
        state=best,
        result=result,
        cost=stats["cost"],
        histories=histories,
        num_steps=counts,
        first_cost=stats["first_cost"],
        better_scale=stats["better_scale"],
    )
    return solution, stats["final"]


def only(solution: Solution, count: int) -> Solution:
    """Returns the solution without the idle stages that pad a schedule."""
    return dataclasses.replace(
        solution,
        histories=solution.histories[:count],
        num_steps=solution.num_steps[:count],
    )
