"""What the solver carries from one iteration to the next, and what it leaves."""

from typing import Any

import equinox as eqx
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from bodyslam_jax.solver.block_cholesky import Factor
from bodyslam_jax.solver.blocks import Linearisation, Observations
from bodyslam_jax.solver.elimination.person import RootFactor


class History(eqx.Module):
    """One entry an iteration, of which the first `num_steps` are filled.

    Time is not among them: the loop is one compiled program (see `clock`).
    """

    cost: Float[Array, "*s _"]
    """Before each iteration, and after the last."""
    terms: Float[Array, "*s _ k"]
    """By factor, in the order of the problem."""
    damping: Float[Array, "*s n"]
    step: Float[Array, "*s n"]
    """Length of the step in standard deviations: `sqrt(δ^T diag(H) δ)`."""
    accepted: Bool[Array, "*s n"]


class Final(eqx.Module):
    """The normal equations where the solver stopped, hardly damped, factorised."""

    lin: Linearisation
    """Without what keypoints bend (`_curvature`), which the factor may have."""
    factor: Factor
    roots: RootFactor | None
    """Of the people's roots that were eliminated within chunks."""


class Loop(eqx.Module):
    """The state of `StructuredLevenbergMarquardt` between two iterations."""

    stage: Int[Array, ""]
    """That runs now; the number of stages in the last rounds, which tell the cost, and
    factorise for covariances."""
    prediction: Any
    observations: Observations | None
    final: Final
    stale: Bool[Array, ""]
    """Whether `final.lin` is of an earlier state or stage."""
    damping: Float[Array, ""]
    landmark_damping: Float[Array, " l"]
    """Damping that landmarks have at least, each by itself."""
    searched: Int[Array, ""]
    """How often landmarks were triangulated anew in this stage."""
    nu: Float[Array, ""]
    cost: Float[Array, ""]
    first_cost: Float[Array, ""]
    better_scale: Float[Array, ""]
    """Another s with a lower cost where the solve ended; NaN if none is known."""
    steps: Int[Array, " s"]
    share: Float[Array, ""]
    """Of what keypoints bend (`_curvature`), in the next step."""
    bent: Bool[Array, ""]
    """Whether the last factorisation is to have all of that."""
    finished: Bool[Array, ""]
    result: optx.RESULTS
    history: History
