"""The first scale in closed form: from how people move, and from where they stand."""

import dataclasses
from collections.abc import Collection

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool

from bodyslam_jax import graph, motion
from bodyslam_jax.body import BodyModel
from bodyslam_jax.body.skeleton import BODY25_ANKLES_AND_FEET
from bodyslam_jax.config import PATH_SIGMA, GraphWeights
from bodyslam_jax.geometry.ground_plane import find_ground
from bodyslam_jax.initialisation.upright import mean_up
from bodyslam_jax.people import PersonState
from bodyslam_jax.types import Keypoints, ScaleStart

_SEEN = 0.2
"""Confidence from which a keypoint of the feet counts as seen."""
_STEADY = 0.3
"""How far the scale under single feet may vary, between quartiles: on stairs, or where
the plane is not what people stand on, it varies more."""


def scale_start(
    state: graph.State,
    seen: motion.Prediction,
    contact: graph.GroundContact | None,
    *,
    shared_error: float = 0.0,
    path: float = float("nan"),
    without: Collection[int] = (),
) -> ScaleStart:
    """The cues of scale: motion, the ground and a metric camera path if there are any.

    Args:
        shared_error: the share by which all steps may be wrong together.
        path: m per unit of the map, as the path has it; NaN without one.
        without: people whose motion says nothing.
    """
    start = _motion_scale(state, seen, without)
    if np.isfinite(path):
        start = dataclasses.replace(start, path=path, path_error=PATH_SIGMA * path)
    error = float(np.hypot(start.motion_error, shared_error * start.motion))
    start = dataclasses.replace(start, motion_error=error)
    if contact is None:
        return start
    used = np.isfinite(np.asarray(contact.sigma))
    ground = float(np.median(np.asarray(_scales(contact, state))[used]))
    # Metres by which the ground may be off, over units from it to the camera.
    metres = float(np.sum(np.asarray(contact.sigma) ** -2.0)) ** -0.5
    units = state.cameras[:, :3, 3] @ contact.plane[:3] + contact.plane[3]
    error = metres / float(np.median(np.asarray(units)))
    return dataclasses.replace(start, ground=ground, ground_error=error)


def ground_contact(
    state: graph.State,
    roots: PersonState,
    registered: Bool[np.ndarray, " t"],
    keypoints: Keypoints | None,
    body: BodyModel,
    weights: GraphWeights,
) -> graph.GroundContact | None:
    """People stand on the map's ground, where their feet are seen; `None` without one.

    Up is where people's trunks point on average.
    """
    there = roots.present & registered
    if keypoints is not None:
        feet = keypoints.confidence[:, :, BODY25_ANKLES_AND_FEET]
        there &= (feet > _SEEN).any(axis=-1)
    if weights.ground_sigma is None or there.sum() < 2:
        return None
    plane = find_ground(
        np.asarray(state.landmarks),
        np.asarray(state.cameras[:, :3, 3]),
        mean_up(state, there),
    )
    if plane is None:
        return None
    sigma = np.where(there, weights.ground_sigma * np.sqrt(there.sum()), np.inf)
    contact = graph.GroundContact(body, jnp.asarray(plane), jnp.asarray(sigma))
    every = np.asarray(_scales(contact, state))[there]
    low, middle, high = np.quantile(every, [0.25, 0.5, 0.75])
    return contact if low > 0 and high - low < _STEADY * middle else None


_scales = eqx.filter_jit(lambda contact, state: contact.scales(state))


def _motion_scale(
    state: graph.State, seen: motion.Prediction, without: Collection[int]
) -> ScaleStart:
    """Robust regression of predicted on observed displacements, people averaged."""
    C_WC, r_WC = state.cameras[:, :3, :3], state.cameras[:, :3, 3]
    turn = C_WC @ state.roots[..., :3, :3]
    offset = jnp.einsum("tij,htj->hti", C_WC, state.roots[..., :3, 3])
    found = []
    for h in range(len(state.roots)):
        if h in without:
            continue
        one = jax.tree.map(lambda x: x[h], seen)
        found.append(motion.scale_from_motion(one, turn[h], r_WC, offset[h]))
    usable = [f for f in found if np.isfinite(f.value) and f.value > 0]
    if not usable:
        return ScaleStart()
    errors = np.array([f.standard_error for f in usable])
    errors = np.where(
        np.isfinite(errors), errors, 0.5 * np.array([f.value for f in usable])
    )
    weight = 1 / np.maximum(errors, 1e-6) ** 2
    value = float(np.sum(weight * [f.value for f in usable]) / weight.sum())
    return ScaleStart(value, float(weight.sum() ** -0.5))
