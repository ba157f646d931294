"""Which of heels and toes stand on the ground, from postures.

A multilayer perceptron reads the joints of a person over about half a second, relative
to the pelvis and turned into the root frame of the middle frame, in leg lengths. Steady
yaw is removed first, as for displacements. The path of the person is not an input:
contacts are to correct it.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from bodyslam_jax.body import BodyModel, local_joints
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.motion.network import (
    Layer,
    Normalisation,
    apply_layers,
    init_layers,
    no_normalisation,
)
from bodyslam_jax.motion.position_network import cosine_basis
from bodyslam_jax.motion.prediction import in_dtype, leg_length
from bodyslam_jax.motion.yaw_removal import straightened, turning_rate

POINTS = ("left toe", "left heel", "right toe", "right heel")
"""The points of the feet, in the order of `body.skeleton.BODY25_TOES_AND_HEELS`."""
_JOINTS = np.array([1, 2, 4, 5, 7, 8, 10, 11, 6, 12, 15, 20, 21])
"""Joints that are read: legs, spine, head, wrists."""


class ContactModel(eqx.Module):
    """A network, with the body and the frame rate that it is made for."""

    layers: tuple[Layer, ...]
    inputs: Normalisation
    half: int = eqx.field(static=True)
    """Frames before and after the one that is judged."""
    body: str = eqx.field(static=True)
    """Kind of body model that it was trained on."""
    fps: float = eqx.field(static=True)
    about: str = eqx.field(static=True, default="{}")
    """The file's header as JSON: data, licence, metrics."""

    @staticmethod
    def init(
        key: PRNGKeyArray, body: str, fps: float, half: int, width: tuple[int, ...]
    ) -> "ContactModel":
        """An untrained network."""
        d = (2 * half + 1) * len(_JOINTS) * 3
        layers = init_layers(key, (d, *width, len(POINTS)), 0.1)
        return ContactModel(layers, no_normalisation(d), half, body, fps)

    def logits(self, features: Float[Array, "*b d"]) -> Float[Array, "*b 4"]:
        """Log-odds that each of `POINTS` stands."""
        return apply_layers(self.layers, self.inputs(features))


def contact_features(
    orientation: Float[Array, "t 3 3"],
    joints: Float[Array, "t 24 3"],
    rows: Int[Array, "w f"],
) -> Float[Array, "w d"]:
    """What the network reads: cosine coefficients of joints over each window.

    Args:
        orientation: takes H to any one frame; steady yaw removed.
        joints: relative to the pelvis, in H, leg lengths.
        rows: the frames of each window; the middle one is judged.
    """
    facing = jnp.einsum("tab,tjb->tja", orientation, joints[:, _JOINTS])
    middle = orientation[rows[:, rows.shape[1] // 2]]
    seen = jnp.einsum("wba,wfjb->wfja", middle, facing[rows])
    basis = jnp.asarray(cosine_basis(rows.shape[1]), seen.dtype)
    return jnp.einsum("cf,wfja->wcja", basis, seen).reshape(len(rows), -1)


def predict_contact(
    model: ContactModel,
    body: BodyModel,
    orientation: Float[Array, "t 3 3"],
    body_pose: Float[Array, "t 23 3"],
    shape: Float[Array, " 10"],
    present: Bool[Array, " t"],
) -> Float[Array, "t 4"]:
    """Probability that each of `POINTS` stands on the ground, 0 in absent frames.

    Args:
        orientation: takes H to any frame that is common to the sequence.
        body_pose: θ, rad, at the model's frame rate.
        shape: β.
        present: the frames to be used. Near the ends of a run of frames the first or
            the last one is repeated.

    **Raises:** `InputError` if the weights belong to another body model.
    """
    if model.body != body.kind:
        raise InputError(
            f"the contact network was trained on body {model.body!r}, not "
            f"{body.kind!r}; train one with `motion.train_contact`."
        )
    orientation = straightened(orientation, turning_rate(orientation, present))
    joints = local_joints(body, body_pose, shape) / leg_length(body, shape)
    rows = windows_within(present, model.half)
    features = contact_features(orientation, joints, rows)
    logits = in_dtype(model, features.dtype).logits(features)
    return jnp.where(present[:, None], jax.nn.sigmoid(logits), 0.0)


def windows_within(present: Bool[Array, " t"], half: int) -> Int[Array, "t f"]:
    """Frames around each frame, kept within its run of present frames."""
    t = len(present)
    frame = jnp.arange(t, dtype=jnp.int32)
    absent = jnp.where(present, jnp.int32(-1), frame)
    first = jax.lax.cummax(absent) + 1
    absent = jnp.where(present, jnp.int32(t), frame)
    last = jax.lax.cummin(absent, reverse=True) - 1
    rows = frame[:, None] + jnp.arange(-half, half + 1, dtype=jnp.int32)
    low, high = jnp.minimum(first, frame), jnp.maximum(last, frame)
    return jnp.clip(rows, low[:, None], high[:, None])
