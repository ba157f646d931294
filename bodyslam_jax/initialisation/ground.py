"""The ground that people stand on: the map's plane, or its height under their feet."""

from typing import cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax import graph
from bodyslam_jax.body import BodyModel
from bodyslam_jax.body.skeleton import BODY25_ANKLES_AND_FEET
from bodyslam_jax.config import GraphWeights
from bodyslam_jax.geometry.ground_plane import find_ground
from bodyslam_jax.geometry.lengths import padded_length, put
from bodyslam_jax.geometry.local_ground import ground_under, running_median, wander
from bodyslam_jax.initialisation.upright import mean_up
from bodyslam_jax.types import Keypoints

_MIN_CONFIDENCE = 0.2
"""From which a keypoint of the feet counts as visible."""
_MAX_SPREAD = 0.3
"""Interquartile range of the scales of single frames, as a share of their median. It is
larger where people do not stand on the ground of the map."""
_FLAT = 0.015
"""Standard deviation of the ground under feet about the plane, as a share of the
camera's height, up to which the plane explains it: landmarks err by half of that."""
_BETTER = 0.7
"""By as much as this the scales of single frames must be closer to each other with the
ground under feet than with the plane."""
_SMOOTH = 0.5
"""Length of the running median of heights of the ground, s; it fills gaps too."""
_FEWEST = 15
"""Frames with known ground, for its heights to be compared with the plane, or used."""
_LEAST_SHARE = 0.2
"""The same, as a share of the frames with visible feet."""
_MEAN_OF_WANDER = 1.5
"""The error of the mean ground for each standard deviation by which it wanders: one
that rises steadily from the plane is in the mean 1.7 of its standard deviations off."""


def ground_contact(
    state: graph.State,
    present: Bool[np.ndarray, "h t"],
    keypoints: Keypoints | None,
    body: BodyModel,
    weights: GraphWeights,
    fps: float,
) -> graph.GroundContact | None:
    """The factor of people who stand on the ground of the map, in frames with visible
    feet; `None` without ground, or if scales disagree from frame to frame.

    The ground is the map's plane where that explains the landmarks under people's feet.
    Where it does not, on stairs or uneven ground, or where there is no plane, it is the
    height of these landmarks, in frames in which there are enough, if people then have
    one scale more nearly than on the plane. Up is the mean direction of their trunks.

    Args:
        present: frames with a camera and a person whose legs are not only guessed.
    """
    visible = with_visible_feet(present, keypoints)
    if weights.ground_sigma is None or visible.sum() < 2:
        return None
    contact, used = _ground(state, visible, body, fps)
    if contact is None:
        return None
    low, middle, high = np.quantile(scales(contact, state)[used], [0.25, 0.5, 0.75])
    if low <= 0 or high - low >= _MAX_SPREAD * middle:
        return None
    sigma = np.where(used, weights.ground_sigma * np.sqrt(used.sum()), np.inf)
    return eqx.tree_at(lambda f: f.sigma, contact, jnp.asarray(sigma))


def with_visible_feet(
    present: Bool[np.ndarray, "h t"], keypoints: Keypoints | None
) -> Bool[np.ndarray, "h t"]:
    """The frames in which a foot is seen; all of `present` without keypoints."""
    if keypoints is None:
        return present
    feet = keypoints.confidence[:, :, BODY25_ANKLES_AND_FEET]
    return present & (feet > _MIN_CONFIDENCE).any(axis=-1)


def with_wander(
    contact: graph.GroundContact, state: graph.State, fps: float
) -> graph.GroundContact:
    """The factor with a larger error where feet rise and sink over the ground in the
    course of the sequence (`geometry.local_ground.wander`)."""
    sigma = np.asarray(contact.sigma)
    used = np.isfinite(sigma)
    every = scales(contact, state)
    high = (every - np.median(every[used])) * heights_of_camera(contact, state)
    _, moved = wander(high, used, fps)
    more = np.sqrt(used.sum()) * _MEAN_OF_WANDER * moved
    return eqx.tree_at(
        lambda f: f.sigma,
        contact,
        jnp.asarray(np.where(used, np.hypot(sigma, more), np.inf)),
    )


