"""The graph's error terms from what was measured (section 3.6 of the paper)."""

import dataclasses
from collections.abc import Collection, Mapping

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.ndimage import maximum_filter1d

from bodyslam_jax import graph, motion, people
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import PATH_SIGMA, GraphWeights, Measured
from bodyslam_jax.people import PersonState
from bodyslam_jax.types import Sequence, Tracks

PIXEL_SIGMA_RANGE = (0.3, 3.0)
"""px: what a track's noise can be; outside, it is the model that is wrong."""
_PREDICTED_AFTER = 16 / 30
"""Time that a person must have been seen for before a posture counts as predicted, s,
where the predictions are not at hand: what the longest window that ships needs."""


def landmark_sigma(measured: float, weights: GraphWeights) -> float:
    """Standard deviation of a static point in the joint graph, px: `pixel_sigma` of the
    weights, or else what was `measured` of the tracks."""
    return measured if weights.pixel_sigma is None else weights.pixel_sigma


def map_factor(
    tracks: Tracks, keep: Bool[np.ndarray, " m"], sigma: float, weights: GraphWeights
) -> graph.Reprojection:
    """Static landmarks; rejected observations are left out (their `sigma` is `inf`).

    `sigma` is what was measured of the tracks (px): `landmark_sigma`.
    """
    sigma = landmark_sigma(sigma, weights)
    return graph.Reprojection(
        frame=jnp.asarray(tracks.frame, jnp.int32),
        landmark=jnp.asarray(tracks.landmark, jnp.int32),
        pixel=jnp.asarray(tracks.uv, float),
        sigma=jnp.asarray(np.where(keep, sigma, np.inf)),
        loss=graph.Cauchy(jnp.asarray(weights.landmark_loss)),
    )


def revisit_factor(
    prior_mean: Float[np.ndarray, "l 3"],
    prior_information: Float[np.ndarray, "l 3 3"],
    sigma: float,
) -> graph.LandmarkPrior:
    """Where other sightings of the same points place landmarks (`sfm.loop_closure`)."""
    size, axes = np.linalg.eigh(prior_information)
    whitening = np.sqrt(np.maximum(size, 0.0))[..., None] * np.swapaxes(axes, 1, 2)
    return graph.LandmarkPrior(
        position=jnp.asarray(prior_mean, float),
        whitening=jnp.asarray(whitening / sigma),
    )


def path_factors(
    path: Float[np.ndarray, "t 4 4"] | None,
    known: Bool[np.ndarray, " t"] | None,
    scale: float = float("nan"),
) -> list[graph.Factor]:
    """Camera poses that came with the video, and metres per unit of the map if they
    are in metres; none without them."""
    if path is None or known is None:
        return []
    sigma = np.repeat(np.where(known, PATH_SIGMA, np.inf)[:, None], 6, axis=1)
    factors: list[graph.Factor] = []
    factors.append(graph.CameraPrior(jnp.asarray(path), jnp.asarray(sigma)))
    if np.isfinite(scale):
        once = np.full(len(known), np.inf)
        once[0] = PATH_SIGMA * scale
        of_map = jnp.full(len(known), scale)
        factors.append(graph.ScalePrior(of_map, jnp.asarray(once)))
    return factors


def stature_factor(
    statures: Mapping[int, Measured],
    present: Bool[np.ndarray, "h t"],
    body: BodyModel,
) -> graph.Stature:
    """Statures that are known, one measurement a person."""
    linear = people.linear_stature(body)
    height, sigma = np.ones(present.shape), np.full(present.shape, np.inf)
    for h, known in statures.items():
        height[h] = known.value
        if present[h].any():
            sigma[h, present[h].argmax()] = known.sigma
    return graph.Stature(
        template=jnp.asarray(linear.template),
        slope=jnp.asarray(linear.slope),
        height=jnp.asarray(height),
        sigma=jnp.asarray(sigma),
    )


