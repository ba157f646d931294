"""What `solve` gives back."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from bodyslam_jax.graph import State
from bodyslam_jax.solver.lm_state import Final, History

_WORDS = (
    (optx.RESULTS.successful, "converged"),
    (optx.RESULTS.nonlinear_max_steps_reached, "ran out of steps"),
    (optx.RESULTS.nonfinite, "cost is not finite"),
)
_OTHERWISE = "no step lowers the cost"
_BETTER = "converged, but a better scale is known: {:.6g}"


class Solution(eqx.Module):
    """The best state found. What failed says so in `status`; a state is never NaN, but
    for a start within `jit` or `vmap` that was, which comes back as it is."""

    state: State
    result: optx.RESULTS
    cost: Float[Array, ""]
    """Negative log-likelihood at `state`."""
    histories: tuple[History, ...]
    """Of each stage."""
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
        """`converged`, or what kept it from that; of mapped solves an array of such.
        Where robust losses leave several scales, it says if a better one is known."""
        found = np.array(_OTHERWISE)
        for result, words in _WORDS:
            found = np.where(self.result == result, words, found)
        better = np.asarray(self.better_scale)
        known = [_BETTER.format(x) for x in better.ravel()]
        other = np.isfinite(better) & (found == "converged")
        found = np.where(other, np.reshape(known, better.shape), found)
        return found if found.ndim else str(found)


def is_finite(state: State) -> Bool[Array, ""]:
    """Whether all numbers of a state are."""
    leaves = [jnp.isfinite(x).all() for x in jax.tree.leaves(state)]
    return jnp.stack(leaves).all()


def outcome(start, best, result, stats) -> tuple[Solution, Final]:
    """What the loop leaves behind, as a solution; the start, if no cost was finite."""
    better = jnp.isfinite(stats["cost"]) & is_finite(best)
    best = jax.tree.map(lambda new, old: jnp.where(better, new, old), best, start)
    # A number that no measurement sees may be NaN from the start, and the cost not.
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
    """Without the idle stages that make all schedules one program."""
    return dataclasses.replace(
        solution,
        histories=solution.histories[:count],
        num_steps=solution.num_steps[:count],
    )
