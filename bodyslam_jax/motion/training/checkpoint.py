"""Checkpoints of a training run, written atomically and tied to that run."""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import TypeVar
from zipfile import BadZipFile

import jax
import jax.numpy as jnp
import numpy as np

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import MotionTraining
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic
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
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            found = str(archive["mark"])
            leaves = [archive[f"leaf_{i}"] for i in range(len(archive.files) - 1)]
    except (OSError, EOFError, KeyError, TypeError, ValueError, BadZipFile) as error:
        raise InputError(f"{path}: not a training checkpoint ({error}).") from None
    if found != mark:
        raise InputError(
            f"{path}: checkpoint of other settings or data; remove it to start anew."
        )
    return jax.tree.unflatten(jax.tree.structure(like), map(jnp.asarray, leaves))
