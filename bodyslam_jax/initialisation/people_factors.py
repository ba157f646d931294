"""Factors of people, from keypoints, regressed or fitted bodies and known statures."""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.ndimage import maximum_filter1d

from bodyslam_jax import graph, motion, people
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import GraphWeights, Measured
from bodyslam_jax.people import PersonState
from bodyslam_jax.types import Sequence

_PREDICTED_AFTER = 16 / 30
"""s: a pose counts as predicted after the person was present for as long, where the
prediction itself is not given: the longest window of the models that ship."""


def keypoint_sigma(
    sequence: Sequence, roots: PersonState, weights: GraphWeights
) -> Float[np.ndarray, "h t 25"]:
    """Standard deviation of each keypoint, px; `inf` where missing.

    A detector's error grows with the person's size in the image, so it is given in
    metres of the body (larger for loosely defined points and for low confidence) and
    projected at the person's depth. With `keypoint_sigma` it is that over the
    confidence.
    """
    keypoints = sequence.keypoints
    assert keypoints is not None
    focal = float(np.mean(sequence.intrinsics.params[:2]))
    sigma = np.full(keypoints.confidence.shape, np.inf)
    inflation = _inflation(sequence, weights)
    for h in range(len(sigma)):
        if weights.keypoint_sigma is None:
            depth = np.maximum(roots.T_CH[h, :, 2, 3], 0.1)
            metres = people.keypoint_sigma(keypoints, sequence.intrinsics, h)
            sigma[h] = inflation * metres * (focal / depth)[:, None]
        else:
            confidence = np.clip(keypoints.confidence[h], 0, 1)
            with np.errstate(divide="ignore"):
                sigma[h] = weights.keypoint_sigma / confidence
    return np.where(roots.present[..., None], sigma, np.inf)


def _inflation(sequence: Sequence, weights: GraphWeights) -> float:
    """Factor on σ for errors that are correlated over frames, at this frame rate."""
    if weights.keypoint_sigma is not None:
        return 1.0
    return weights.keypoint_inflation * float(np.sqrt(sequence.fps / 30.0))


def _keypoint_loss(
    sequence: Sequence, sigma: Float[np.ndarray, "h t 25"], weights: GraphWeights
) -> graph.GemanMcClure:
    """A loss of the same scale in px whatever the inflation or the confidence: these
    lower a keypoint's weight, not the distance from which it is an outlier."""
    if weights.keypoint_sigma is None:
        scale = weights.keypoint_loss / _inflation(sequence, weights)
        return graph.GemanMcClure(jnp.asarray(scale))
    pixels = weights.keypoint_loss * weights.keypoint_sigma
    scale = np.where(np.isfinite(sigma), pixels / sigma, 1.0)
    return graph.GemanMcClure(jnp.asarray(scale))


def people_factors(
    sequence: Sequence,
    roots: PersonState,
    weights: GraphWeights,
    body: BodyModel,
    *,
    predicted: Bool[Array, "h t"] | None = None,
) -> list[graph.Factor]:
    """Factors of keypoints, poses, shapes, roots and smoothness of `h` people.

    Args:
        predicted: frames with a valid prediction of the motion model. Body poses have a
            prior in these only, if it is the prediction (`weights.posture_predicted`).
    """
    factors: list[graph.Factor] = []
    present = jnp.asarray(roots.present)
    if sequence.keypoints is not None:
        pixel = people.as_body_keypoints(
            sequence.keypoints,
            roots,
            people.without_bodies(sequence),
            sequence.intrinsics,
            body,
            sequence.fps,
        ).uv
        sigma = keypoint_sigma(sequence, roots, weights)
        factors.append(
            graph.KeypointReprojection(
                body=body,
                pixel=jnp.asarray(pixel, float),
                sigma=jnp.asarray(sigma),
                loss=_keypoint_loss(sequence, sigma, weights),
            )
        )
    per_frame = 30.0 / sequence.fps
    between = lambda rho: graph.ar1_correlation(present, rho**per_frame)
    where = lambda mask, sigma: jnp.where(mask, sigma, jnp.inf)
    with_prior = present
    if weights.posture_predicted:
        if predicted is None:
            count = 1 + round(_PREDICTED_AFTER * sequence.fps)
            predicted = jnp.asarray(_in_a_row(roots.present, count))
        with_prior = present & predicted
    factors.append(
        graph.BodyPosePrior(
            rotation=jnp.asarray(roots.body_pose),
            sigma=where(with_prior[..., None], weights.posture_sigma) * jnp.ones(23),
            correlation=between(weights.posture_correlation),
            correlated=weights.posture_correlation > 0,
            predicted=weights.posture_predicted,
        )
    )
    placed = _without_keypoints(sequence, roots)
    if placed.any():
        rho = graph.ar1_correlation(
            jnp.asarray(placed), weights.root_correlation**per_frame
        )
        factors.append(_position_factor(roots, placed, rho, weights))
    factors.append(_shape_factor(roots.present, roots.shape, weights))
    if weights.root_sigma is not None:
        factors.append(
            graph.RootOrientation(
                orientation=jnp.asarray(roots.T_CH[..., :3, :3]),
                sigma=where(present, weights.root_sigma),
                correlation=between(weights.root_correlation),
            )
        )
    three = jnp.asarray(_in_a_row(roots.present, 3))
    if weights.root_turning is not None:
        sigma = where(three, weights.root_turning * per_frame**2)
        factors.append(graph.AngularAccelerationPrior(sigma))
    if weights.root_smoothness is not None:
        leg = motion.leg_length(body, jnp.asarray(roots.shape))[:, None]
        sigma = where(three, weights.root_smoothness * per_frame**2 / leg)
        factors.append(graph.RootSmoothness(sigma, body=body))
    return factors


