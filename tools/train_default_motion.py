"""Makes the motion model that comes with the package, and the table about it.

    python tools/train_default_motion.py DATA [--out DIR] [--epochs N]
    python tools/train_default_motion.py DATA --table [NAME=FILE ...]

DATA is the folder with the CMU archives. Subject 14 is left out of training
altogether, so that motion which is neither walk nor run can be judged too. Training
takes half an hour on two quiet cores, and goes on where it stopped; it writes weights,
curve and table to DIR. With `--table` nothing is trained: the weights that ship are
judged, and beside them those in the named files.
"""

import argparse
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

from bodyslam_jax.body import BodyModel, load_body_model
from bodyslam_jax.config import MotionTraining
from bodyslam_jax.motion import (
    Clip,
    MotionModel,
    compare,
    draw_history,
    load_motion_model,
    read_motion,
    save_motion_model,
    split,
    train,
    write_table,
)

ABOUT = {
    "data": "CMU Graphics Lab motion capture, mocap.cs.cmu.edu (NSF EIA-0196217); "
    "walks and runs of 12 subjects, and other motion of subjects "
    "03 05 06 09 10 11 13 49",
    "licence": "Apache-2.0; CMU lets its data be used for research and commerce",
}
UNTRAINED = "14"


def report(epoch: int, epochs: int, measures: dict[str, float]) -> None:
    """One line an epoch."""
    told = ", ".join(f"{name} {value:.3f}" for name, value in measures.items())
    print(f"{epoch}/{epochs}: {told}", flush=True)


def judged(
    models: dict[str, MotionModel], body: BodyModel, clips: Sequence[Clip]
) -> list[dict[str, str | float]]:
    """Rows of the table: walks and runs of validation subjects, then other motion."""
    known, _ = split([clip for clip in clips if clip.subject != UNTRAINED])
    walks = [clip for clip in clips if clip.split == "val"]
    rest = [
        clip
        for clip in clips
        if clip.split == "other" and clip.subject in ("02", UNTRAINED)
    ]
    alike = [clip for clip in known if clip.motion != "other"]
    rows = compare(models, body, walks, training=alike)
    return rows + [
        row for row in compare(models, body, rest) if row["class"] == "other"
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, default=Path("motion-training"))
    parser.add_argument("--epochs", type=int, default=MotionTraining().epochs)
    parser.add_argument("--future", type=int, choices=(0, 1), default=1)
    parser.add_argument("--validate-every", type=int, default=1)
    parser.add_argument("--table", nargs="*", metavar="NAME=FILE")
    options = parser.parse_args()
    body = load_body_model()
    clips = read_motion(options.data)
    if options.table is not None:
        named = dict(text.split("=", 1) for text in options.table)
        models = {name: load_motion_model(file) for name, file in named.items()}
        models = {"default": load_motion_model(), **models}
        print(write_table(judged(models, body, clips)))
        return
    known, validation = split([clip for clip in clips if clip.subject != UNTRAINED])
    settings = dataclasses.replace(
        MotionTraining(),
        epochs=options.epochs,
        future=options.future,
        validate_every=options.validate_every,
    )
    checkpoint = options.out / "default.ckpt.npz"
    model, history = train(
        known,
        body,
        settings,
        validation=validation,
        checkpoint=checkpoint,
        report=report,
    )
    rows = judged({"default": model}, body, clips)
    metrics = [
        {name: value for name, value in row.items() if name != "model"}
        for row in rows
        if row["model"] == "default"
    ]
    about = ABOUT | {"settings": dataclasses.asdict(settings), "metrics": metrics}
    model = dataclasses.replace(model, about=json.dumps(about))
    save_motion_model(options.out / "default.npz", model)
    draw_history(history, options.out / "default.png")
    (options.out / "table.md").write_text(write_table(rows))
    checkpoint.unlink()
    print(write_table(rows))


if __name__ == "__main__":
    main()
