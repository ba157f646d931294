"""Feet that stand are held still after the joint estimate: only roots and poses change.

Which points of the feet stand is read from the postures of the joint estimate
(`motion.contact_network`). Then people's roots and poses are estimated once more with
the same factors, the one of standing points (`graph.FootContact`), and a larger weight
of their height over the ground of the map. Cameras, map, scale and shapes are
constants: thousands of landmarks and the size of the person determine them, and steps
would stretch them by the errors of postures.

The factor of standing points is in the joint problem from the beginning, without
weight, so that both solves are one compiled program.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bodyslam_jax import graph, initialisation
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import Config
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry.local_ground import wander
from bodyslam_jax.pipeline.joint_problem import Prepared
from bodyslam_jax.pipeline.motion_prediction import (
    contact_predictor,
    contact_probability,
)
from bodyslam_jax.pipeline.solve_stage import solve_stage
from bodyslam_jax.types import Sequence, SfmResult

_HEIGHT_SIGMA = 0.08
"""Standard deviation of the height of the lower foot over the ground, m in a frame of
1/30 s: 2 cm in a stance, in which its error lasts."""
_SCATTER = 0.04
"""Scatter of these heights from which the ground counts less, m: more than estimates
have on level ground."""
_FEWEST_FRAMES = 10
"""With standing feet, for the ground to be shifted to their height."""


@dataclasses.dataclass(frozen=True)
class Standing:
    """People whose feet stand still."""

    state: graph.State
    probability: Float[np.ndarray, "h t 4"] | None = None
    """That left toe, left heel, right toe and right heel stand, 0 where legs are only
    guessed; `None` if unknown."""
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
    """The factor of the ground, with the weight of heights over it.

    At constant scale it says how far away people are, so that short steps of estimated
    postures cannot bring them nearer. The ground is shifted to the median height of
    standing feet, and believed only as far as it explains them: where they rise and
    sink over seconds (`wander`) it follows them, and its σ grows with what is left of
    their scatter; frames far from it, on a step or a kerb, have no weight.
    """
    bare = eqx.tree_at(lambda f: f.sigma, contact, jnp.ones_like(contact.sigma))
    height = np.asarray(graph.residual_of(bare, state))[..., 0]
    stands = probability.max(axis=-1)
    used = np.isfinite(np.asarray(contact.sigma)) & (stands > 0.5)
    if used.sum() < _FEWEST_FRAMES:
        return contact
    offset = float(np.median(height[used])) + wander(height, used, fps)[0]
    away = np.abs(height - offset)
    spread = max(1.4826 * float(np.median(away[used])) / _SCATTER, 1.0)
    near = used & (away < 3 * spread * _SCATTER)
    sigma = _HEIGHT_SIGMA * spread * np.sqrt(fps / 30.0)
    sigma = np.where(near, sigma / np.sqrt(np.maximum(stands, 0.5)), np.inf)
    shifted = np.asarray(contact.offset) - offset / float(state.scale)
    return eqx.tree_at(
        lambda f: (f.offset, f.sigma),
        contact,
        (
            jnp.asarray(shifted, contact.offset.dtype),
            jnp.asarray(sigma, contact.sigma.dtype),
        ),
    )
