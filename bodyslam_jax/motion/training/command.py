"""Trains from files to files, for `bodyslam train-motion`."""

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
from bodyslam_jax.motion.training.evaluation import kept, named
from bodyslam_jax.motion.training.figures import draw_history
from bodyslam_jax.motion.training.train import train
from bodyslam_jax.motion.weights import save_motion_model


def train_from_data(
    data: Path,
    out: Path,
    settings: MotionTraining,
    report: Callable[[int, int, dict[str, float]], None] | None = None,
    body_model: Path | None = None,
) -> None:
    """Trains on the motion in `data` and writes weights and a plot of the training.

    Training resumes from a checkpoint beside `out` after an interruption;
    `report(epoch, epochs, measures)` is called after each epoch. The model is trained
    for the skeleton of `body_model` only, by default that of `load_body_model`.

    **Raises:** `InputError` if there is no usable motion in `data`, no usable body
    model, or if `out` does not end in `.npz` or cannot be written.
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
    checkpoint.unlink(missing_ok=True)  # not before the weights are written


def _check_writable(out: Path) -> None:
    """Checks before hours of training that weights can be written; leaves no file.

    **Raises:** `InputError` if they cannot.
    """
    if out.suffix != ".npz":
        raise InputError(f"{out}: weights are an .npz file; name it so.")
    if out.is_dir():
        raise InputError(f"{out}: is a folder; expected a file to write weights to.")
    # Missing folders will be made in the nearest existing one.
    folder = next(p for p in out.parents if p.exists())
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(
            f"{out}: {folder} cannot be written ({error.strerror}); expected a "
            "writable folder."
        ) from None
