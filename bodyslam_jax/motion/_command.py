"""Training from files to files: what `bodyslam train-motion` does."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import MotionTraining
from bodyslam_jax.motion._clips import split
from bodyslam_jax.motion._figures import draw_history
from bodyslam_jax.motion._readers import read_motion
from bodyslam_jax.motion._training import train
from bodyslam_jax.motion._weights import save_motion_model


def train_from_data(
    data: Path,
    out: Path,
    settings: MotionTraining,
    report: Callable[[int, int, dict[str, float]], None] | None = None,
) -> None:
    """Trains on the motion in `data` and writes weights, and a picture of how it went.

    A checkpoint beside `out` is taken up again after an interruption; `report(epoch,
    epochs, measures)` is called after each epoch.

    **Raises:** `ValueError` if there is no usable motion in `data`, or if `out` is no
    name of an `.npz` file.
    """
    if out.suffix != ".npz":
        raise ValueError(f"{out}: weights are an .npz file; name it so.")
    known, validation = split(read_motion(data))
    checkpoint = out.with_suffix(".ckpt.npz")
    model, history = train(
        known,
        load_body_model(),
        settings,
        validation=validation,
        checkpoint=checkpoint,
        report=report,
        about={
            "data": f"{len(known)} clips of {data.name}",
            "settings": dataclasses.asdict(settings),
        },
    )
    save_motion_model(out, model)
    draw_history(history, out.with_suffix(".png"))
    checkpoint.unlink()  # only now is nothing lost without it
