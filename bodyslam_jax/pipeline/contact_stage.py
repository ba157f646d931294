"""Holds standing feet after the joint estimate: only roots and poses change.

The contact network (`motion.contact_network`) infers from the postures of the joint
estimate which points of the feet are in contact. Then people's roots and poses are
estimated again with the same factors, the factor of contact points
(`graph.FootContact`), and a larger weight of their height over the ground of the map.
Cameras, map, scale and shapes are constants: thousands of landmarks and the size of the
person determine them, and contact would distort them by the errors of postures.

The factor of contact points is in the joint problem from the beginning, without weight,
so that both solves share one compiled program.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bodyslam_jax import graph, initialisation, motion
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import Config
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry.arrays import SIGMA_OF_MEDIAN
from bodyslam_jax.ground.heights import wander
from bodyslam_jax.ground.plane import MAX_HEIGHT_SCATTER_M
from bodyslam_jax.pipeline.joint_problem import Prepared, solve_stage
from bodyslam_jax.pipeline.motion_prediction import (
    contact_predictor,
    contact_probability,
)
from bodyslam_jax.types import Sequence, SfmResult

_HEIGHT_SIGMA_M = 0.08
"""Standard deviation of the height of the lower foot over the ground in a frame of
1/30 s, m: it is 2 cm for a stance, during which the error is constant."""
_MIN_STANDING_FRAMES = 10
"""Least number of frames with standing feet for the ground to be shifted to their
height."""


@dataclasses.dataclass(frozen=True)
class Standing:
    """People with standing feet held."""

    state: graph.State
    probability: Float[np.ndarray, "h t 4"] | None = None
    """Contact probabilities of left toe, left heel, right toe and right heel; 0 where
    legs are not observed; `None` if unknown."""
    stages: tuple[dict, ...] = ()
    """Report entries of the solves."""


def hold_standing_feet(
    prepared: Prepared,
    best: graph.State,
    sequence: Sequence,
    cameras: SfmResult,
    body: BodyModel,
    config: Config,
) -> Standing:
    """Estimates roots and poses again, from the optimum `best` of the joint problem,
    with standing feet held.

    Nothing changes without people, without `weights.contact_sigma`, or with a body
    model that the contact network was not trained on.

    **Raises:** `InputError` if `prepared` was made with `feet=False`.
    """
    roots = prepared.roots
    present = roots.present & cameras.registered
    predictor = contact_predictor(sequence, roots, body, config)
    if predictor is None or not present.any():
        return Standing(best)
    if not any(isinstance(f, graph.FootContact) for f in prepared.problem.factors):
        raise InputError(
            "prepared.problem.factors: no FootContact; expected a problem of "
            "`prepare(..., feet=True)`."
        )
    probability = contact_probability(predictor, best, sequence.fps)
    if prepared.legs_shown is not None:
        probability = np.where(prepared.legs_shown[..., None], probability, 0.0)
    present[list(prepared.passengers)] = False
    contact = initialisation.contact_factor(
        jnp.asarray(probability), best, present, sequence.fps, body, config.weights
    )
    alone = graph.disable(prepared.problem, graph.Reprojection, graph.LandmarkPrior)

    def weighed(factor: graph.Factor) -> graph.Factor:
        if isinstance(factor, graph.FootContact):
            return contact
        if isinstance(factor, graph.GroundContact):
            return stand_on_plane(factor, best, probability, sequence.fps)
        return factor

    held = ("scale", "cameras", "landmarks", "intrinsics", "shapes", "globals")
    problem = dataclasses.replace(
        alone,
        factors=tuple(weighed(factor) for factor in alone.factors),
        free=graph.set_constant(alone.free, *held),
    )
    solution, stage = solve_stage(problem, best, config, "standing feet")
    found = solution.state
    moved = dataclasses.replace(best, roots=found.roots, poses=found.poses)
    valid = bool(jnp.isfinite(found.roots).all() & jnp.isfinite(found.poses).all())
    return Standing(moved if valid else best, probability, (stage,))


def stand_on_plane(
    contact: graph.GroundContact,
    state: graph.State,
    probability: Float[np.ndarray, "h t 4"],
    fps: float,
) -> graph.GroundContact:
    """Returns the ground factor with sigmas of the heights of standing feet over it.

    At constant scale these heights determine the distance of people from the camera;
    otherwise held feet with underestimated steps would move them nearer. The ground is
    shifted to the median height of standing feet, that of climbers to their own, and
    weighted by how well it explains them: where they rise and sink over seconds
    (`wander`), it follows them, and σ grows with the remaining scatter; frames far from
    it, on a step or a kerb, have no weight.
    """
    climbs = np.asarray(contact.height).any(axis=1)
    none = jnp.zeros_like(contact.height)
    bare = eqx.tree_at(
        lambda f: (f.sigma, f.height), contact, (jnp.ones_like(contact.sigma), none)
    )
    height = np.asarray(graph.residual_of(bare, state))[..., 0]
    stands = probability.max(axis=-1)
    used = np.isfinite(np.asarray(contact.sigma)) & (stands > 0.5)
    if used.sum() < _MIN_STANDING_FRAMES:
        return contact
    level = np.zeros((len(used), 1))
    for group in (~climbs, *np.eye(len(used), dtype=bool)[climbs]):
        feet = height[group][used[group]]
        level[group] = np.median(feet) if len(feet) else 0.0
    offset = level + wander(height, used, fps)[0]
    away = np.abs(height - offset)
    spread = max(
        SIGMA_OF_MEDIAN * float(np.median(away[used])) / MAX_HEIGHT_SCATTER_M, 1.0
    )
    near = used & (away < 3 * spread * MAX_HEIGHT_SCATTER_M)
    # Of a frame of 1/30 s, constant over a stance: variances grow with the rate.
    sigma = _HEIGHT_SIGMA_M * spread * np.sqrt(fps / motion.FPS)
    sigma = np.where(near, sigma / np.sqrt(np.maximum(stands, 0.5)), np.inf)
    shifted = np.asarray(contact.offset) - offset / float(state.scale)
    return eqx.tree_at(
        lambda f: (f.offset, f.sigma),
        bare,
        (
            jnp.asarray(shifted, contact.offset.dtype),
            jnp.asarray(sigma, contact.sigma.dtype),
        ),
    )
