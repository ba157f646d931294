"""Checkpoints of a training run, written atomically and tied to that run."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import MotionTraining
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic
from bodyslam_jax.io.archive import read_npz
from bodyslam_jax.motion.training.sampling import Corpus

Tree = TypeVar("Tree")


def fingerprint(settings: MotionTraining, data: Corpus, body: BodyModel) -> str:
    """A hash of settings, data and body: a checkpoint of another run is refused."""
    mark = hashlib.sha256(json.dumps(dataclasses.asdict(settings)).encode())
    mark.update(body.kind.encode())
    for array in (data.poses, data.path, data.start):
        mark.update(np.asarray(array).tobytes())
    return mark.hexdigest()


def save_checkpoint(path: Path, progress: object, mark: str) -> None:
    """Writes everything, then puts it in place in one step."""
    leaves = {
        f"leaf_{i}": np.asarray(x) for i, x in enumerate(jax.tree.leaves(progress))
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic.write_npz(path, {"mark": np.array(mark), **leaves}, compressed=False)


def load_checkpoint(path: Path, like: Tree, mark: str) -> Tree:
    """Reads what `save_checkpoint` wrote.

    **Raises:** `InputError` if it is damaged or of another run.
    """
    archive = read_npz(path, "a training checkpoint")
    if archive.text("mark") != mark:
        raise InputError(
            f"{path}: checkpoint of other settings or data; remove it to start anew."
        )
    leaves = [archive.raw(f"leaf_{i}") for i in range(len(archive.names) - 1)]
    wanted = [np.shape(leaf) for leaf in jax.tree.leaves(like)]
    if [leaf.shape for leaf in leaves] != wanted:
        raise InputError(f"{path}: its arrays are not those of this training.")
    return jax.tree.unflatten(jax.tree.structure(like), map(jnp.asarray, leaves))
