"""Training from files to files: what `bodyslam train-motion` does."""

import dataclasses
import json
import tempfile
from collections.abc import Callable
from pathlib import Path

from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import MotionTraining
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.motion.capture.clips import split
from bodyslam_jax.motion.capture.readers import read_motion
from bodyslam_jax.motion.training.figures import draw_history
from bodyslam_jax.motion.training.selection import kept, named
from bodyslam_jax.motion.training.train import train
from bodyslam_jax.motion.weights import save_motion_model


def train_from_data(
    data: Path,
    out: Path,
    settings: MotionTraining,
    report: Callable[[int, int, dict[str, float]], None] | None = None,
    body_model: Path | None = None,
) -> None:
    """Trains on the motion in `data` and writes weights, and a picture of how it went.

    A checkpoint beside `out` is taken up again after an interruption; `report(epoch,
    epochs, measures)` is called after each epoch. The model will know the skeleton of
    `body_model`, by default the one that `load_body_model` finds, and no other.

    **Raises:** `InputError` if there is no usable motion in
    `data`, no usable body model, or if `out` does not end in `.npz` or cannot be
    written.
    """
    _check_writable(out)
    training, validation = split(read_motion(data))
    checkpoint = out.with_suffix(".ckpt.npz")
    model, history = train(
        training,
        load_body_model(body_model),
        settings,
        validation=validation,
        checkpoint=checkpoint,
        report=report,
    )
    epoch = kept(history, settings.drift_deg)
    about = {
        "data": f"{len(training)} clips of {data.name}",
        "licence": "not stated; that of the data applies",
        "settings": dataclasses.asdict(settings),
        "metrics": {} if epoch is None else named(history[epoch, 1:]),
    }
    save_motion_model(out, dataclasses.replace(model, about=json.dumps(about)))
    draw_history(history, out.with_suffix(".png"))
    checkpoint.unlink(missing_ok=True)  # only now is nothing lost without it


def _check_writable(out: Path) -> None:
    """Fails before hours of training, not after them; leaves nothing behind."""
    if out.suffix != ".npz":
        raise InputError(f"{out}: weights are an .npz file; name it so.")
    if out.is_dir():
        raise InputError(f"{out}: is a folder; expected a file to write weights to.")
    # Folders that are missing will be made: what counts is where.
    folder = next(p for p in out.parents if p.exists())
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(
            f"{out}: {folder} cannot be written ({error.strerror}); expected a "
            "writable folder."
        ) from None
