"""Uneven ground, estimated anew where the joint estimate has people and map.

The ground under a foot is where the ray through the foot meets the landmarks. Its first
estimate uses people and landmarks from before the joint estimate. A second one, at the
optimum, is a fixed point: a third changes scale by less than 0.1 %. A plane has it from
the beginning, so only ground that is not a plane is estimated again
(`benchmarks/contact.md`).
"""

import dataclasses

import numpy as np
from jaxtyping import Bool

from bodyslam_jax import graph, initialisation
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import GraphWeights
from bodyslam_jax.pipeline.joint_problem import Prepared
from bodyslam_jax.types import Keypoints


def with_ground_of(
    state: graph.State,
    prepared: Prepared,
    registered: Bool[np.ndarray, " t"],
    keypoints: Keypoints | None,
    body: BodyModel,
    weights: GraphWeights,
    fps: float,
) -> Prepared:
    """The same problem with the ground under people where `state` has it; `prepared`
    itself if there is no ground, or not enough of it any more."""
    factors = prepared.problem.factors
    old = next((f for f in factors if isinstance(f, graph.GroundContact)), None)
    present = prepared.roots.present & registered
    if prepared.legs_shown is not None:
        present = present & prepared.legs_shown
    contact = initialisation.ground_contact(
        state, present, keypoints, body, weights, fps
    )
    if old is None or contact is None:
        return prepared
    contact = initialisation.with_wander(contact, state, fps)
    changed = tuple(contact if factor is old else factor for factor in factors)
    return dataclasses.replace(
        prepared, problem=dataclasses.replace(prepared.problem, factors=changed)
    )


def is_uneven(problem: graph.Problem) -> bool:
    """Whether people stand on ground that is not one plane."""
    grounds = [f for f in problem.factors if isinstance(f, graph.GroundContact)]
    used = [np.asarray(f.offset)[np.isfinite(np.asarray(f.sigma))] for f in grounds]
    return any(len(offset) > 0 and np.ptp(offset) > 0 for offset in used)
