"""Standing feet are held, after the joint estimate: only roots and poses change.

Which points of the feet stand is read from the postures of the joint estimate
(`motion.contact_network`). Then people's roots and poses are estimated once more with
the same factors, the one of standing points (`graph.FootContact`), and a larger weight
of their height over the map's plane. Cameras, map,
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

_HEIGHT_SIGMA = 0.08
"""Standard deviation of the height of the lower foot over the plane, m in a frame of
1/30 s: 2 cm in a stance, in which its error lasts."""
_SCATTER = 0.04
"""Scatter of these heights from which the plane counts less, m: more than estimates
have on level ground."""
_FEWEST_FRAMES = 10
"""With standing feet, for a plane to be shifted to their height."""


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
    factors = [
        stand_on_plane(f, best, np.asarray(probability), sequence.fps)
        if isinstance(f, graph.GroundContact)
        else f
        for f in factors
    ]
    problem = graph.make_problem(
        [*factors, contact], start, motion=prepared.problem.motion, free=free
    )
    solution, stage = solve_stage(problem, start, config, "standing feet")
    found = solution.state
    moved = dataclasses.replace(best, roots=found.roots, poses=found.poses)
    valid = bool(jnp.isfinite(found.roots).all() & jnp.isfinite(found.poses).all())
    return Standing(moved if valid else best, np.asarray(probability), (stage,))


def stand_on_plane(
    contact: graph.GroundContact,
    state: graph.State,
    probability: Float[np.ndarray, "h t 4"],
    fps: float,
) -> graph.GroundContact:
    """The factor of the map's ground plane, with the weight of heights over it.

    At constant scale it says how far away people are, so that short steps of estimated
    postures cannot bring them nearer. The plane is shifted to the median height of
    standing feet, and believed only as far as it explains them: σ grows with their
    scatter, and frames far from it, on a step or a kerb, have no weight.
    """
    bare = eqx.tree_at(lambda f: f.sigma, contact, jnp.ones_like(contact.sigma))
    height = np.asarray(graph.residual_of(bare, state))[..., 0]
    stands = probability.max(axis=-1)
    used = np.isfinite(np.asarray(contact.sigma)) & (stands > 0.5)
    if used.sum() < _FEWEST_FRAMES:
        return contact
    offset = float(np.median(height[used]))
    away = np.abs(height - offset)
    spread = max(1.4826 * float(np.median(away[used])) / _SCATTER, 1.0)
    near = used & (away < 3 * spread * _SCATTER)
    sigma = _HEIGHT_SIGMA * spread * np.sqrt(fps / 30.0)
    sigma = np.where(near, sigma / np.sqrt(np.maximum(stands, 0.5)), np.inf)
    plane = contact.plane.at[3].add(-offset / state.scale)
    return eqx.tree_at(
        lambda f: (f.plane, f.sigma),
        contact,
        (plane, jnp.asarray(sigma, contact.sigma.dtype)),
    )


def _of_motion(factor: graph.Factor) -> bool:
    """Whether a factor depends on people's roots or poses."""
    if not isinstance(factor, graph.FrameFactor):
        return False
    return any(name in ("root", "pose") for name, _ in factor.keys)
