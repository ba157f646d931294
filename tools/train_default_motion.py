"""Makes the motion model that comes with the package, and the table about it.

    python tools/train_default_motion.py DATA [--paper]

DATA is the folder with the CMU archives. Subject 14 is left out altogether, so that
motion which is neither walk nor run can be judged too. With `--paper` the paper's
network is trained as well, on exact and on noisy postures, for comparison. Takes half
an hour on two quiet cores; goes on where it stopped.
"""

import argparse
import dataclasses
from pathlib import Path

from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import MotionTraining
from bodyslam_jax.motion import (
    compare,
    draw_history,
    read_motion,
    save_motion_model,
    split,
    train,
    write_table,
)

ROOT = Path(__file__).parents[1]
ASSETS = ROOT / "bodyslam_jax" / "motion" / "assets"
ABOUT = {
    "data": "CMU Graphics Lab motion capture, mocap.cs.cmu.edu (NSF EIA-0196217)",
    "licence": "Apache-2.0; CMU lets its data be used for research and commerce",
}


def report(epoch: int, epochs: int, measures: dict[str, float]) -> None:
    """One line an epoch."""
    told = ", ".join(f"{name} {value:.3f}" for name, value in measures.items())
    print(f"{epoch}/{epochs}: {told}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--paper", action="store_true")
    parser.add_argument("--scratch", type=Path, default=Path("motion-training"))
    options = parser.parse_args()
    body = load_body_model()
    clips = read_motion(options.data)
    known, validation = split([clip for clip in clips if clip.subject != "14"])
    other = [clip for clip in clips if clip.subject in ("02", "14")]
    noisy = dataclasses.replace(
        MotionTraining.paper(), drift_deg=9.0, white_deg=0.5, clean_share=0.3
    )
    wanted = {"default": MotionTraining()}
    if options.paper:
        wanted |= {"paper, clean": MotionTraining.paper(), "paper, noisy": noisy}
    models = {}
    for name, settings in wanted.items():
        if name == "default":
            training = known
        else:  # the paper's selection: walking and running
            training = [clip for clip in known if clip.motion != "other"]
        stem = name.replace(", ", "-")
        about = ABOUT | {"settings": dataclasses.asdict(settings)}
        models[name], history = train(
            training,
            body,
            settings,
            validation=validation,
            checkpoint=options.scratch / f"{stem}.checkpoint.npz",
            report=report,
            about=about,
        )
        draw_history(history, options.scratch / f"{stem}.png")
        target = ASSETS if name == "default" else options.scratch
        save_motion_model(target / f"{stem}.npz", models[name])
    walks = [clip for clip in clips if clip.split == "val"]
    rest = [clip for clip in other if clip.split == "other"]
    table = write_table(compare(models, body, [*walks, *rest], training=known))
    (options.scratch / "table.md").write_text(table)


if __name__ == "__main__":
    main()
