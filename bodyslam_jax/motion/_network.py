"""The networks: multi-layer perceptrons as plain arrays, `init` and `apply`.

Both presets see a `Window`: frames k-n to k of one person, seen from H_{k-1}. The
paper's (section 3.4) sees joint angles up to k-1. The default sees where the joints
are, in units of leg length, and from that says how far the pelvis came from k-1 to k.
"""

from typing import Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from bodyslam_jax.motion import _rotations as rotations
from bodyslam_jax.motion._rotations import vector

SEEN = (1, 2, 4, 5, 7, 8, 10, 11, 6, 12, 15, 16, 17, 20, 21)
"""Joints whose positions the default network sees: legs, spine, head, hands."""
CONTACTS = (7, 8, 10, 11)
"""Joints that may stand on the ground: ankles and feet."""


class Window(eqx.Module):
    """What a network may see of frames k-n..k (`p = n + 1`, the last one is k)."""

    rotation: Float[Array, "*b p 3 3"]
    """C_{H_{k-1}}^T C_{H_i}: root orientations seen from the body at k-1."""
    body_pose: Float[Array, "*b p 23 3"]
    """θ, axis-angle, rad."""
    joints: Float[Array, "*b p 24 3"]
    """Relative to the pelvis, turned into H_{k-1}, in leg lengths."""
    shape: Float[Array, "*b 10"]
    """β"""
    leg: Float[Array, "*b"]
    """Leg length, m."""


class Guess(eqx.Module):
    """A prediction of one step from H_{k-1} to H_k."""

    translation: Float[Array, "*b 3"]
    """Displacement of the pelvis joint in H_{k-1}, m."""
    cholesky: Float[Array, "*b 3 3"]
    """Lower Cholesky factor of the translation's covariance, m."""
    body_pose: Float[Array, "*b 23 3"]
    """θ_k, from frames up to k-1 alone, rad."""
    rotation: Float[Array, "*b 3"]
    """Rotation vector of C_{H_{k-1}}^T C_{H_k}, from frames up to k-1 alone."""


class Layer(eqx.Module):
    """An affine map."""

    weight: Float[Array, "i o"]
    bias: Float[Array, " o"]

    def __call__(self, x: Float[Array, "*b i"]) -> Float[Array, "*b o"]:
        return x @ self.weight + self.bias


def init_layers(
    key: PRNGKeyArray, sizes: tuple[int, ...], last: float = 1.0
) -> tuple[Layer, ...]:
    """He's initialisation; the last layer is scaled by `last`."""
    layers = []
    for i, (rows, columns) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
        gain = np.sqrt(2 / rows) if i < len(sizes) - 2 else last / np.sqrt(rows)
        weight = jax.random.normal(
            jax.random.fold_in(key, i), (rows, columns), jnp.float32
        )
        layers.append(Layer(weight * float(gain), jnp.zeros(columns, jnp.float32)))
    return tuple(layers)


def apply_layers(
    layers: tuple[Layer, ...], x: Float[Array, "*b i"], smooth: bool = True
) -> Float[Array, "*b o"]:
    """Affine maps with SiLU (or ReLU) between them, none after the last."""
    for layer in layers[:-1]:
        x = layer(x)
        x = jax.nn.silu(x) if smooth else jax.nn.relu(x)
    return layers[-1](x)


def lower_triangle(entries: Float[Array, "*b 6"]) -> Float[Array, "*b 3 3"]:
    """A Cholesky factor: three log-diagonals, then the entries 10, 20, 21."""
    diagonal = jnp.exp(jnp.clip(entries[..., :3], -12.0, 6.0))
    off = entries[..., 3:] * diagonal[..., np.array([1, 2, 2])]
    zero = jnp.zeros_like(diagonal[..., 0])
    rows = [
        [diagonal[..., 0], zero, zero],
        [off[..., 0], diagonal[..., 1], zero],
        [off[..., 1], off[..., 2], diagonal[..., 2]],
    ]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)


