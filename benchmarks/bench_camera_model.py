"""How often a camera that is not ordinary is used rightly, wrongly, or missed.

    python benchmarks/bench_camera_model.py FOLDER [--videos VIDEOS]

Clips: forty rendered ones (`camera_model_clips.FILMS`); of the sequence folders in
VIDEOS each whole, in halves and in thirds; and their tracks as a stretched, distorted
or zooming camera would have them (where the camera stands only as a zooming one).
FOLDER keeps the tracks of clips and the decisions, so that an interrupted run goes on
(without `FOLDER/decisions` it decides anew and tracks nothing). Prints Markdown tables:
counts, then every clip.
"""

import argparse
import dataclasses
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import camera_model_clips as clips
import cv2
import numpy as np

from bodyslam_jax import sfm
from bodyslam_jax.config import Structure
from bodyslam_jax.sfm.camera_model import DECISIVE_LOG_ODDS
from bodyslam_jax.types import Sequence

CLEAR = {"aspect": np.log(1.3), "radial": 0.15, "zoom": np.log(1.3)}
"""Deviations from which a case is clear."""
ORDINARY = {"aspect": 0.03, "radial": 0.05, "zoom": 0.04}
"""Deviations up to which a camera is ordinary."""
ODDS = {"aspect": 1e-3, "radial": 1 / 20, "zoom": 1 / 50}
WARPS = ({"aspect": 4 / 3}, {"k1": -0.25}, {"zoom": 1.5})
TRANSLATING = ("davis_hike", "josh_boardwalk", "pexels_walking")
"""Real clips whose camera moves: on the others only a zoom is observable."""
KNOWN_RADIAL = {"josh_boardwalk": -0.12}
"""Of real clips with a lens that is known to be distorted."""


@dataclasses.dataclass(frozen=True)
class Clip:
    name: str
    group: str
    make: Callable[[], Sequence]
    aspect: float = 1.0
    k1: float = 0.0
    zoom: float = 1.0

    @property
    def truth(self) -> dict[str, float]:
        zoom = abs(np.log(self.zoom))
        return {"aspect": float(np.log(self.aspect)), "radial": self.k1, "zoom": zoom}


def rendered(folder: Path) -> Iterator[Clip]:
    for film in clips.FILMS:
        make = lambda film=film: clips.rendered(film, folder)
        lens = (film.aspect, film.k1, film.zoom)
        yield Clip(film.name, "rendered", make, *lens)


