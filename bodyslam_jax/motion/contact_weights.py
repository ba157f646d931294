"""Files of the contact network: one `.npz` with a JSON header and plain arrays.

Layers are stored in float16, which halves the size; reading does not use pickle.
"""

import dataclasses
import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic
from bodyslam_jax.io.archive import read_npz
from bodyslam_jax.io.files import reading
from bodyslam_jax.motion.contact_network import ContactModel

_FORMAT = "bodyslam-contact-1"
_DEFAULT_FILE = Path(__file__).parent / "assets" / "contact.npz"


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