class Normalisation(eqx.Module):
    """Mean and standard deviation of one vector over the training data."""

    mean: Float[Array, " d"]
    std: Float[Array, " d"]

    def __call__(self, x: Float[Array, "*b d"]) -> Float[Array, "*b d"]:
        return (x - self.mean) / self.std

    def undo(self, x: Float[Array, "*b d"]) -> Float[Array, "*b d"]:
        return x * self.std + self.mean


def normalisation(samples: Float[np.ndarray, "n d"]) -> Normalisation:
    """Measures it; what never varies is left as it is."""
    mean, std = samples.mean(0), samples.std(0)
    std = np.where(std < 1e-5, 1.0, std)
    return Normalisation(jnp.asarray(mean, jnp.float32), jnp.asarray(std, jnp.float32))


class Network(Protocol):
    """Whatever turns windows into guesses."""

    def __call__(self, window: Window) -> Guess: ...


class PaperNetwork(eqx.Module):
    """Section 3.4: encoder on joint angles, decoders for position and posture."""

    encoder: tuple[Layer, ...]
    position: tuple[Layer, ...]
    posture: tuple[Layer, ...]
    inputs: Normalisation
    outputs: Normalisation
    """Of displacement (3) and of posture (72)."""
    spread: Float[Array, "3 3"]
    """Cholesky factor of the error's covariance on validation data, m: constant."""

    @staticmethod
    def features(window: Window) -> Float[Array, "*b d"]:
        """Angles of frames k-n..k-1, the root's relative to frame k-1, and β."""
        angles = _angles(window)[..., :-1, :, :]
        flat = angles.reshape(*angles.shape[:-3], -1)
        return jnp.concatenate([flat, window.shape], -1)

    @staticmethod
    def init(key: PRNGKeyArray, past: int, width: int = 1024) -> "PaperNetwork":
        keys = jax.random.split(key, 3)
        d = past * 72 + 10
        none = lambda n: Normalisation(
            jnp.zeros(n, jnp.float32), jnp.ones(n, jnp.float32)
        )
        return PaperNetwork(
            encoder=init_layers(keys[0], (d, width, width, width), np.sqrt(2.0)),
            position=init_layers(keys[1], (width, width, width, 3)),
            posture=init_layers(keys[2], (width, width, width, 72), 0.1),
            inputs=none(d),
            outputs=none(75),
            spread=0.02 * jnp.eye(3, dtype=jnp.float32),
        )

    def normalised(self, features: Float[Array, "*b d"]) -> Float[Array, "*b 75"]:
        """Displacement and posture as the loss sees them, normalised."""
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


def _angles(window: Window) -> Float[Array, "*b p 24 3"]:
    root = vector(window.rotation)[..., None, :]
    return jnp.concatenate([root, window.body_pose], -2)


