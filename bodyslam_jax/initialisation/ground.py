"""Estimates the ground under people: the map's plane, or its height at their feet."""

from typing import cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax import graph
from bodyslam_jax.body import BodyModel
from bodyslam_jax.body.skeleton import BODY25_ANKLES_AND_FEET
from bodyslam_jax.config import GraphWeights
from bodyslam_jax.geometry.lengths import padded_length, put
from bodyslam_jax.ground.heights import elevation, ground_under, running_median
from bodyslam_jax.ground.plane import find_ground
from bodyslam_jax.types import Keypoints

_MIN_CONFIDENCE = 0.2
"""Confidence above which a keypoint of the feet counts as visible."""
_MAX_SPREAD = 0.3
"""Largest interquartile range of the scales of single frames, as a share of their
median. It is larger where people do not stand on the ground of the map."""
_MAX_PLANE_RESIDUAL = 0.015
"""Standard deviation of the ground under feet about the plane, as a share of the
camera's height, below which the plane explains it: landmarks err by half of that."""
_MAX_RANGE_RATIO = 0.7
"""Largest ratio between the ranges of scales of single frames, with the ground under
feet over with the plane, at which the ground under feet is preferred."""
_MEDIAN_WINDOW_S = 0.5
"""Length of the running median of ground heights, s; it also fills gaps."""
_MIN_GROUND_FRAMES = 15
"""Least number of frames with known ground height for it to be considered."""
_MIN_GROUND_SHARE = 0.2
"""The same limit as a share of the frames with visible feet."""
_MAX_STEP_M = 0.12
"""Height over the level of the feet in the second around it above which both are in the
air, m: three times `ground_sigma`; those of walkers deviate by 0.01 to 0.03."""
_PASSES = 3
"""Number of times that heights over the ground and scale are computed from each other;
a fourth changes the scale of none of eleven sequences by 1 %."""


def ground_contact(
    state: graph.State,
    present: Bool[np.ndarray, "h t"],
    keypoints: Keypoints | None,
    body: BodyModel,
    weights: GraphWeights,
    fps: float,
) -> graph.GroundContact | None:
    """Returns the factor of people standing on the ground of the map, in frames with
    visible feet; `None` without ground, or if the scales of single frames disagree.

    The ground is the map's plane if it explains the landmarks under people's feet.
    Otherwise, on stairs or uneven ground or without a plane, it is the height of these
    landmarks in frames with enough of them, provided that the scales of single frames
    then agree better than with the plane. Up is the mean direction of trunks.

    Args:
        present: frames with a camera and a person whose legs are observed.
    """
    visible = with_visible_feet(present, keypoints)
    if weights.ground_sigma is None or visible.sum() < 2:
        return None
    contact, used = _ground(state, visible, body, fps)
    if contact is None:
        return None
    # Definition: quartiles.
    low, middle, high = np.quantile(scales(contact, state)[used], [0.25, 0.5, 0.75])
    if low <= 0 or high - low >= _MAX_SPREAD * middle:
        return None
    sigma = np.where(used, weights.ground_sigma * np.sqrt(used.sum()), np.inf)
    return eqx.tree_at(lambda f: f.sigma, contact, jnp.asarray(sigma))


def mean_up(
    state: graph.State, present: Bool[np.ndarray, "h t"]
) -> Float[np.ndarray, "3"]:
    """Returns the mean direction of people's trunks (y axes of their root frames) in
    the world, a unit vector."""
    ups = np.asarray(state.roots[..., :3, 1])
    trunks = np.einsum("tij,htj->hti", np.asarray(state.cameras[:, :3, :3]), ups)
    total = trunks[present].sum(axis=0)
    return total / max(float(np.linalg.norm(total)), 1e-9)


def with_visible_feet(
    present: Bool[np.ndarray, "h t"], keypoints: Keypoints | None
) -> Bool[np.ndarray, "h t"]:
    """Returns the frames in which a foot is visible; all of `present` without
    keypoints."""
    if keypoints is None:
        return present
    feet = keypoints.confidence[:, :, BODY25_ANKLES_AND_FEET]
    return present & (feet > _MIN_CONFIDENCE).any(axis=-1)


