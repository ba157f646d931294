"""The default network, whose input is joint positions over a window, in leg lengths."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from bodyslam_jax.body.skeleton import ANKLES, FEET
from bodyslam_jax.geometry import so3
from bodyslam_jax.motion.network import (
    Guess,
    Layer,
    MotionNetwork,
    Normalisation,
    Window,
    apply_layers,
    init_layers,
    joint_angles,
    lower_triangle,
    no_normalisation,
)

_INPUT_JOINTS = (1, 2, 4, 5, 7, 8, 10, 11, 6, 12, 15, 16, 17, 20, 21)
"""Joints that are input to the default network: legs, spine, head, hands."""
_CONTACT_JOINTS = (*ANKLES, *FEET)
"""Joints that may be in contact with the ground: ankles and feet."""


class MetricNetwork(MotionNetwork):
    """Predicts displacement from joint positions and from joints in ground contact.

    If a joint is in contact with the ground, the pelvis moves opposite to the joint's
    motion relative to it. The displacement is the weighted sum of these motions over
    contact joints and past frames (weights from the network, positive, with sum 1),
    plus a correction. Lengths are in leg lengths, so that the size of the person
    cancels exactly.
    """

    trunks: tuple[tuple[Layer, ...], ...]
    """Hidden layers of each member of the ensemble, whose outputs are averaged."""
    heads: tuple[Layer, ...]
    """Output layers: logits of contact weights, then the correction (3)."""
    spreads: tuple[tuple[Layer, ...], ...]
    """Layers that map the trunk's output to the Cholesky factor of the error."""
    posture: tuple[Layer, ...]
    inputs: Normalisation
    posture_inputs: Normalisation
    posture_outputs: Normalisation
    unit: Float[Array, ""]
    """Typical displacement, leg lengths, by which the correction is scaled."""
    gain: Float[Array, ""]
    """Factor on displacement: 1, until calibrated after training."""
    future: int = eqx.field(static=True, default=1)
    """1 if displacement may depend on the posture of frame k itself, else 0."""
    posture_frames: int = eqx.field(static=True, default=6)
    """Number of past frames that the predicted posture depends on."""

    @staticmethod
    def init(
        key: PRNGKeyArray,
        past: int,
        width: tuple[int, ...] = (256, 256, 256),
        members: int = 1,
        future: int = 1,
        posture_frames: int = 6,
        posture_width: int = 256,
    ) -> "MetricNetwork":
        """Returns an untrained network."""
        frames = past + future
        posture_frames = min(posture_frames, past)
        d = frames * len(_INPUT_JOINTS) * 3
        d_posture = 72 * (posture_frames - 1) + 69
        keys = jax.random.split(key, 3 * members + 1)
        outputs = (frames - 1) * len(_CONTACT_JOINTS) + 3
        return MetricNetwork(
            trunks=tuple(
                init_layers(keys[3 * m], (d, *width), np.sqrt(2.0))
                for m in range(members)
            ),
            heads=tuple(
                init_layers(keys[3 * m + 1], (width[-1], outputs), 0.1)[0]
                for m in range(members)
            ),
            spreads=tuple(
                init_layers(keys[3 * m + 2], (width[-1], 64, 6), 0.1)
                for m in range(members)
            ),
            posture=init_layers(
                keys[-1], (d_posture, posture_width, posture_width, 72), 0.1
            ),
            inputs=no_normalisation(d),
            posture_inputs=no_normalisation(d_posture),
            posture_outputs=no_normalisation(72),
            unit=jnp.asarray(0.05, jnp.float32),
            gain=jnp.asarray(1.0, jnp.float32),
            future=future,
            posture_frames=posture_frames,
        )

    def frames(self, window: Window) -> Float[Array, "*b f 24 3"]:
        """Returns the joints of the frames that displacement depends on."""
        count = window.joints.shape[-3] - 1 + self.future
        return window.joints[..., :count, :, :]

    def features(self, window: Window) -> Float[Array, "*b d"]:
        """Returns the discrete cosine transform of joint positions over time."""
        joints = self.frames(window)[..., np.array(_INPUT_JOINTS), :]
        basis = jnp.asarray(cosine_basis(joints.shape[-3]), joints.dtype)
        flat = joints.reshape(*joints.shape[:-2], -1)
        out = jnp.einsum("wf,...fd->...wd", basis, flat)
        return out.reshape(*out.shape[:-2], -1)

    def posture_features(self, window: Window) -> Float[Array, "*b d"]:
        """Returns rotations from frame k-1 to earlier frames, and the posture of
        k-1."""
        angles = joint_angles(window)[..., -1 - self.posture_frames : -1, :, :]
        change = so3.between(angles[..., -1:, :, :], angles[..., :-1, :, :])
        flat = lambda x, n: x.reshape(*x.shape[:-n], -1)
        return jnp.concatenate([flat(change, 3), flat(angles[..., -1, 1:, :], 2)], -1)

    def moves(
        self, window: Window, features: Float[Array, "*b d"]
    ) -> tuple[Float[Array, "m *b 3"], Float[Array, "m *b 6"]]:
        """Returns displacement and Cholesky entries of each member, leg lengths."""
        contacts = self.frames(window)[..., np.array(_CONTACT_JOINTS), :]
        still = contacts[..., :-1, :, :] - contacts[..., 1:, :, :]
        still = still.reshape(*still.shape[:-3], -1, 3)
        x = self.inputs(features)
        moves, spreads = [], []
        for trunk, head, spread in zip(
            self.trunks, self.heads, self.spreads, strict=True
        ):
            hidden = jax.nn.silu(apply_layers(trunk, x))
            out = head(hidden)
            weight = jax.nn.softmax(out[..., :-3], -1)
            stance = jnp.einsum("...i,...ic->...c", weight, still)
            moves.append(stance + self.unit * out[..., -3:])
            # The gradient of the covariance must not reach the trunk.
            spreads.append(apply_layers(spread, jax.lax.stop_gradient(hidden)))
        return jnp.stack(moves), jnp.stack(spreads)

    def change(self, window: Window) -> Float[Array, "*b 24 3"]:
        """Returns the rotation of every joint from k-1 to k, in its own frame (rad)."""
        x = self.posture_inputs(self.posture_features(window))
        out = self.posture_outputs.undo(apply_layers(self.posture, x))
        return out.reshape(*out.shape[:-1], 24, 3)

    def __call__(self, window: Window) -> Guess:
        moves, spreads = self.moves(window, self.features(window))
        move = self.gain * moves.mean(0)
        factor = self.unit * lower_triangle(spreads.mean(0))
        leg = window.leg[..., None]
        change = self.change(window)
        last = window.body_pose[..., -2, :, :]
        turned = so3.compose(last, change[..., 1:, :])
        return Guess(
            translation=move * leg,
            cholesky=factor * leg[..., None],
            body_pose=nearest_turn(turned, last),
            rotation=change[..., 0, :],
        )


def nearest_turn(
    angles: Float[Array, "*b 3"], reference: Float[Array, "*b 3"]
) -> Float[Array, "*b 3"]:
    """Returns, of the two rotation vectors of the same rotation, the one nearer to a
    reference (rad)."""
    square = (angles * angles).sum(-1, keepdims=True)
    small = square < 1e-6
    norm = jnp.sqrt(jnp.where(small, 1.0, square))
    other = jnp.where(small, angles, angles * (1 - 2 * np.pi / norm))
    distance = lambda x: ((x - reference) ** 2).sum(-1, keepdims=True)
    return jnp.where(distance(other) < distance(angles), other, angles)


def cosine_basis(frames: int) -> Float[np.ndarray, "f f"]:
    """Returns the orthonormal DCT-II basis: row 0 is the mean, row 1 the trend, ..."""
    i = np.arange(frames)
    basis = np.cos(np.pi * (i[None] + 0.5) * i[:, None] / frames)
    basis *= np.sqrt(2 / frames)
    basis[0] /= np.sqrt(2)
    return basis
