"""Computes the rows of `bodyslam experiment scale`: recovery of a perturbed scale
(section 4.2).

The input is a `Case`; the output are, for each perturbation, s and H-ATE after each
iteration of a solve in which people alone determine the scale (appendix D).
"""

import dataclasses
import functools
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bodyslam_jax import graph, solver
from bodyslam_jax.evaluation import Trajectories, evaluate_trajectories
from bodyslam_jax.experiments.scenario import with_scale, without_map
from bodyslam_jax.pipeline.case import Case, trajectories

PERTURBATIONS = (5.0, 2.0, 1.0, 0.5, 0.2, 0.1)
"""The paper's values of 1/s', which the estimated s should reach."""
SCHEDULE = (
    solver.Stage(("scale", "roots"), max_steps=5, rtol=1e-4),
    solver.Stage(max_steps=30),
)


@dataclasses.dataclass(frozen=True)
class ScaleRecovery:
    """Result for `p` perturbations of one sequence, solved together in `n`
    iterations."""

    perturbation: Float[np.ndarray, " p"]
    """1/s': the scale s that undoes the perturbation."""
    scale: Float[np.ndarray, " p"]
    """Estimated s, relative to the unit of the perturbed map."""
    history: Float[np.ndarray, "p n"]
    """Scale s after each iteration, including the start."""
    h_ate: Float[np.ndarray, "p n"]
    """H-ATE under SE(3) after each iteration, m."""

    @property
    def deviation(self) -> Float[np.ndarray, " p"]:
        """Signed deviation `s / (1/s') - 1`, as in the paper."""
        return self.scale / self.perturbation - 1

    @property
    def spread(self) -> float:
        """Range of the estimates over their mean; 0 if the result is independent of the
        start."""
        answer = self.scale / self.perturbation
        return float(np.ptp(answer) / answer.mean())


def scale_recovery(
    case: Case,
    perturbations: Sequence[float] = PERTURBATIONS,
    *,
    schedule: tuple[solver.Stage, ...] = SCHEDULE,
    prepared: tuple[graph.Problem, graph.State] | None = None,
) -> ScaleRecovery:
    """Estimates s, starting at 1, for cameras of the true size that are scaled by `1/p`
    and held, for each `p` of `perturbations`.

    Only s and people are free, without landmarks. All perturbations are one solve that
    is mapped over start states and distributed over JAX's devices. The cameras are
    those of the pipeline (the paper uses motion capture), aligned to their true size by
    Sim(3). `prepared` gives the problem and its first state, for a caller who has them
    from `without_map` already.
    """
    if prepared is None:
        found = case.prepare()
        prepared = without_map(found.problem, found.state, hold_cameras=True)
    problem, state = prepared
    true_size = graph.rescaled(problem, with_scale(state, 1.0), case.map_scale)
    state, history = _recover(schedule)(
        jnp.asarray(perturbations),
        *true_size,
        case.truth,
        case.body,
        jnp.asarray(case.bodies.present),
        jnp.asarray(case.cameras.registered),
    )
    return ScaleRecovery(
        perturbation=np.array(perturbations),
        scale=np.asarray(state.scale),
        history=np.asarray(history["scale"]),
        h_ate=np.asarray(history["h_ate"]),
    )


@functools.cache
def _recover(schedule):
    """Returns one function per schedule, which compiles once for cases of one size."""
    one = functools.partial(_recover_one, schedule=schedule)
    return solver.vmap_over_devices(one, (0, *(None,) * 6))


def _recover_one(
    perturbation, problem, state, truth, body, present, registered, *, schedule
):
    start = graph.rescaled(problem, state, 1 / perturbation)
    observe = lambda y: {
        "scale": y.scale,
        "h_ate": _h_ate(y, truth, body, present, registered),
    }
    return solver.trace(*start, observe, schedule=schedule)


def _h_ate(state, truth: Trajectories, body, present, registered):
    estimate = trajectories(state, body, present, registered, truth.fps)
    return evaluate_trajectories(estimate, truth)["h_ate_se3"]
