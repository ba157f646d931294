"""Factors of people: keypoints, body priors, statures, and contact of standing feet."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.ndimage import maximum_filter1d

from bodyslam_jax import graph, motion, people
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import GraphWeights, Measured
from bodyslam_jax.people import PersonState
from bodyslam_jax.types import Sequence

_MIN_PREDICTION_S = 16 / 30
"""Time for which a person has been present before the pose counts as predicted, s, if
no prediction is given: the longest window of the motion models in the package."""
_CONTACT_LOSS_SIGMAS = 3.0
"""Cauchy scale of the displacement of a point in contact, in standard deviations."""
_MIN_CONTACT_PROBABILITY = 0.05
"""Probability of contact in two successive frames below which a point has no weight."""


def keypoint_sigma(
    sequence: Sequence, roots: PersonState, weights: GraphWeights
) -> Float[np.ndarray, "h t 25"]:
    """Returns the standard deviation of each keypoint, px; `inf` where it is missing.

    A detector's error grows with the person's size in the image, so it is defined in
    metres on the body (larger for loosely defined points and for low confidence) and
    projected at the person's depth. If `weights.keypoint_sigma` is set, the result is
    that value divided by the confidence.
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
    """Returns the factor by which temporal correlation of keypoint errors inflates σ at
    the frame rate of the sequence."""
    if weights.keypoint_sigma is not None:
        return 1.0
    return weights.keypoint_inflation * float(np.sqrt(sequence.fps / motion.FPS))


def _keypoint_loss(
    sequence: Sequence, sigma: Float[np.ndarray, "h t 25"], weights: GraphWeights
) -> graph.GemanMcClure:
    """Returns a loss whose scale in px does not depend on the inflation, which lowers a
    keypoint's weight, but not the distance at which it is an outlier; with
    `weights.keypoint_sigma`, it does not depend on the confidence either."""
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
    """Returns the factors of keypoints, poses, shapes, roots and smoothness of `h`
    people.

    Args:
        roots: people in the camera frame, from regressed or fitted bodies.
        predicted: frames with a valid prediction of the motion model. If the prior of
            body poses is the prediction (`weights.posture_predicted`), it applies to
            these frames only.
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
    per_frame = motion.FPS / sequence.fps
    between = lambda rho: graph.ar1_correlation(present, rho**per_frame)
    where = lambda mask, sigma: jnp.where(mask, sigma, jnp.inf)
    with_prior = present
    if weights.posture_predicted:
        if predicted is None:
            count = 1 + round(_MIN_PREDICTION_S * sequence.fps)
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
    """Returns the frames that are more than a second from any keypoint of the person.

    In all others keypoints determine the position better than a regressor does, also
    across short gaps.
    """
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
    """Returns the prior of the regressed root positions in the frames `placed`."""
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
    """Returns the prior of SMPL β, in every frame in which a person is present or,
    without `weights.shape_each_frame`, in the first one."""
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
    """Returns the frames at the end of `count` successive frames with the person
    present."""
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
    """Returns the factor of known statures, m: one measurement for each person (row) in
    `statures`."""
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


def contact_factor(
    probability: Float[Array, "h t 4"],
    state: graph.State,
    present: Bool[np.ndarray, "h t"],
    fps: float,
    body: BodyModel,
    weights: GraphWeights,
) -> graph.FootContact:
    """Returns the factor that penalises displacement of foot points in contact, with
    `weights.contact_sigma` (leg lengths in a frame of 1/30 s).

    `probability` is the contact probability of each toe and heel; β and s are constants
    taken from `state`.
    """
    assert weights.contact_sigma is not None
    both = probability * _previous_frame(probability)
    both = jnp.where(
        (present & np.asarray(_previous_frame(present)))[..., None], both, 0.0
    )
    leg = motion.leg_length(body, state.shapes)[:, None, None]
    sigma = weights.contact_sigma * np.sqrt(motion.FPS / fps) * leg
    stands = both > _MIN_CONTACT_PROBABILITY
    sigma = jnp.where(stands, sigma / jnp.sqrt(jnp.where(stands, both, 1.0)), jnp.inf)
    shape = jnp.broadcast_to(state.shapes[:, None], (*present.shape, 10))
    scale = jnp.broadcast_to(state.scale, present.shape)
    loss = graph.Cauchy(jnp.asarray(_CONTACT_LOSS_SIGMAS))
    return graph.FootContact(body, shape, scale, sigma.astype(shape.dtype), loss=loss)


def without_contacts(
    state: graph.State, fps: float, body: BodyModel, weights: GraphWeights
) -> graph.FootContact:
    """Returns `contact_factor` with contact probabilities of zero, and so of zero
    cost."""
    count, frames = state.poses.shape[:2]
    probability = jnp.zeros((count, frames, 4), state.poses.dtype)
    nobody = np.zeros((count, frames), bool)
    return contact_factor(probability, state, nobody, fps, body, weights)


def _previous_frame(x):
    """Returns the values of the previous frame; zero in the first one."""
    xp = jnp if isinstance(x, jax.Array) else np
    return xp.concatenate([xp.zeros_like(x[:, :1]), x[:, :-1]], axis=1)