def heights_of_camera(
    contact: graph.GroundContact, state: graph.State
) -> Float[np.ndarray, "h t"]:
    """Height of the camera over the ground under each person, units of the map."""
    eyes = np.asarray(state.cameras)[:, :3, 3] @ np.asarray(contact.normal)
    return eyes + np.asarray(contact.offset)


def scales(
    contact: graph.GroundContact, state: graph.State
) -> Float[np.ndarray, "h t"]:
    """The scales that would put people's feet on the ground."""
    return _scales_and_soles(contact, state)[0]


def _ground(
    state: graph.State, visible: Bool[np.ndarray, "h t"], body: BodyModel, fps: float
) -> tuple[graph.GroundContact | None, Bool[np.ndarray, "h t"]]:
    """The factor with σ = 1, and the frames in which it is used."""
    landmarks = np.asarray(state.landmarks)
    eyes = np.asarray(state.cameras)[:, :3, 3]
    up = mean_up(state, visible)
    plane = find_ground(landmarks, eyes, up)
    normal, d = (up, 0.0) if plane is None else (plane[:3], plane[3])
    contact = graph.GroundContact(
        body,
        put(normal),
        put(np.full(visible.shape, d)),
        put(np.where(visible, 1.0, np.inf)),
    )
    _, soles = _scales_and_soles(contact, state)
    rays = np.einsum("tij,htj->hti", np.asarray(state.cameras[:, :3, :3]), soles)
    level = np.full(visible.shape, np.nan)
    for h, frames in enumerate(visible):
        own = np.full(len(frames), np.nan)
        own[frames] = ground_under(eyes[frames], rays[h, frames], landmarks, normal)
        level[h] = running_median(own, np.isfinite(own), fps, _SMOOTH)
    known = visible & np.isfinite(level)
    enough = known.sum() >= max(_FEWEST, _LEAST_SHARE * visible.sum())
    if not enough:
        return (None if plane is None else contact), visible
    offset = jnp.asarray(np.where(known, -level, d))
    local = eqx.tree_at(lambda f: f.offset, contact, offset)
    if plane is None:
        return local, known
    flat = _spread(level[known] + d) < _FLAT * np.median(eyes @ normal + d)
    # Scale is one number: landmarks of furniture in front of feet put it elsewhere.
    apart = [_range(scales(ground, state)[known]) for ground in (contact, local)]
    if flat or apart[1] > _BETTER * apart[0]:
        return contact, visible
    return local, known


def _range(values: Float[np.ndarray, " n"]) -> float:
    """From the 5th to the 95th percentile, as a share of the median."""
    low, middle, high = np.quantile(values, [0.05, 0.5, 0.95])
    return float((high - low) / max(abs(middle), 1e-12))


def _spread(heights: Float[np.ndarray, " n"]) -> float:
    """Standard deviation about zero, by the quantiles of 5 and 95 %."""
    return float(np.abs(np.quantile(heights, [0.05, 0.95])).max() / 1.645)


def _scales_and_soles(
    contact: graph.GroundContact, state: graph.State
) -> tuple[Float[np.ndarray, "h t"], Float[np.ndarray, "h t 3"]]:
    """`contact.scales` and `contact.soles`, with the number of frames rounded up, so
    that videos of about the same length share a program."""
    frames = len(state.cameras)
    more = padded_length(frames) - frames
    none = jnp.zeros((0, 3), state.landmarks.dtype)
    longer = graph.extend_state(eqx.tree_at(lambda s: s.landmarks, state, none), more)
    contact = cast(graph.GroundContact, graph.pad_factor(contact, state, more))
    scale, sole = _evaluated(contact, longer)
    return np.asarray(scale)[:, :frames], np.asarray(sole)[:, :frames]


@eqx.filter_jit
def _evaluated(
    contact: graph.GroundContact, state: graph.State
) -> tuple[Float[Array, "h t"], Float[Array, "h t 3"]]:
    return contact.scales(state), contact.soles(state)