def real(folder: Path, videos: Path) -> Iterator[Clip]:
    for source in sorted(p for p in videos.iterdir() if (p / "video.mp4").exists()):
        k1 = KNOWN_RADIAL.get(source.name, 0.0)
        for count in (1, 2, 3):
            for i in range(count):

                def make(source=source, count=count, i=i):
                    whole = clips.real(source, folder)
                    num = whole.num_frames
                    return clips.piece(whole, num * i // count, num * (i + 1) // count)

                yield Clip(f"{source.name} {i + 1} of {count}", "real", make, k1=k1)
        for warp in WARPS if source.name in TRANSLATING else WARPS[2:]:

            def bent(source=source, warp=warp):
                return clips.warped(clips.real(source, folder), **warp)

            (what, value), *_ = warp.items()
            if k1 and what != "k1":
                continue
            name = f"{source.name} {what} {value:.2f}"
            yield Clip(name, "warped", bent, **{"k1": k1, **warp})


def decide(clip: Clip) -> dict:
    """What the front end concludes of a clip."""
    sequence = clip.make()
    tracks, num = sequence.tracks, sequence.num_frames
    assert tracks is not None
    tracks, _ = sfm.without_burnt_in(tracks, sequence.intrinsics, num)
    start, config = time.perf_counter(), Structure()
    model = sfm.find_camera_model(
        tracks, sequence.intrinsics, num, config, sequence.keypoints
    )
    seconds = time.perf_counter() - start
    params = np.asarray(model.intrinsics.params)
    used = {
        "aspect": float(np.log(params[0] / params[1])),
        "radial": float(params[4]) if len(params) > 4 else 0.0,
        "zoom": 0.0 if model.zoom is None else float(np.ptp(model.zoom)),
    }
    seen = [
        {
            "model": lens.model,
            "evidence": lens.evidence,
            "log_odds": lens.log_odds,
            "focal": [lens.focal, lens.focal_sigma],
            "aspect": [lens.aspect, lens.aspect_sigma],
            "radial": [lens.radial, lens.radial_sigma],
            "zoom": [lens.zoom_range, lens.zoom_sigma],
        }
        for lens in model.alternatives
    ]
    return {
        "name": clip.name,
        "group": clip.group,
        "truth": clip.truth,
        "motion": model.found.kind,
        "used": used,
        "focal": float(np.sqrt(params[0] * params[1])),
        "lenses": seen,
        "seconds": seconds,
        "warnings": model.warnings,
    }


def models_at(row: dict, factor: float) -> tuple[str, ...]:
    """The model that the odds decide for, with prior odds `factor` times as high."""
    odds = {}
    for lens in row["lenses"]:
        prior = sum(np.log(ODDS[name] * factor) for name in lens["model"])
        odds[tuple(lens["model"])] = lens["evidence"] + prior

    def is_decisive(model: tuple[str, ...]) -> bool:
        simpler = [odds[other] for other in odds if set(other) < set(model)]
        return all(odds[model] - value > DECISIVE_LOG_ODDS for value in simpler)

    decisive = [model for model in odds if model and is_decisive(model)]
    return max(decisive, key=lambda model: odds[model], default=())


def verdict(row: dict) -> str:
    """`right`, `wrong` or `missed`; `ordinary` where nothing is to be found."""
    deviates, clear, wrong = False, False, False
    used = row["used"]
    for name, true in row["truth"].items():
        error = abs(used[name] - true)
        wrong |= used[name] != 0 and error > max(0.5 * abs(true), ORDINARY[name])
        deviates |= used[name] != 0
        clear |= abs(true) >= CLEAR[name]
    if wrong:
        return "wrong"
    if deviates:
        return "right"
    if clear:
        return "missed"
    if any(abs(row["truth"][name]) > ORDINARY[name] for name in ORDINARY):
        return "missed, small"
    return "ordinary"


def table(rows: list[dict]) -> str:
    order = ("right", "ordinary", "wrong", "missed", "missed, small")
    lines = ["| clips | number | " + " | ".join(order) + " | other at 10 x odds |"]
    lines.append("|---" * (len(order) + 3) + "|")
    for group in ("rendered", "real", "warped"):
        own = [row for row in rows if row["group"] == group]
        found = [verdict(row) for row in own]
        changed = sum(
            models_at(row, factor) != models_at(row, 1.0)
            for row in own
            for factor in (0.1, 10.0)
        )
        counts = " | ".join(str(found.count(what)) for what in order)
        lines.append(f"| {group} | {len(own)} | {counts} | {changed} |")
    lines += ["", "| clip | camera | true log fx/fy, k1, log zoom | used | estimated |"]
    lines[-1] += " log odds | conclusion |"
    lines.append("|---" * 7 + "|")
    shown = lambda x: " ".join(f"{x[name]:+.2f}" for name in ORDINARY)
    for row in rows:
        best = max(row["lenses"][1:], key=lambda lens: lens["log_odds"], default=None)
        estimated = odds = ""
        if best is not None:
            values = (f"{best[n][0]:+.3f} ± {best[n][1]:.3f}" for n in best["model"])
            estimated = " ".join([" ".join(best["model"]), *values])
            odds = f"{best['log_odds']:.1f}"
        lines.append(
            f"| {row['name']} | {row['motion']} | {shown(row['truth'])} | "
            f"{shown(row['used'])} | {estimated} | {odds} | {verdict(row)} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--videos", type=Path)
    parser.add_argument("--reverse", action="store_true", help="begin at the end")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    decisions = args.folder / "decisions"
    decisions.mkdir(parents=True, exist_ok=True)
    wanted = list(rendered(args.folder))
    if args.videos:
        wanted += real(args.folder, args.videos)
    rows = []
    for clip in wanted[::-1] if args.reverse else wanted:
        file = decisions / f"{clip.name}.json"
        if not file.exists():
            file.write_text(json.dumps(decide(clip)))
            print(clip.name, verdict(json.loads(file.read_text())), flush=True)
        rows.append(json.loads(file.read_text()))
    print(table(rows))


if __name__ == "__main__":
    main()
