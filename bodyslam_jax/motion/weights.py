"""Files of motion models: one `.npz` with a JSON header and plain arrays.

Reading does not use pickle. The header holds format, network, sizes, body, fps, data,
licence and metrics.
"""

import json
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic
from bodyslam_jax.io.archive import read_npz
from bodyslam_jax.io.declared import Fields
from bodyslam_jax.io.files import reading
from bodyslam_jax.motion.paper_network import PaperNetwork
from bodyslam_jax.motion.position_network import MetricNetwork
from bodyslam_jax.motion.prediction import MotionModel

_FORMAT = "bodyslam-motion-1"
_MAX_WIDTH, _MAX_FRAMES, _MAX_MEMBERS = 10_000, 1000, 100
"""Upper bounds of a layer's width, of the frames of a window, and of the number of
layers or ensemble members."""
_ASSETS = Path(__file__).parent / "assets"
PACKAGE_MODELS = ("default", "paper")
"""Names of the motion models in the package: the default, and the paper's network."""


def save_motion_model(
    path: Path | str, model: MotionModel, *, half: bool = False
) -> None:
    """Writes a motion model to a file, atomically.

    `half` stores the weights of layers in float16, which halves the size; they are of
    order 1 and lose their fourth digit. All other arrays remain in float32.

    **Raises:** `InputError` for a custom network, whose class `load_motion_model` does
    not know.
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
    """Reads a motion model (float32) from a file, or by a name in `PACKAGE_MODELS`.

    **Raises:** `InputError` if the file is not a motion model.
    """
    name = "default" if path is None else str(path)
    path = _ASSETS / f"{name}.npz" if name in PACKAGE_MODELS else Path(name)
    if not path.exists():
        raise InputError(f"{path}: no such motion model.")
    archive = read_npz(path, "a motion model (.npz)")
    if "header" not in archive.names:
        raise InputError(
            f"{path}: not a motion model: no array `header`, only {archive.names[:4]}."
        )
    header = archive.json("header")
    if (found := header.text("format")) != _FORMAT:
        raise InputError(
            f"{path}: not a motion model: format {found!r}, expected {_FORMAT!r}."
        )
    like = _untrained(header)
    body, about = header.text("body"), header.value("about")
    fps = header.number("fps", 1, 1000)
    past = header.fields("sizes").whole("past", 1, _MAX_FRAMES)
    arrays = [archive.array(f"array_{i}") for i in range(len(archive.names) - 1)]
    wanted = [leaf.shape for leaf in jax.tree.leaves(like)]
    shapes = [array.shape for array in arrays]
    if wanted != shapes:
        raise InputError(
            f"{path}: arrays {shapes[:3]}... do not fit the header's sizes; "
            f"expected {wanted[:3]}..."
        )
    network = jax.tree.unflatten(
        jax.tree.structure(like), [jnp.asarray(a, jnp.float32) for a in arrays]
    )
    return MotionModel(network, body, fps, past, json.dumps(about))


def _untrained(header: Fields) -> MetricNetwork | PaperNetwork:
    """Returns the shapes and types of the network that a header describes.

    **Raises:** `InputError`, naming the file, if no network can have these sizes.
    """
    sizes, key = header.fields("sizes"), jax.random.key(0)
    past = sizes.whole("past", 1, _MAX_FRAMES)
    if header.text("network", among=("paper", "metric")) == "paper":
        width = sizes.whole("width", 1, _MAX_WIDTH)
        make = lambda: PaperNetwork.init(key, past, width)
    else:
        members = sizes.whole("members", 1, _MAX_MEMBERS)
        widths = sizes.array("width", (None,), kind="whole", low=1, high=_MAX_WIDTH)
        if not 1 <= len(widths) <= _MAX_MEMBERS:
            raise InputError(
                f"{header.path}: {len(widths)} layers, expected 1 to {_MAX_MEMBERS}."
            )
        names = ("future", "posture_frames", "posture_width")
        more = [sizes.whole(name, 0, _MAX_FRAMES) for name in names]
        make = lambda: MetricNetwork.init(
            key, past, tuple(widths.tolist()), members, *more
        )
    with reading(header.path, "a motion model's sizes"):
        return eqx.filter_eval_shape(make)