class MetricNetwork(eqx.Module):
    """Where the joints were over the window, and which of them stood still.

    The displacement is a weighted sum over contact joints and past frames of what each
    joint's motion relative to the pelvis would mean if it stood on the ground (the
    weights, positive and of sum 1, come from the network), plus a correction.
    Everything is in leg lengths, so that the size of a person cancels exactly.
    """

    trunks: tuple[tuple[Layer, ...], ...]
    """One per member of the ensemble; members are averaged."""
    heads: tuple[Layer, ...]
    """Logits of contact weights, then the correction (3)."""
    spreads: tuple[tuple[Layer, ...], ...]
    """The error's Cholesky factor from the trunk's last layer."""
    posture: tuple[Layer, ...]
    inputs: Normalisation
    posture_inputs: Normalisation
    posture_outputs: Normalisation
    unit: Float[Array, ""]
    """Typical displacement in leg lengths: scale of the correction."""
    gain: Float[Array, ""]
    """Calibration of displacement, found after training; 1 is none."""
    future: int = eqx.field(static=True, default=1)
    """1 if displacement may depend on the posture of frame k itself, else 0."""
    posture_frames: int = eqx.field(static=True, default=6)
    """How many past frames the predicted posture depends on."""

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
        frames = past + future
        posture_frames = min(posture_frames, past)
        d = frames * len(SEEN) * 3
        d_posture = 72 * (posture_frames - 1) + 69
        keys = jax.random.split(key, 3 * members + 1)
        none = lambda n: Normalisation(
            jnp.zeros(n, jnp.float32), jnp.ones(n, jnp.float32)
        )
        outputs = (frames - 1) * len(CONTACTS) + 3
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
            inputs=none(d),
            posture_inputs=none(d_posture),
            posture_outputs=none(72),
            unit=jnp.asarray(0.05, jnp.float32),
            gain=jnp.asarray(1.0, jnp.float32),
            future=future,
            posture_frames=posture_frames,
        )

    def frames(self, window: Window) -> Float[Array, "*b f 24 3"]:
        """Joints over the frames that displacement depends on."""
        count = window.joints.shape[-3] - 1 + self.future
        return window.joints[..., :count, :, :]

    def features(self, window: Window) -> Float[Array, "*b d"]:
        """Positions over time as cosine coefficients: from slow to fast."""
        seen = self.frames(window)[..., np.array(SEEN), :]
        basis = jnp.asarray(cosine_basis(seen.shape[-3]), seen.dtype)
        flat = seen.reshape(*seen.shape[:-2], -1)
        out = jnp.einsum("wf,...fd->...wd", basis, flat)
        return out.reshape(*out.shape[:-2], -1)

    def posture_features(self, window: Window) -> Float[Array, "*b d"]:
        """How frames up to k-1 differ from frame k-1, and its posture."""
        angles = _angles(window)[..., -1 - self.posture_frames : -1, :, :]
        change = rotations.change(angles[..., -1:, :, :], angles[..., :-1, :, :])
        flat = lambda x, n: x.reshape(*x.shape[:-n], -1)
        return jnp.concatenate([flat(change, 3), flat(angles[..., -1, 1:, :], 2)], -1)

    def moves(
        self, window: Window, features: Float[Array, "*b d"]
    ) -> tuple[Float[Array, "m *b 3"], Float[Array, "m *b 6"]]:
        """Every member's displacement and error, in leg lengths."""
        contacts = self.frames(window)[..., np.array(CONTACTS), :]
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
            # the error is learnt beside the mean without bending it
            spreads.append(apply_layers(spread, jax.lax.stop_gradient(hidden)))
        return jnp.stack(moves), jnp.stack(spreads)

    def change(self, window: Window) -> Float[Array, "*b 24 3"]:
        """Rotation of every joint from k-1 to k, in its own frame (rad)."""
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
        turned = rotations.turned(last, change[..., 1:, :])
        return Guess(
            translation=move * leg,
            cholesky=factor * leg[..., None],
            body_pose=nearest_turn(turned, last),
            rotation=change[..., 0, :],
        )


def nearest_turn(
    angles: Float[Array, "*b 3"], reference: Float[Array, "*b 3"]
) -> Float[Array, "*b 3"]:
    """Of the two rotation vectors of a rotation, the one nearer to a reference."""
    square = (angles * angles).sum(-1, keepdims=True)
    small = square < 1e-6
    norm = jnp.sqrt(jnp.where(small, 1.0, square))
    other = jnp.where(small, angles, angles * (1 - 2 * np.pi / norm))
    distance = lambda x: ((x - reference) ** 2).sum(-1, keepdims=True)
    return jnp.where(distance(other) < distance(angles), other, angles)


def cosine_basis(frames: int) -> Float[np.ndarray, "f f"]:
    """Orthonormal DCT-II: row 0 is the mean over the window, row 1 the trend, ..."""
    i = np.arange(frames)
    basis = np.cos(np.pi * (i[None] + 0.5) * i[:, None] / frames)
    basis *= np.sqrt(2 / frames)
    basis[0] /= np.sqrt(2)
    return basis
