"""State, history and final equations of the solver's loop."""

from typing import Any

import equinox as eqx
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from bodyslam_jax.solver.block_cholesky import Factor
from bodyslam_jax.solver.blocks import Linearisation, Observations
from bodyslam_jax.solver.elimination.person import RootFactor


class History(eqx.Module):
    """One row an iteration, of which the first `num_steps` are filled.

    Times are not recorded: the loop is one compiled program (see `clock`).
    """

    cost: Float[Array, "*s _"]
    """Cost before each iteration, and after the last."""
    terms: Float[Array, "*s _ k"]
    """Cost by factor, in the order of the problem."""
    damping: Float[Array, "*s n"]
    step: Float[Array, "*s n"]
    """Length of the step in standard deviations: `sqrt(δ^T diag(H) δ)`."""
    accepted: Bool[Array, "*s n"]


class Final(eqx.Module):
    """The factorised normal equations, barely damped, where the solver stopped."""

    lin: Linearisation
    """Without the second-order term of keypoints, which `factor` may include."""
    factor: Factor
    roots: RootFactor | None
    """Factor of the people's roots that were eliminated within chunks."""


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
