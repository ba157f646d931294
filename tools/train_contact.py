"""Trains contact networks, and makes the table about them.

    python tools/train_contact.py DATA --out FILE [--also SUBJECT... | --everybody]
    python tools/train_contact.py DATA --table [FILE...]

DATA is the folder with the CMU archives. Subjects of `HELD_OUT` are left out of
training, unless `--also` names them, as a fold does, or `--everybody` has all of them.
Training takes three minutes of processor time. (The network that ships was trained
before there was `cmu_more.npz`, without `SHIPPED_WITHOUT` alone; why it stays is in
`benchmarks/contact.md`.) With `--table` nothing is trained: the network that ships and
those of the files are judged on people of `HELD_OUT` of whom none of them learnt, by
kind of motion and error of joint angles. Counts of
precision, recall and slip are over all frames; `wrong` is the mean over sequences of
the share of points on which network and label differ, and `change` its difference from
that of the first network, sequence by sequence, with its standard error.
"""

import argparse
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from make_posture_prior import DROPPED, FILES, HELD_OUT

from bodyslam_jax.body import BodyModel, load_body_model
from bodyslam_jax.config import ContactTraining
from bodyslam_jax.motion import (
    Clip,
    ContactModel,
    judge_contact,
    load_contact_model,
    read_motion,
    save_contact_model,
    train_contact,
)

ABOUT = {
    "data": "CMU Graphics Lab motion capture, mocap.cs.cmu.edu (NSF EIA-0196217)",
    "licence": "Apache-2.0; CMU lets its data be used for research and commerce",
}
DRIFTS = (0.0, 5.0, 9.0)
"""Standard deviations of the slow errors of joint angles, degrees."""
SHIPPED_WITHOUT = ("02", "08", "14", "55")
"""Subjects of whom the network that ships has not learnt; its file does not say so."""
SHOWN = ("share", "precision", "recall", "slip")


def read(folder: Path, subjects: set[str], within: bool) -> list[Clip]:
    """Clips of who is (not) in `subjects`."""
    files = [folder / f"cmu_{name}.npz" for name in FILES]
    clips = [clip for file in files for clip in read_motion(file)]
    return [c for c in clips if (c.subject in subjects) == within and usable(c)]


def usable(clip: Clip) -> bool:
    return clip.name not in DROPPED


def unknown_to(model: ContactModel) -> set[str]:
    """The subjects of whom a network has not learnt."""
    about = json.loads(model.about)
    return set(about.get("held_out_subjects", SHIPPED_WITHOUT))


def wrong(found: dict[str, float]) -> float:
    """Share of points on which network and label differ, %."""
    hits = found["recall"] * found["share"]
    stands = hits / found["precision"] if found["precision"] > 0 else 0.0
    return 100 * (found["share"] + stands - 2 * hits)


def table(
    models: dict[str, ContactModel], body: BodyModel, clips: Sequence[Clip]
) -> str:
    """Markdown: a row for each kind of motion, error of joint angles, and network."""
    lines = [["motion", "drift", "network", *SHOWN, "wrong, %", "change"]]
    lines.append(["---"] * len(lines[0]))
    for kind in ("walk", "run", "other"):
        chosen = [c for c in clips if c.motion == kind and c.phase == 0]
        if not chosen:
            continue
        for drift in DRIFTS:
            first: np.ndarray | None = None
            for name, model in models.items():
                found = judge_contact(model, body, chosen, drift)
                each = [wrong(judge_contact(model, body, [c], drift)) for c in chosen]
                each = np.array(each)
                first = each if first is None else first
                away = each - first
                error = away.std() / np.sqrt(max(len(away) - 1, 1))
                lines.append(
                    [f"{kind} ({len(chosen)})", f"{drift:.0f}", name]
                    + [f"{found[key]:.2f}" for key in SHOWN]
                    + [f"{each.mean():.1f}", f"{away.mean():+.1f} ± {error:.1f}"]
                )
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
    parser.add_argument("--also", nargs="+", choices=HELD_OUT, default=())
    parser.add_argument("--everybody", action="store_true")
    parser.add_argument("--table", nargs="*", type=Path)
    options = parser.parse_args()
    body = load_body_model()
    if options.table is not None:
        models = {file.stem: load_contact_model(file) for file in options.table}
        models = {"ships": load_contact_model(), **models}
        unknown = set.intersection(*map(unknown_to, models.values()))
        clips = read(options.data, unknown, True)
        print(table(models, body, clips))
        return
    held_out = set() if options.everybody else set(HELD_OUT) - set(options.also)
    settings = ContactTraining(updates=options.updates)
    model = train_contact(read(options.data, held_out, False), body, settings, report)
    about = ABOUT | {
        "settings": dataclasses.asdict(settings),
        "held_out_subjects": sorted(held_out),
    }
    save_contact_model(options.out, dataclasses.replace(model, about=json.dumps(about)))


if __name__ == "__main__":
    main()
