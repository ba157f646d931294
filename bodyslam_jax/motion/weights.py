"""Weights in one `.npz`: a JSON header that describes them, then plain arrays.

Read without pickle. The header holds format, network, sizes, body, fps, data, licence
and metrics.
"""

import json
from pathlib import Path
from zipfile import BadZipFile

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic
from bodyslam_jax.motion.paper_network import PaperNetwork
from bodyslam_jax.motion.position_network import MetricNetwork
from bodyslam_jax.motion.prediction import MotionModel

_FORMAT = "bodyslam-motion-1"
_ASSETS = Path(__file__).parent / "assets"
SHIPPED = ("default", "paper")
"""Motion models that come with the package: the default, and the paper's network."""


def save_motion_model(
    path: Path | str, model: MotionModel, *, half: bool = False
) -> None:
    """Writes a model atomically.

    `half` stores the weights of layers in float16, in half the space; they are of order
    1 and lose their fourth digit. All else stays in float32.

    **Raises:** `InputError` for a custom network, whose class no reader would know.
    """
    path = Path(path)
    network = model.network
    if not isinstance(network, PaperNetwork | MetricNetwork):
        raise InputError(
            f"{path}: found a network of class {type(network).__name__}, expected one "
            "of the package; save a custom one with `eqx.tree_serialise_leaves`."
        )
    sizes = {"past": model.past}
    if isinstance(network, PaperNetwork):
        sizes["width"] = network.encoder[0].weight.shape[1]
    else:
        sizes |= {
            "width": [layer.weight.shape[1] for layer in network.trunks[0]],
            "members": len(network.trunks),
            "future": network.future,
            "posture_frames": network.posture_frames,
            "posture_width": network.posture[0].weight.shape[1],
        }
    header = {
        "format": _FORMAT,
        "network": "paper" if isinstance(network, PaperNetwork) else "metric",
        "sizes": sizes,
        "body": model.body,
        "fps": model.fps,
        "about": json.loads(model.about),
    }
    kind = lambda x: (
        np.float16 if half and x.ndim == 2 and x.size > 1000 else np.float32
    )
    leaves = {
        f"array_{i}": np.asarray(x, kind(x))
        for i, x in enumerate(jax.tree.leaves(network))
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic.write_npz(path, {"header": np.array(json.dumps(header)), **leaves})


def load_motion_model(path: Path | str | None = None) -> MotionModel:
    """Reads a model's weights (float32): of a file, or by name of `SHIPPED`.

    **Raises:** `FileNotFoundError`; `ValueError` if the file holds no motion model.
    """
    name = "default" if path is None else str(path)
    path = _ASSETS / f"{name}.npz" if name in SHIPPED else Path(name)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such motion model.")
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            header = json.loads(str(archive["header"]))
            arrays = [archive[f"array_{i}"] for i in range(len(archive.files) - 1)]
    except (OSError, EOFError, KeyError, TypeError, ValueError, BadZipFile) as error:
        raise InputError(f"{path}: not a motion model ({error}).") from None
    if header.get("format") != _FORMAT:
        raise InputError(
            f"{path}: format {header.get('format')!r}; expected {_FORMAT!r}."
        )
    try:
        like = _untrained(header)
        body, fps, about = header["body"], float(header["fps"]), header["about"]
        past = int(header["sizes"]["past"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: header lacks or misstates {error}.") from None
    if not (np.isfinite(fps) and fps > 0):
        raise InputError(
            f"{path}: {fps:g} frames per second; expected a positive number."
        )
    wanted = [leaf.shape for leaf in jax.tree.leaves(like)]
    found = [array.shape for array in arrays]
    if wanted != found:
        raise InputError(
            f"{path}: arrays {found[:3]}... do not fit the header's sizes; "
            f"expected {wanted[:3]}..."
        )
    if not all(np.isfinite(array).all() for array in arrays):
        raise InputError(f"{path}: NaN or infinite weights.")
    network = jax.tree.unflatten(
        jax.tree.structure(like), [jnp.asarray(a, jnp.float32) for a in arrays]
    )
    return MotionModel(network, body, fps, past, json.dumps(about))


def _untrained(header: dict) -> MetricNetwork | PaperNetwork:
    """Shapes and types of the network in a header."""
    sizes, key = header["sizes"], jax.random.key(0)
    if header["network"] == "paper":
        make = lambda: PaperNetwork.init(key, sizes["past"], sizes["width"])
    else:
        make = lambda: MetricNetwork.init(
            key,
            sizes["past"],
            tuple(sizes["width"]),
            sizes["members"],
            sizes["future"],
            sizes["posture_frames"],
            sizes["posture_width"],
        )
    return eqx.filter_eval_shape(make)
