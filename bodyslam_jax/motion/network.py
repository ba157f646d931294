"""Input, output and layers of the motion networks.

A network maps a `Window`, frames k-n to k of one person relative to H_{k-1}, to a
`Guess` of the step from k-1 to k. The two networks are in `paper_network.py` and
`position_network.py`; `own_model.py` wraps a user's function.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from bodyslam_jax.geometry import so3


class Window(eqx.Module):
    """Input of a network: frames k-n to k (`p = n + 1`; the last one is k)."""

    rotation: Float[Array, "*b p 3 3"]
    """C_{H_{k-1}}^T C_{H_i}: root orientations relative to the body at k-1."""
    body_pose: Float[Array, "*b p 23 3"]
    """θ, axis-angle, rad."""
    joints: Float[Array, "*b p 24 3"]
    """Positions relative to the pelvis, rotated into H_{k-1}, in leg lengths."""
    shape: Float[Array, "*b 10"]
    """SMPL β."""
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


class MotionNetwork(eqx.Module):
    """A parametrised function that maps a window to a guess of its last step.

    A custom network is trained by `train(..., network=...)`, with the Gaussian
    likelihood of its guesses, and used by `bs.build` and `Problem.with_motion_model`
    within a `MotionModel`. All its float32 arrays are trained.
    """

    @abc.abstractmethod
    def __call__(self, window: Window) -> Guess:
        """Returns the guess for each window, with the same leading axes."""


class Layer(eqx.Module):
    """An affine map `x W + b`."""

    weight: Float[Array, "i o"]
    bias: Float[Array, " o"]

    def __call__(self, x: Float[Array, "*b i"]) -> Float[Array, "*b o"]:
        return x @ self.weight + self.bias


def init_layers(
    key: PRNGKeyArray, sizes: tuple[int, ...], last: float = 1.0
) -> tuple[Layer, ...]:
    """Initialises layers by He's method; the last one is scaled by `last`."""
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
    """Applies affine maps with SiLU (or ReLU) between them, and none after the last."""
    for layer in layers[:-1]:
        x = layer(x)
        x = jax.nn.silu(x) if smooth else jax.nn.relu(x)
    return layers[-1](x)


def lower_triangle(entries: Float[Array, "*b 6"]) -> Float[Array, "*b 3 3"]:
    """Returns a Cholesky factor from three log-diagonals and the entries 10, 20, 21."""
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
        """Inverts the normalisation."""
        return x * self.std + self.mean


def normalisation(samples: Float[np.ndarray, "n d"]) -> Normalisation:
    """Computes mean and standard deviation of samples; constant components keep unit
    scale."""
    mean, std = samples.mean(0), samples.std(0)
    std = np.where(std < 1e-5, 1.0, std)
    return Normalisation(jnp.asarray(mean, jnp.float32), jnp.asarray(std, jnp.float32))


def no_normalisation(size: int) -> Normalisation:
    """Returns the normalisation that changes nothing."""
    return Normalisation(jnp.zeros(size, jnp.float32), jnp.ones(size, jnp.float32))


def joint_angles(window: Window) -> Float[Array, "*b p 24 3"]:
    """Returns the root's rotation vector relative to H_{k-1}, and θ, of every frame
    (rad)."""
    root = so3.log(window.rotation)[..., None, :]
    return jnp.concatenate([root, window.body_pose], -2)
