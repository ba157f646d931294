"""Trains motion models such as the default, and makes the table about it.

    python tools/train_default_motion.py DATA --out FILE [--epochs N]
    python tools/train_default_motion.py DATA --out FILE --start FILE
        [--also SUBJECT... | --everybody]
    python tools/train_default_motion.py DATA --table [NAME=FILE ...]

DATA is the folder with the CMU archives. Subjects of `HELD_OUT` are left out of
training; those of them whom the archives name for validation choose the epoch and the
size of the covariance. A first training takes a quarter of an hour of processor time,
and goes on where it stopped. `--start` goes on training another network in its place,
in two minutes. Then `--also` learns from some of `HELD_OUT` too, as a fold does, and
`--everybody` from all of them: by how much deviations are too small cannot be seen of
people who were learnt from, so that the factor remains the one that was found while
they were held out. (The network that ships was trained before there was
`cmu_more.npz`, and has learnt from subjects 06 and 49; `benchmarks/motion.md` says why
it stays.)

Weights and curve are written. With `--table` nothing is trained: the weights that ship
are judged, and beside them those in the named files.
"""

import argparse
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

from make_posture_prior import HELD_OUT
from train_contact import ABOUT, read

from bodyslam_jax.body import BodyModel, load_body_model
from bodyslam_jax.config import MotionTraining
from bodyslam_jax.motion import (
    Clip,
    MotionModel,
    compare,
    draw_history,
    load_motion_model,
    save_motion_model,
    train,
    write_table,
)
from bodyslam_jax.motion.training.evaluation import widened

FURTHER = {"learning_rate": 3e-4, "averaging": 0.99, "epochs": 6, "validate_every": 6}
"""Settings of a further training, in place of those of a first one."""
JUDGED_OTHER = ("02", "14")
"""Subjects whose other motion is judged: the network that ships has not learnt from
them."""


def report(epoch: int, epochs: int, measures: dict[str, float]) -> None:
    """One line an epoch."""
    told = ", ".join(f"{name} {value:.3f}" for name, value in measures.items())
    print(f"{epoch}/{epochs}: {told}", flush=True)


def judged(
    models: dict[str, MotionModel], body: BodyModel, clips: Sequence[Clip]
) -> list[dict[str, str | float]]:
    """Rows of the table: walks and runs of validation subjects, then other motion."""
    walks = [clip for clip in clips if clip.split == "val"]
    rest = [
        clip
        for clip in clips
        if clip.motion == "other" and clip.subject in JUDGED_OTHER
    ]
    alike = [c for c in clips if c.split == "train" and c.motion != "other"]
    rows = compare(models, body, walks, training=alike)
    return rows + [
        row for row in compare(models, body, rest) if row["class"] == "other"
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, default=Path("motion-training/default.npz"))
    parser.add_argument("--epochs", type=int)
    parser.add_argument("--future", type=int, choices=(0, 1), default=1)
    parser.add_argument("--validate-every", type=int)
    parser.add_argument("--start", type=Path)
    parser.add_argument("--also", nargs="+", choices=HELD_OUT, default=())
    parser.add_argument("--everybody", action="store_true")
    parser.add_argument("--table", nargs="*", metavar="NAME=FILE")
    options = parser.parse_args()
    body = load_body_model()
    if options.table is not None:
        named = dict(text.split("=", 1) for text in options.table)
        models = {name: load_motion_model(file) for name, file in named.items()}
        models = {"default": load_motion_model(), **models}
        print(write_table(judged(models, body, read(options.data, set(), False))))
        return
    if (options.also or options.everybody) and options.start is None:
        parser.error("--also and --everybody need --start")
    held_out = set() if options.everybody else set(HELD_OUT) - set(options.also)
    known = read(options.data, held_out, False)
    left = read(options.data, held_out, True)
    validation = [clip for clip in left if clip.split == "val"]
    given = {"epochs": options.epochs, "validate_every": options.validate_every}
    given = {name: value for name, value in given.items() if value is not None}
    settings = MotionTraining(future=options.future, **given)
    start, factor = None, 1.0
    if options.start is not None:
        settings = MotionTraining(**FURTHER | given)
        before = load_motion_model(options.start)
        # Sizes are learnt anew, so that they start as they were learnt.
        factor = json.loads(before.about).get("covariance_factor", 1.0)
        start = widened(before, 1 / factor).network
    # A checkpoint does not say what a further training started from.
    checkpoint = options.out.with_suffix(".ckpt.npz") if start is None else None
    model, history = train(
        known,
        body,
        settings,
        validation=validation,
        checkpoint=checkpoint,
        report=report,
        network=start,
    )
    about = ABOUT | {
        "settings": dataclasses.asdict(settings),
        "held_out_subjects": sorted(held_out),
        "covariance_factor": factor,
    }
    if not validation:
        model = widened(model, factor)
    about |= json.loads(model.about)
    model = dataclasses.replace(model, about=json.dumps(about))
    save_motion_model(options.out, model)
    draw_history(history, options.out.with_suffix(".png"))
    if checkpoint is not None:
        checkpoint.unlink()


if __name__ == "__main__":
    main()
