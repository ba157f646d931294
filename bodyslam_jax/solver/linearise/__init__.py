"""The normal equations at a state: `J^T J` and `J^T r`, formed where they are not 0.

Factors over frames give blocks between variables of nearby frames
(`linearise/frame.py`), landmarks dense tables, frames by landmarks of a group
(`linearise/landmark.py`).
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from bodyslam_jax.graph import (
    FrameFactor,
    LandmarkPrior,
    MarginalPrior,
    Problem,
    Reprojection,
    State,
)
from bodyslam_jax.solver.blocks import Linearisation, Observations, Sums, sizes_of
from bodyslam_jax.solver.linearise.frame import Rows, add_products, rows_of
from bodyslam_jax.solver.linearise.landmark import add_prior, linearise_landmarks
from bodyslam_jax.solver.linearise.marginal_prior import linearise_marginal_prior


@eqx.filter_jit
def linearise(
    problem: Problem,
    observations: Observations | None,
    state: State,
    dtype: np.dtype | None = None,
) -> Linearisation:
    """Returns all blocks at a state; held coordinates have zero rows and columns.

    Blocks are kept in `dtype`; landmarks' own blocks, gradients and costs in the
    state's.
    """
    sums = Sums(sizes_of(problem, state, dtype), state)
    landmarks, priors, marginal = (), [], None
    rows: list[Rows] = []
    for factor in problem.factors:
        if isinstance(factor, Reprojection):
            landmarks = linearise_landmarks(problem, factor, observations, state, sums)
        elif isinstance(factor, LandmarkPrior):
            priors.append(factor)
            sums.costs.append(factor.cost(state))
        elif isinstance(factor, MarginalPrior):
            marginal = linearise_marginal_prior(problem, factor, state, sums)
        elif isinstance(factor, FrameFactor):
            rows += rows_of(problem, factor, state, sums)
    add_products(sums, rows)
    for prior in priors:
        landmarks = add_prior(problem, prior, state, landmarks)
    return Linearisation(
        sums.blocks,
        sums.gradient,
        *sums.globals(),
        landmarks,
        jnp.stack(sums.costs),
        marginal,
    )
