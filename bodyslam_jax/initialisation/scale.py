"""The initial scale in closed form: from motion, the ground, and a known path."""

import dataclasses
from collections.abc import Collection
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import graph, motion
from bodyslam_jax.body import BodyModel
from bodyslam_jax.body.skeleton import BODY25_ANKLES_AND_FEET
from bodyslam_jax.config import PATH_SIGMA, GraphWeights
from bodyslam_jax.geometry.ground_plane import find_ground
from bodyslam_jax.geometry.lengths import padded_length
from bodyslam_jax.initialisation.upright import mean_up
from bodyslam_jax.people import PersonState
from bodyslam_jax.types import Keypoints, ScaleStart

_MIN_CONFIDENCE = 0.2
"""From which a keypoint of the feet counts as visible."""
_MAX_SPREAD = 0.3
"""Interquartile range of the scales of single frames, as a share of their median. It is
larger on stairs, or where people do not stand on the plane."""


def scale_start(
    state: graph.State,
    prediction: motion.Prediction,
    contact: graph.GroundContact | None,
    *,
    shared_error: float = 0.0,
    path: float = float("nan"),
    without: Collection[int] = (),
) -> ScaleStart:
    """Scales from motion, and from the ground and a camera path in metres, if given.

    Args:
        contact: the ground factor; `None` without ground.
        shared_error: relative error common to all predicted displacements.
        path: m per unit of the map according to the path; NaN without one.
        without: people whose motion is not used.
    """
    start = _motion_scale(state, prediction, without)
    if np.isfinite(path):
        start = dataclasses.replace(start, path=path, path_error=PATH_SIGMA * path)
    error = float(np.hypot(start.motion_error, shared_error * start.motion))
    start = dataclasses.replace(start, motion_error=error)
    if contact is None:
        return start
    used = np.isfinite(np.asarray(contact.sigma))
    ground = float(np.median(_scales(contact, state)[used]))
    # Error of the ground in m, over the camera's height above it in units.
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
    """The factor of people who stand on the ground plane of the map, in frames with
    visible feet; `None` without a plane, or if scales disagree from frame to frame.

    Up is the mean direction of people's trunks.
    """
    visible = roots.present & registered
    if keypoints is not None:
        feet = keypoints.confidence[:, :, BODY25_ANKLES_AND_FEET]
        visible &= (feet > _MIN_CONFIDENCE).any(axis=-1)
    if weights.ground_sigma is None or visible.sum() < 2:
        return None
    plane = find_ground(
        np.asarray(state.landmarks),
        np.asarray(state.cameras[:, :3, 3]),
        mean_up(state, visible),
    )
    if plane is None:
        return None
    sigma = np.where(visible, weights.ground_sigma * np.sqrt(visible.sum()), np.inf)
    contact = graph.GroundContact(body, jnp.asarray(plane), jnp.asarray(sigma))
    every = _scales(contact, state)[visible]
    low, middle, high = np.quantile(every, [0.25, 0.5, 0.75])
    return contact if low > 0 and high - low < _MAX_SPREAD * middle else None


def _scales(
    contact: graph.GroundContact, state: graph.State
) -> Float[np.ndarray, "h t"]:
    """The scales that would put people's feet on the ground."""
    frames = len(state.cameras)
    more = padded_length(frames) - frames
    none = jnp.zeros((0, 3), state.landmarks.dtype)
    longer = graph.extend_state(eqx.tree_at(lambda s: s.landmarks, state, none), more)
    contact = cast(graph.GroundContact, graph.pad_factor(contact, state, more))
    return np.asarray(_scales_of_ground(contact, longer))[:, :frames]


_scales_of_ground = eqx.filter_jit(lambda contact, state: contact.scales(state))


def _motion_scale(
    state: graph.State, prediction: motion.Prediction, without: Collection[int]
) -> ScaleStart:
    """Robust regression of predicted on observed displacements, mean over people."""
    C_WC, r_WC = state.cameras[:, :3, :3], state.cameras[:, :3, 3]
    C_WH = C_WC @ state.roots[..., :3, :3]
    offset = jnp.einsum("tij,htj->hti", C_WC, state.roots[..., :3, 3])
    found = []
    for h in range(len(state.roots)):
        if h in without:
            continue
        one = jax.tree.map(lambda x: x[h], prediction)
        found.append(motion.scale_from_motion(one, C_WH[h], r_WC, offset[h]))
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