def with_elevation(
    contact: graph.GroundContact, state: graph.State, fps: float
) -> graph.GroundContact:
    """Returns the factor with the heights over the ground at which people stand, where
    their feet rise and sink in the course of the sequence, and with a larger sigma of
    those people (`ground.heights.elevation`). Feet in the air have no weight."""
    used = np.isfinite(np.asarray(contact.sigma))
    ground = np.asarray(contact.sigma)[used] / np.sqrt(used.sum())
    every, eye = scales(contact, state), heights_of_camera(contact, state)
    height, error = np.zeros(used.shape), np.zeros(len(used))
    scale = np.median(every[used])
    for _ in range(_PASSES):
        for h, frames in enumerate(used):
            over = (scale - every[h]) * eye[h]
            height[h], error[h] = elevation(over, frames, fps)
        scale = np.median((every + height / eye)[used])
    over = (scale - every) * eye
    level = [running_median(*one, fps) for one in zip(over, used, strict=True)]
    stands = used & (over - np.array(level) < _MAX_STEP_M)
    sigma = np.sqrt(stands.sum()) * np.hypot(ground.max(), error)
    return eqx.tree_at(
        lambda f: (f.height, f.sigma),
        contact,
        (
            jnp.asarray(height),
            jnp.asarray(np.where(stands, sigma[:, None], np.inf)),
        ),
    )


def heights_of_camera(
    contact: graph.GroundContact, state: graph.State
) -> Float[np.ndarray, "h t"]:
    """Returns the height of the camera over the ground under each person, units of the
    map."""
    eyes = np.asarray(state.cameras)[:, :3, 3] @ np.asarray(contact.normal)
    return eyes + np.asarray(contact.offset)


def scales(
    contact: graph.GroundContact, state: graph.State
) -> Float[np.ndarray, "h t"]:
    """Returns the scales that put people's feet on the ground, m per unit of the
    map."""
    return _scales_and_soles(contact, state)[0]


def _ground(
    state: graph.State, visible: Bool[np.ndarray, "h t"], body: BodyModel, fps: float
) -> tuple[graph.GroundContact | None, Bool[np.ndarray, "h t"]]:
    """Returns the factor with σ = 1, and the frames in which it is used."""
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
        put(np.zeros(visible.shape)),
    )
    _, soles = _scales_and_soles(contact, state)
    rays = np.einsum("tij,htj->hti", np.asarray(state.cameras[:, :3, :3]), soles)
    level = np.full(visible.shape, np.nan)
    for h, frames in enumerate(visible):
        own = np.full(len(frames), np.nan)
        own[frames] = ground_under(eyes[frames], rays[h, frames], landmarks, normal)
        level[h] = running_median(own, np.isfinite(own), fps, _MEDIAN_WINDOW_S)
    known = visible & np.isfinite(level)
    enough = known.sum() >= max(_MIN_GROUND_FRAMES, _MIN_GROUND_SHARE * visible.sum())
    if not enough:
        return (None if plane is None else contact), visible
    offset = jnp.asarray(np.where(known, -level, d))
    local = eqx.tree_at(lambda f: f.offset, contact, offset)
    if plane is None:
        return local, known
    flat = _spread(level[known] + d) < _MAX_PLANE_RESIDUAL * np.median(
        eyes @ normal + d
    )
    # The scale is constant; landmarks of furniture in front of feet make it vary.
    apart = [_range(scales(ground, state)[known]) for ground in (contact, local)]
    if flat or apart[1] > _MAX_RANGE_RATIO * apart[0]:
        return contact, visible
    return local, known


def _range(values: Float[np.ndarray, " n"]) -> float:
    """Returns the range from the 5th to the 95th percentile over the median."""
    # Convention: the middle 90 %, which single outliers do not change.
    low, middle, high = np.quantile(values, [0.05, 0.5, 0.95])
    return float((high - low) / max(abs(middle), 1e-12))


def _spread(heights: Float[np.ndarray, " n"]) -> float:
    """Returns the standard deviation about zero, from the quantiles of 5 and 95 %."""
    # The normal quantile of 95 %.
    return float(np.abs(np.quantile(heights, [0.05, 0.95])).max() / 1.645)


def _scales_and_soles(
    contact: graph.GroundContact, state: graph.State
) -> tuple[Float[np.ndarray, "h t"], Float[np.ndarray, "h t 3"]]:
    """Evaluates `contact.scales` and `contact.soles` with a padded number of frames, so
    that videos of similar length share a program."""
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
