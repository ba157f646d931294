"""Training from files to files: what `bodyslam train-motion` does."""

import logging
from pathlib import Path

from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import MotionTraining
from bodyslam_jax.motion._clips import split
from bodyslam_jax.motion._readers import read_motion
from bodyslam_jax.motion._training import draw_history, train
from bodyslam_jax.motion._weights import save_motion_model

log = logging.getLogger(__name__)


def train_from_data(data: Path, out: Path, settings: MotionTraining) -> None:
    """Trains on the motion in `data` and writes weights, and a picture of how it went.

    A checkpoint beside `out` is taken up again after an interruption.

    **Raises:** `ValueError` if there is no usable motion in `data`.
    """
    known, validation = split(read_motion(data))
    model, history = train(
        known,
        load_body_model(),
        settings,
        validation=validation,
        checkpoint=out.with_suffix(".ckpt.npz"),
        report=lambda epoch, epochs, found: log.info(
            "epoch %d of %d: %s", epoch, epochs, found
        ),
    )
    save_motion_model(out, model)
    draw_history(history, out.with_suffix(".png"))
