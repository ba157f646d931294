"""Makes the contact network that comes with the package, and the table about it.

    python tools/train_contact.py DATA [--out FILE] [--updates N]
    python tools/train_contact.py DATA --table

DATA is the folder with the CMU archives. Subjects 02, 08, 14 and 55 are left out of
training, and are those on which precision and recall are measured. Training takes some
minutes of processor time. With `--table` nothing is trained: the weights that ship are
judged.
"""

import argparse
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

from bodyslam_jax.body import BodyModel, load_body_model
from bodyslam_jax.config import ContactTraining
from bodyslam_jax.motion import (
    Clip,
    ContactModel,
    judge_contact,
    load_contact_model,
    read_motion,
    save_contact_model,
    split,
    train_contact,
)

ABOUT = {
    "data": "CMU Graphics Lab motion capture, mocap.cs.cmu.edu (NSF EIA-0196217)",
    "licence": "Apache-2.0; CMU lets its data be used for research and commerce",
}
UNTRAINED = "14"
DRIFTS = (0.0, 5.0, 9.0)
"""Standard deviations of the slow errors of joint angles, degrees."""


def judged(
    model: ContactModel, body: BodyModel, clips: Sequence[Clip]
) -> list[dict[str, str | float]]:
    """Scores on subjects that were not trained on, by kind of motion and noise."""
    walks = [clip for clip in clips if clip.split == "val"]
    groups = {
        "walk": [clip for clip in walks if clip.motion == "walk"],
        "run": [clip for clip in walks if clip.motion == "run"],
        "other": [
            clip
            for clip in clips
            if clip.split == "other" and clip.subject in ("02", UNTRAINED)
        ],
    }
    rows: list[dict[str, str | float]] = []
    for name, some in groups.items():
        for drift in DRIFTS:
            found = judge_contact(model, body, some, drift)
            found = {key: round(value, 3) for key, value in found.items()}
            rows.append({"motion": name, "drift": drift, **found})
    return rows


def table(rows: list[dict[str, str | float]]) -> str:
    """Markdown."""
    names = list(rows[0])
    lines = [names, ["---"] * len(names)]
    lines += [[str(row[name]) for name in names] for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def report(update: int, loss: float) -> None:
    """A line every 500 updates."""
    if update % 500 == 0:
        print(f"{update}: cross entropy {loss:.3f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, default=Path("contact.npz"))
    parser.add_argument("--updates", type=int, default=ContactTraining().updates)
    parser.add_argument("--table", action="store_true")
    options = parser.parse_args()
    body = load_body_model()
    clips = read_motion(options.data)
    if options.table:
        print(table(judged(load_contact_model(), body, clips)))
        return
    known, _ = split([clip for clip in clips if clip.subject != UNTRAINED])
    settings = ContactTraining(updates=options.updates)
    model = train_contact(known, body, settings, report)
    rows = judged(model, body, clips)
    about = ABOUT | {"settings": dataclasses.asdict(settings), "metrics": rows}
    save_contact_model(options.out, dataclasses.replace(model, about=json.dumps(about)))
    print(table(rows))


if __name__ == "__main__":
    main()
