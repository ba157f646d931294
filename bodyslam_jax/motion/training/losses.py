"""Training losses.

- The paper's network is trained with equation 1.
- The loss of the default network is the mean error norm (not squared, as errors have
  heavy tails) of single displacements and of their mean over a segment, with a penalty
  on the slope of predicted over true displacement, as a biased slope biases the scale.
  Losses of posture and covariance are added.
- A user's function (`make_motion_model`) is trained with the negative log-likelihood of
  true displacements.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.config import MotionTraining
from bodyslam_jax.geometry import so3
from bodyslam_jax.motion.network import MotionNetwork, apply_layers, lower_triangle
from bodyslam_jax.motion.paper_network import PaperNetwork
from bodyslam_jax.motion.position_network import MetricNetwork
from bodyslam_jax.motion.training.sampling import Batch


def loss(
    network: MotionNetwork, batch: Batch, settings: MotionTraining
) -> Float[Array, ""]:
    """Returns the mean loss of a batch; see the module's docstring."""
    if isinstance(network, PaperNetwork):
        return _paper_loss(network, batch)
    if isinstance(network, MetricNetwork):
        return _metric_loss(network, batch, settings)
    return _likelihood(network, batch)


def _likelihood(network: MotionNetwork, batch: Batch) -> Float[Array, ""]:
    """Returns the loss of a custom network: negative log-likelihood of displacements,
    and squared errors (rad²) of postures and of the root's rotation."""
    guess = network(batch.window)
    error = guess.translation - batch.move * batch.window.leg[..., None]
    whitened = jax.scipy.linalg.solve_triangular(
        guess.cholesky, error[..., None], lower=True
    )[..., 0]
    diagonal = jnp.diagonal(guess.cholesky, axis1=-2, axis2=-1)
    each = 0.5 * (whitened**2).sum(-1) + jnp.log(jnp.abs(diagonal)).sum(-1)
    each += ((guess.body_pose - batch.pose[..., 1:, :]) ** 2).mean((-1, -2))
    each += ((guess.rotation - batch.pose[..., 0, :]) ** 2).mean(-1)
    return (each * batch.weight).sum() / batch.weight.sum()


def _paper_loss(network: PaperNetwork, batch: Batch) -> Float[Array, ""]:
    """Returns equation 1, `c_p + λ c_θ` with λ = 1/24, of normalised quantities."""
    out = network.normalised(network.features(batch.window))
    move = batch.move * batch.window.leg[..., None]
    pose = batch.pose.reshape(*move.shape[:-1], 72)
    error = out - network.outputs(jnp.concatenate([move, pose], -1))
    square = (error[..., :3] ** 2).sum(-1) + (error[..., 3:] ** 2).sum(-1) / 24
    return (square * batch.weight).sum() / batch.weight.sum()


def _metric_loss(
    network: MetricNetwork, batch: Batch, settings: MotionTraining
) -> Float[Array, ""]:
    """Returns the loss of the default network; see the module's docstring."""
    weight, window = batch.weight, batch.window
    total = weight.sum()
    moves, spreads = network.moves(window, network.features(window))
    error = (moves - batch.move) / network.unit
    norm = lambda x, soft: jnp.sqrt((x * x).sum(-1) + soft**2)
    single = (norm(error, 0.05) * weight).sum((1, 2)) / total
    # mean error over the segment, turned into one frame
    turned = jnp.einsum("slab,mslb->msla", batch.frame, error) * weight[..., None]
    count = weight.sum(-1)
    mean = turned.sum(2) / jnp.maximum(count, 1.0)[:, None]
    along = (norm(mean, 0.05) * count).sum(1) / total
    # slope of predicted over true displacement, by noise level
    groups = lambda x: (x * weight).reshape(*x.shape[:-2], 4, -1).sum(-1)
    true = groups((batch.move**2).sum(-1))
    slope = groups((moves * batch.move).sum(-1)) / jnp.maximum(true, 1e-6)
    bias = ((slope - 1) ** 2).sum(-1)
    mean_loss = single + settings.segment_weight * along + settings.slope_weight * bias

    whitened = jax.scipy.linalg.solve_triangular(
        lower_triangle(spreads.mean(0)),
        jax.lax.stop_gradient(error.mean(0))[..., None],
        lower=True,
    )[..., 0]
    entries = jnp.clip(spreads.mean(0)[..., :3], -12.0, 6.0)
    likelihood = 0.5 * (jnp.minimum(whitened**2, 50.0)).sum(-1) + entries.sum(-1)

    features = network.posture_features(window)
    out = apply_posture(network, features)
    goal = network.posture_outputs(posture_goal(batch).reshape(*out.shape))
    posture = ((out - goal) ** 2).mean(-1)
    return mean_loss.sum() + ((likelihood + posture) * weight).sum() / total


def apply_posture(
    network: MetricNetwork, features: Float[Array, "*b d"]
) -> Float[Array, "*b 72"]:
    """Returns the predicted change of posture, normalised."""
    return apply_layers(network.posture, network.posture_inputs(features))


def posture_goal(batch: Batch) -> Float[Array, "s l 24 3"]:
    """Returns the rotations from the (noisy) last posture to the true next one, rad."""
    last = batch.window.body_pose[..., -2, :, :]
    turns = so3.between(last, batch.pose[..., 1:, :])
    return jnp.concatenate([batch.pose[..., :1, :], turns], -2)
