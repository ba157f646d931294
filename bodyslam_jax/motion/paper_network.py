"""The paper's network (section 3.4), whose input is joint angles up to frame k-1."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from bodyslam_jax.motion.network import (
    Guess,
    Layer,
    MotionNetwork,
    Normalisation,
    Window,
    apply_layers,
    init_layers,
    joint_angles,
    no_normalisation,
)


class PaperNetwork(MotionNetwork):
    """An encoder of joint angles, with decoders for displacement and posture."""

    encoder: tuple[Layer, ...]
    position: tuple[Layer, ...]
    posture: tuple[Layer, ...]
    inputs: Normalisation
    outputs: Normalisation
    """Normalisation of displacement (3) and of posture (72)."""
    spread: Float[Array, "3 3"]
    """Cholesky factor of the error covariance on validation data, m; it is constant."""

    @staticmethod
    def features(window: Window) -> Float[Array, "*b d"]:
        """Returns the angles (rad) of frames k-n..k-1, with the root's relative to
        frame k-1, and β."""
        angles = joint_angles(window)[..., :-1, :, :]
        flat = angles.reshape(*angles.shape[:-3], -1)
        return jnp.concatenate([flat, window.shape], -1)

    @staticmethod
    def init(key: PRNGKeyArray, past: int, width: int = 1024) -> "PaperNetwork":
        """Returns an untrained network."""
        keys = jax.random.split(key, 3)
        d = past * 72 + 10
        return PaperNetwork(
            encoder=init_layers(keys[0], (d, width, width, width), np.sqrt(2.0)),
            position=init_layers(keys[1], (width, width, width, 3)),
            posture=init_layers(keys[2], (width, width, width, 72), 0.1),
            inputs=no_normalisation(d),
            outputs=no_normalisation(3 + 72),
            spread=0.02 * jnp.eye(3, dtype=jnp.float32),
        )

    def normalised(self, features: Float[Array, "*b d"]) -> Float[Array, "*b 75"]:
        """Returns normalised displacement and posture, as compared by the loss."""
        x = jax.nn.relu(apply_layers(self.encoder, self.inputs(features), smooth=False))
        move = apply_layers(self.position, x, smooth=False)
        change = apply_layers(self.posture, x, smooth=False)
        last = features[..., -82:-10]  # frame k-1, just before β
        mean, std = self.outputs.mean[3:], self.outputs.std[3:]
        return jnp.concatenate([move, (last - mean) / std + change], -1)

    def __call__(self, window: Window) -> Guess:
        out = self.outputs.undo(self.normalised(self.features(window)))
        move, pose = out[..., :3], out[..., 3:].reshape(*out.shape[:-1], 24, 3)
        spread = jnp.broadcast_to(self.spread, (*move.shape, 3))
        return Guess(move, spread, pose[..., 1:, :], pose[..., 0, :])
