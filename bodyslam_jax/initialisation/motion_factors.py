"""Factors of the displacements and rotations that the motion model predicts."""

from collections.abc import Collection

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax import graph, motion
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import GraphWeights
from bodyslam_jax.geometry.arrays import runs
from bodyslam_jax.geometry.lengths import lengthened, padded_length, shortened

_STRIDE_S = 1.0
"""Duration of a stride (two steps) in walking, s."""


def motion_factor(
    prediction: motion.Prediction,
    shapes: Float[Array, "h 10"],
    body: BodyModel,
    weights: GraphWeights,
    *,
    shared_error: Float[np.ndarray, " h"] | float = 0.0,
    without: Collection[int] = (),
) -> graph.HumanMotion:
    """Returns the factor of predicted displacements with the model's covariance, in leg
    lengths or, if `weights.motion_in_legs` is false, in metres.

    Args:
        shapes: SMPL β, from which leg lengths follow.
        shared_error: relative error common to all displacements of a person. It bounds
            the precision of the scale, however many displacements there are.
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
    """Marks predictions as invalid where legs are not observed.

    A posture without support in the image comes from a prior or a regressor: the
    displacement predicted from it is not that of a real step, and carries no
    information on scale. In a gap shorter than a stride the postures on both sides
    determine the phase of the gait, so its steps are kept.

    Args:
        legs: frames with observed legs (`people.legs_shown`).
    """
    known = legs.copy()
    for frames in known:
        last = len(frames)
        for gap in runs(~frames):
            bounded = gap.start > 0 and gap.stop < last
            if bounded and gap.stop - gap.start < _STRIDE_S * fps:
                frames[gap] = True
    return eqx.tree_at(
        lambda p: p.valid, prediction, prediction.valid & jnp.asarray(known)
    )


@eqx.filter_jit
def _whitened_steps(prediction, shapes, body, weights, shared_error):
    """Returns displacements (h, t, 3) in leg lengths or metres, and their whitening
    matrices `W` (h, t, 3, 3), where `W^T W` is the inverse covariance.

    `W` is scaled down to account for a relative error `shared_error` common to all
    steps of a person; it is zero in frames without a prediction.
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
    # Information on a common factor of all displacements of a person, for AR(1) errors.
    information = jnp.sum((whitening @ step[..., None]) ** 2, (1, 2, 3), keepdims=True)
    information = information * (1 - rho) / (1 + rho)
    whitening = whitening / jnp.sqrt(1 + shared_error**2 * information)
    if not weights.motion_in_legs:
        return step, whitening
    leg = motion.leg_length(body, shapes)[:, None, None]
    return step / leg, whitening * leg[..., None]
