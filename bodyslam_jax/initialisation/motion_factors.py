"""Factors of the motion model's prediction."""

import math
from collections.abc import Collection

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax import graph, motion
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import GraphWeights
from bodyslam_jax.geometry.lengths import lengthened, padded_length, shortened
from bodyslam_jax.geometry.runs import runs

STRIDE = 1.0
"""Duration of a stride, two steps, of people who walk, s."""


def motion_factor(
    prediction: motion.Prediction,
    shapes: Float[Array, "h 10"],
    body: BodyModel,
    weights: GraphWeights,
    *,
    shared_error: Float[np.ndarray, " h"] | float = 0.0,
    without: Collection[int] = (),
) -> graph.HumanMotion:
    """The predicted displacements, with the model's covariance, in leg lengths or, with
    `motion_in_legs` false, in metres.

    Args:
        shapes: β, for the leg lengths.
        shared_error: relative error common to all of a person's displacements. However
            many they are, together they determine the scale no better than this.
        without: people (rows) whose displacements have no weight.
    """
    shared = jnp.broadcast_to(jnp.asarray(shared_error, shapes.dtype), len(shapes))
    frames = prediction.valid.shape[1]
    more = padded_length(frames) - frames
    longer = eqx.tree_at(
        lambda p: p.valid,
        lengthened(prediction, frames + more, axis=1),
        graph.extend(prediction.valid, 1, more, False),
    )
    found = _whitened_steps(longer, shapes, body, weights, shared[:, None, None, None])
    step, whitening = shortened(found, frames, axis=1)
    if without:
        whitening = whitening.at[np.array(list(without))].set(0.0)
    return graph.HumanMotion(
        translation=step,
        whitening=whitening,
        correlation=graph.ar1_correlation(prediction.valid, weights.motion_correlation),
        correlated=weights.motion_correlation > 0,
        body=body if weights.motion_in_legs else None,
    )


def steps_shown(
    prediction: motion.Prediction, legs: Bool[np.ndarray, "h t"], fps: float
) -> motion.Prediction:
    """The prediction without the steps of legs that are only guessed.

    A posture that nothing in the image shows is one of the prior's, or of a regressor:
    its displacement is that of no step, and tells nothing of the size of the scene. In
    a gap shorter than a stride the postures before and after it determine the phase of
    the gait, so that its steps are kept.

    Args:
        legs: frames with legs that are shown (`people.legs_shown`).
    """
    known = legs.copy()
    for frames in known:
        last = len(frames)
        for gap in runs(~frames):
            bounded = gap.start > 0 and gap.stop < last
            if bounded and gap.stop - gap.start < STRIDE * fps:
                frames[gap] = True
    return eqx.tree_at(
        lambda p: p.valid, prediction, prediction.valid & jnp.asarray(known)
    )


@eqx.filter_jit
def _whitened_steps(prediction, shapes, body, weights, shared_error):
    """Displacements (h, t, 3) in leg lengths or metres, and their whitening matrices
    `W` (h, t, 3, 3), with `W^T W` the inverse covariance.

    `W` is scaled down such that a relative error `shared_error` common to all steps of
    a person is accounted for; it is zero in frames without a prediction.
    """
    valid = prediction.valid
    eye = jnp.eye(3, dtype=prediction.translation.dtype)
    if weights.motion_sigma is None:
        covariance = jnp.where(valid[..., None, None], prediction.covariance, eye)
        lower = jnp.linalg.cholesky(covariance)
        whitening = jnp.linalg.solve(lower, jnp.broadcast_to(eye, lower.shape))
    else:
        whitening = jnp.broadcast_to(eye / weights.motion_sigma, (*valid.shape, 3, 3))
    whitening = jnp.where(valid[..., None, None], whitening, 0.0)
    step = jnp.where(valid[..., None], prediction.translation, 0.0)
    rho = weights.motion_correlation
    # Information on one factor of all of a person's displacements, with AR(1) errors.
    information = jnp.sum((whitening @ step[..., None]) ** 2, (1, 2, 3), keepdims=True)
    information = information * (1 - rho) / (1 + rho)
    whitening = whitening / jnp.sqrt(1 + shared_error**2 * information)
    if not weights.motion_in_legs:
        return step, whitening
    leg = motion.leg_length(body, shapes)[:, None, None]
    return step / leg, whitening * leg[..., None]


def optional_factors(
    prediction: motion.Prediction, fps: float, weights: GraphWeights
) -> list[graph.Factor]:
    """A factor of the predicted change of root orientation from frame to frame.

    The list is empty unless `weights.orientation_sigma` (rad, at 30 fps) is finite.
    """
    sigma = weights.orientation_sigma
    if sigma is None or not math.isfinite(sigma):
        return []
    valid = prediction.valid
    rotation = jnp.where(valid[..., None], prediction.rotation, 0.0)
    per_frame = jnp.where(valid, sigma * 30.0 / fps, jnp.inf)
    return [graph.RelativeOrientation(rotation=rotation, sigma=per_frame)]
