"""Predicts from postures which heels and toes are in contact with the ground.

The input of a multilayer perceptron is the joints of a person over about half a second,
relative to the pelvis and rotated into the root frame of the middle frame, in leg
lengths. Steady yaw is removed first, as for displacements. The path of the person is
not an input, as contacts serve to correct it.

A file of the network is one `.npz` with a JSON header and plain arrays. Layers are
stored in float16, which halves the size; reading does not use pickle.
"""

import dataclasses
import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from bodyslam_jax.body import BodyModel, local_joints
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic
from bodyslam_jax.io.archive import read_npz
from bodyslam_jax.io.files import reading
from bodyslam_jax.motion.network import (
    Layer,
    Normalisation,
    apply_layers,
    init_layers,
    no_normalisation,
)
from bodyslam_jax.motion.position_network import cosine_basis
from bodyslam_jax.motion.prediction import (
    in_dtype,
    leg_length,
    straightened,
    turning_rate,
)

POINTS = ("left toe", "left heel", "right toe", "right heel")
"""The points of the feet, in the order of `body.skeleton.BODY25_TOES_AND_HEELS`."""
_INPUT_JOINTS = np.array([1, 2, 4, 5, 7, 8, 10, 11, 6, 12, 15, 20, 21])
"""Joints that are input to the network: legs, spine, head, wrists."""
_FORMAT = "bodyslam-contact-1"
_DEFAULT_FILE = Path(__file__).parent / "assets" / "contact.npz"


class ContactModel(eqx.Module):
    """A contact network, with its body model and frame rate."""

    layers: tuple[Layer, ...]
    inputs: Normalisation
    half: int = eqx.field(static=True)
    """Number of frames before, and after, the classified frame."""
    body: str = eqx.field(static=True)
    """Kind of body model that the network was trained on."""
    fps: float = eqx.field(static=True)
    """Frame rate of the input, 1/s."""
    about: str = eqx.field(static=True, default="{}")
    """The file's header as JSON: data, licence, metrics."""

    @staticmethod
    def init(
        key: PRNGKeyArray, body: str, fps: float, half: int, width: tuple[int, ...]
    ) -> "ContactModel":
        """Returns an untrained network."""
        d = (2 * half + 1) * len(_INPUT_JOINTS) * 3
        layers = init_layers(key, (d, *width, len(POINTS)), 0.1)
        return ContactModel(layers, no_normalisation(d), half, body, fps)

    def logits(self, features: Float[Array, "*b d"]) -> Float[Array, "*b 4"]:
        """Returns the log-odds of contact of each of `POINTS`."""
        return apply_layers(self.layers, self.inputs(features))


def contact_features(
    orientation: Float[Array, "t 3 3"],
    joints: Float[Array, "t 24 3"],
    rows: Int[Array, "w f"],
) -> Float[Array, "w d"]:
    """Returns the input of the network: cosine coefficients of joints over each window.

    Args:
        orientation: rotates H into any fixed frame, without steady yaw.
        joints: positions relative to the pelvis, in H, leg lengths.
        rows: the frames of each window; the middle one is classified.
    """
    facing = jnp.einsum("tab,tjb->tja", orientation, joints[:, _INPUT_JOINTS])
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
    """Predicts the contact probability of each of `POINTS`, 0 in absent frames.

    Args:
        orientation: rotates H into any frame common to the sequence.
        body_pose: θ, rad, at the model's frame rate.
        shape: SMPL β.
        present: frames that are used. Near the ends of a run of frames the first or the
            last one is repeated.

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
    """Returns the frames around each frame, clipped to its run of present frames."""
    t = len(present)
    frame = jnp.arange(t, dtype=jnp.int32)
    absent = jnp.where(present, jnp.int32(-1), frame)
    first = jax.lax.cummax(absent) + 1
    absent = jnp.where(present, jnp.int32(t), frame)
    last = jax.lax.cummin(absent, reverse=True) - 1
    rows = frame[:, None] + jnp.arange(-half, half + 1, dtype=jnp.int32)
    low, high = jnp.minimum(first, frame), jnp.maximum(last, frame)
    return jnp.clip(rows, low[:, None], high[:, None])


def save_contact_model(path: Path | str, model: ContactModel) -> None:
    """Writes a contact network to a file, atomically."""
    path = Path(path)
    header = {
        "format": _FORMAT,
        "width": [layer.weight.shape[1] for layer in model.layers[:-1]],
        "half": model.half,
        "body": model.body,
        "fps": model.fps,
        "about": json.loads(model.about),
    }
    kind = lambda x: np.float16 if x.ndim == 2 else np.float32
    leaves = jax.tree.leaves(model)
    arrays = {f"array_{i}": np.asarray(x, kind(x)) for i, x in enumerate(leaves)}
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic.write_npz(path, {"header": np.array(json.dumps(header)), **arrays})


def load_contact_model(path: Path | str | None = None) -> ContactModel:
    """Reads a contact network (float32); by default that of the package.

    **Raises:** `InputError` if the file is not a contact network.
    """
    path = _DEFAULT_FILE if path is None else Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such contact network.")
    archive = read_npz(path, "a contact network (.npz)")
    header = archive.json("header")
    if (found := header.text("format")) != _FORMAT:
        raise InputError(
            f"{path}: not a contact network: format {found!r}, expected {_FORMAT!r}."
        )
    half, fps = header.whole("half", 1, 1000), header.number("fps", 1, 1000)
    width = header.array("width", (None,), kind="whole", low=1, high=10_000)
    body, about = header.text("body"), header.value("about")
    arrays = [archive.array(f"array_{i}") for i in range(len(archive.names) - 1)]
    if len(width) > 100:
        raise InputError(f"{path}: {len(width)} layers, expected at most 100.")
    init = lambda key: ContactModel.init(key, body, fps, half, tuple(width.tolist()))
    with reading(path, "a contact network's sizes"):
        like = eqx.filter_eval_shape(init, jax.random.key(0))
    expected = [leaf.shape for leaf in jax.tree.leaves(like)]
    if expected != [array.shape for array in arrays]:
        raise InputError(f"{path}: its arrays do not fit the sizes in its header.")
    leaves = [jnp.asarray(array, jnp.float32) for array in arrays]
    model = jax.tree.unflatten(jax.tree.structure(like), leaves)
    return dataclasses.replace(model, about=json.dumps(about))