def _without_keypoints(
    sequence: Sequence, roots: PersonState
) -> Bool[np.ndarray, "h t"]:
    """Frames more than a second from any keypoint of the person. Elsewhere keypoints
    determine the position better than a regressor, across short gaps too."""
    if sequence.keypoints is None or sequence.bodies is None:
        return roots.present & (sequence.keypoints is None)
    detected = (sequence.keypoints.confidence > 0).any(axis=-1).astype(np.uint8)
    near = maximum_filter1d(
        detected, 2 * round(sequence.fps) + 1, axis=1, mode="nearest"
    )
    return roots.present & sequence.bodies.present & (np.asarray(near) == 0)


def _position_factor(
    roots: PersonState,
    placed: Bool[np.ndarray, "h t"],
    correlation: Float[Array, "h t"],
    weights: GraphWeights,
) -> graph.RootPositionPrior:
    measured = placed[..., None]
    sigma = np.array([weights.root_direction, weights.root_depth])
    return graph.RootPositionPrior(
        position=jnp.asarray(
            np.where(measured, roots.T_CH[..., :3, 3], [0.0, 0.0, 1.0])
        ),
        sigma=jnp.asarray(np.where(measured, sigma, np.inf)),
        correlation=correlation,
    )


def _shape_factor(
    present: Bool[np.ndarray, "h t"],
    measured: Float[np.ndarray, "h 10"],
    weights: GraphWeights,
) -> graph.ShapePrior:
    counted = present.astype(float)
    if not weights.shape_each_frame:
        counted = np.zeros_like(counted)
        counted[np.arange(len(counted)), present.argmax(axis=1)] = 1.0
    sigma = np.where(counted > 0, weights.shape_sigma, np.inf)
    shape = np.broadcast_to(measured[:, None], (*counted.shape, 10))
    return graph.ShapePrior(
        shape=jnp.asarray(shape),
        sigma=jnp.asarray(np.repeat(sigma[..., None], 10, axis=-1)),
    )


def _in_a_row(present: Bool[np.ndarray, "h t"], count: int) -> Bool[np.ndarray, "h t"]:
    """Frames that end `count` consecutive frames in which the person is present."""
    found = present.copy()
    for lag in range(1, count):
        found[:, lag:] &= present[:, :-lag]
        found[:, :lag] = False
    return found


def stature_factor(
    statures: Mapping[int, Measured],
    present: Bool[np.ndarray, "h t"],
    body: BodyModel,
) -> graph.Stature:
    """Known statures, one measurement for each person in `statures`, by row."""
    linear = people.linear_stature(body)
    height, sigma = np.ones(present.shape), np.full(present.shape, np.inf)
    for h, stature in statures.items():
        height[h] = stature.value
        if present[h].any():
            sigma[h, present[h].argmax()] = stature.sigma
    return graph.Stature(
        template=jnp.asarray(linear.template),
        slope=jnp.asarray(linear.slope),
        height=jnp.asarray(height),
        sigma=jnp.asarray(sigma),
    )