def keypoint_sigma(
    sequence: Sequence, roots: PersonState, weights: GraphWeights
) -> Float[np.ndarray, "h t 25"]:
    """Standard deviation of each keypoint, px; `inf` where there is none.

    A detector's error is a share of the person's size in the image: its usual error in
    metres of the body (wider for loosely defined points and for low confidence), seen
    at the person's distance.
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
    """How much less a keypoint counts because those of frames around it err alike."""
    if weights.keypoint_sigma is not None:
        return 1.0
    return weights.keypoint_inflation * float(np.sqrt(sequence.fps / 30.0))


def _keypoint_loss(
    sequence: Sequence, sigma: Float[np.ndarray, "h t 25"], weights: GraphWeights
) -> graph.GemanMcClure:
    """What lasts counts less, but an outlier is as far away as ever: the loss is of the
    error in px, whatever the keypoint weighs."""
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
    shape: Float[np.ndarray, "h 10"] | None = None,
    predicted: Bool[Array, "h t"] | None = None,
) -> list[graph.Factor]:
    """Keypoints, postures, shapes and smooth paths of `h` people.

    Args:
        shape: what a regressor or a fit says of β, where `roots` have more than that.
        predicted: of which frames the motion model has a prediction
            (`Prediction.valid`); only there are postures held to it, if they are to be.
    """
    factors: list[graph.Factor] = []
    there = jnp.asarray(roots.present)
    if sequence.keypoints is not None:
        keypoints, _ = people.correct_left_right(sequence.keypoints, sequence.fps)
        sequence = dataclasses.replace(sequence, keypoints=keypoints)
        pixel = people.as_body_keypoints(
            keypoints,
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
    between = lambda rho: graph.ar1_correlation(there, rho**per_frame)
    where = lambda mask, sigma: jnp.where(mask, sigma, jnp.inf)
    held = there
    if weights.posture_predicted:
        if predicted is None:
            count = 1 + round(_PREDICTED_AFTER * sequence.fps)
            predicted = jnp.asarray(_in_a_row(roots.present, count))
        held = there & predicted
    factors.append(
        graph.BodyPosePrior(
            rotation=jnp.asarray(roots.body_pose),
            sigma=where(held[..., None], weights.posture_sigma) * jnp.ones(23),
            correlation=between(weights.posture_correlation),
            correlated=weights.posture_correlation > 0,
            predicted=weights.posture_predicted,
        )
    )
    placed = _placed_by_regressor(sequence, roots)
    if placed.any():
        rho = graph.ar1_correlation(
            jnp.asarray(placed), weights.root_correlation**per_frame
        )
        factors.append(_place_factor(roots, placed, rho, weights))
    measured = roots.shape if shape is None else shape
    factors.append(_shape_factor(roots.present, measured, weights))
    if weights.root_sigma is not None:
        factors.append(
            graph.RootOrientation(
                orientation=jnp.asarray(roots.T_CH[..., :3, :3]),
                sigma=where(there, weights.root_sigma),
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


def _placed_by_regressor(
    sequence: Sequence, roots: PersonState
) -> Bool[np.ndarray, "h t"]:
    """Where nothing but a regressor tells where people are: no keypoint of theirs is
    within a second. Keypoints tell it better, and gaps between them are short."""
    if sequence.keypoints is None or sequence.bodies is None:
        return roots.present & (sequence.keypoints is None)
    seen = (sequence.keypoints.confidence > 0).any(axis=-1).astype(np.uint8)
    near = maximum_filter1d(seen, 2 * round(sequence.fps) + 1, axis=1, mode="nearest")
    return roots.present & sequence.bodies.present & (np.asarray(near) == 0)


def _place_factor(
    roots: PersonState,
    placed: Bool[np.ndarray, "h t"],
    correlation: Float[Array, "h t"],
    weights: GraphWeights,
) -> graph.RootPositionPrior:
    there = placed[..., None]
    sigma = np.array([weights.root_direction, weights.root_depth])
    return graph.RootPositionPrior(
        position=jnp.asarray(np.where(there, roots.T_CH[..., :3, 3], [0.0, 0.0, 1.0])),
        sigma=jnp.asarray(np.where(there, sigma, np.inf)),
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
    """Frames that end a run of `count` frames in which the person is there."""
    found = present.copy()
    for lag in range(1, count):
        found[:, lag:] &= present[:, :-lag]
        found[:, :lag] = False
    return found


def motion_factor(
    seen: motion.Prediction,
    shapes: Float[Array, "h 10"],
    body: BodyModel,
    weights: GraphWeights,
    *,
    shared_error: Float[np.ndarray, " h"] | float = 0.0,
    without: Collection[int] = (),
) -> graph.HumanMotion:
    """The motion model's displacements, weighted by its own covariance, in lengths of
    the leg or, if the weights say so, in metres.

    `shared_error` is a share by which all of a person's steps may be wrong together:
    they say no more of the scale than that allows, however many there are. Of the
    people in `without` they say nothing.
    """
    shared = jnp.broadcast_to(jnp.asarray(shared_error, shapes.dtype), len(shapes))
    step, whitening = _steps(seen, shapes, body, weights, shared[:, None, None, None])
    if without:
        whitening = whitening.at[np.array(list(without))].set(0.0)
    return graph.HumanMotion(
        translation=step,
        whitening=whitening,
        correlation=graph.ar1_correlation(seen.valid, weights.motion_correlation),
        correlated=weights.motion_correlation > 0,
        body=body if weights.motion_in_legs else None,
    )


@eqx.filter_jit
def _steps(seen, shapes, body, weights, shared_error):
    """Displacements in lengths of the leg, or in metres, and what whitens their
    errors."""
    valid = seen.valid
    eye = jnp.eye(3, dtype=seen.translation.dtype)
    if weights.motion_sigma is None:
        covariance = jnp.where(valid[..., None, None], seen.covariance, eye)
        lower = jnp.linalg.cholesky(covariance)
        whitening = jnp.linalg.solve(lower, jnp.broadcast_to(eye, lower.shape))
    else:
        whitening = jnp.broadcast_to(eye / weights.motion_sigma, (*valid.shape, 3, 3))
    whitening = jnp.where(valid[..., None, None], whitening, 0.0)
    step = jnp.where(valid[..., None], seen.translation, 0.0)
    rho = weights.motion_correlation
    told = jnp.sum((whitening @ step[..., None]) ** 2, axis=(1, 2, 3), keepdims=True)
    told = told * (1 - rho) / (1 + rho)  # information on a factor of all steps
    whitening = whitening / jnp.sqrt(1 + shared_error**2 * told)
    if not weights.motion_in_legs:
        return step, whitening
    leg = motion.leg_length(body, shapes)[:, None, None]
    return step / leg, whitening * leg[..., None]
