"""Standing feet are held, after the joint estimate: only roots and poses change.

Which points of the feet stand is read from the postures of the joint estimate
(`motion.contact_network`). Then people's roots and poses are estimated once more with
the same factors and the one of standing points (`graph.FootContact`). Cameras, map,
scale and shapes are constants: thousands of landmarks and the size of the person
determine them, and steps would stretch them by the errors of postures. The problem has
no landmarks, so that videos of about the same length share its program.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bodyslam_jax import graph, initialisation
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import Config
from bodyslam_jax.pipeline.joint_problem import Prepared
from bodyslam_jax.pipeline.motion_prediction import contact_predictor, predict
from bodyslam_jax.pipeline.solve_stage import solve_stage
from bodyslam_jax.types import Sequence, SfmResult


@dataclasses.dataclass(frozen=True)
class Standing:
    """People whose feet stand still."""

    state: graph.State
    probability: Float[np.ndarray, "h t 4"] | None = None
    """That left toe, left heel, right toe and right heel stand; `None` if unknown."""
    stages: tuple[dict, ...] = ()
    """Report entries of what was solved."""


def hold_standing_feet(
    prepared: Prepared,
    best: graph.State,
    sequence: Sequence,
    cameras: SfmResult,
    body: BodyModel,
    config: Config,
) -> Standing:
    """The optimum `best` of the joint problem with roots and poses estimated anew.

    Nothing changes without people, without `weights.contact_sigma`, or with a body
    model that the contact network was not trained on.
    """
    roots, weights = prepared.roots, config.weights
    present = roots.present & cameras.registered
    if not weights.contact_sigma or not present.any():
        return Standing(best)
    predictor = contact_predictor(sequence, roots, body)
    if predictor.model[0].body != body.kind:
        return Standing(best)
    probability = predict(predictor, best)
    present[list(prepared.passengers)] = False
    contact = initialisation.contact_factor(
        probability, best, present, sequence.fps, body, weights
    )
    start = eqx.tree_at(lambda s: s.landmarks, best, best.landmarks[:0])
    free = graph.set_constant(initialisation.free_people(start), "shapes")
    factors = [f for f in prepared.problem.factors if _of_motion(f)]
    problem = graph.make_problem(
        [*factors, contact], start, motion=prepared.problem.motion, free=free
    )
    solution, stage = solve_stage(problem, start, config, "standing feet")
    found = solution.state
    moved = dataclasses.replace(best, roots=found.roots, poses=found.poses)
    valid = bool(jnp.isfinite(found.roots).all() & jnp.isfinite(found.poses).all())
    return Standing(moved if valid else best, np.asarray(probability), (stage,))


def _of_motion(factor: graph.Factor) -> bool:
    """Whether a factor depends on people's roots or poses."""
    if not isinstance(factor, graph.FrameFactor):
        return False
    return any(name in ("root", "pose") for name, _ in factor.keys)
