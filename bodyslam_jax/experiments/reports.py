"""Writes reports of the experiments on scale, landmarks, motion and ablation.

Inputs are finished rows; each report is written as Markdown, CSV and PNG.

`about` describes the data behind a table: noise level, and settings that differ from
the defaults.
"""

import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bodyslam_jax import body as body_
from bodyslam_jax import motion
from bodyslam_jax.config import Config, Experiment
from bodyslam_jax.experiments import figures, paper
from bodyslam_jax.experiments.tables import (
    MM,
    Column,
    Row,
    intro,
    to_csv,
    write_tables,
    write_text,
)
from bodyslam_jax.pipeline.stage_cache import body_model_file


def write_scale(out: Path, rows: list[Row], *, about: str) -> list[Path]:
    """Writes the report on scale recovery.

    A table has the deviation of the estimated scale for each perturbation of the
    cameras' scale; a figure shows convergence.
    """
    flat = []
    for row in rows:
        for i, p in enumerate(row["perturbation"]):
            flat.append(
                {
                    "sequence": row["sequence"],
                    "perturbation": p,
                    "scale": row["scale"][i],
                    "deviation": row["deviation"][i],
                    "h_before": row["h_ate"][i][0],
                    "h_after": row["h_ate"][i][-1],
                    "paper": paper.SCALE[p][0] if p in paper.SCALE else None,
                    "paper_deviation": paper.SCALE[p][1] if p in paper.SCALE else None,
                }
            )
    columns = [
        Column("sequence", "sequence"),
        Column("perturbation 1/s'", "perturbation", average=False),
        Column("estimated s", "scale", digits=4, average=False),
        Column("deviation, %", "deviation", 100.0, 2),
        Column("H-ATE before, mm", "h_before", MM),
        Column("H-ATE after, mm", "h_after", MM),
        Column("the paper's s, its own data", "paper", digits=3, average=False),
        Column("the paper's deviation, %", "paper_deviation"),
    ]
    spread = [
        Column("sequence", "sequence"),
        Column("largest difference between answers, %", "spread", 100.0, 4),
    ]
    head = intro(
        "Scale recovery from perturbed cameras",
        about,
        "Cameras of bundle adjustment at their true size, made 1/p as large and held; "
        "no landmarks; s starts at 1; s and people are free. The answer should not "
        "depend on the start. Deviation is signed: the motion model's bias on the "
        "sequence.",
    )
    parts = [("By perturbation", columns, flat), ("Spread", spread, rows)]
    written = write_tables(out, "scale", head, parts, about)
    figures.draw_scale(out / "scale.png", rows, about)
    return [*written, out / "scale.png"]


def write_structure(out: Path, rows: list[Row], *, about: str) -> list[Path]:
    """Writes the C-ATE of perturbed cameras, optimised with and without landmarks,
    beside the paper's values."""
    names = ("original", "perturbed", "no_landmarks", "landmarks")
    theirs: list[Row | None] = []
    beside = []
    for row in rows:
        published = paper.STRUCTURE.get(row["sequence"].split("-")[0])
        found: Row = {}
        if published is not None:
            found = {k: 1e-3 * v for k, v in zip(names, published, strict=True)}
        theirs.append(found or None)
        beside.append({**row, **{f"paper:{name}": v for name, v in found.items()}})
    ours_and_theirs = lambda title, name: (
        Column(f"{title}, mm", name, MM),
        Column(f"the paper's {title}, mm", f"paper:{name}", MM),
    )
    columns = [
        Column("sequence", "sequence"),
        *ours_and_theirs("original (map's unit)", "original"),
        Column("scale in closed form, mm", "start", MM),
        *ours_and_theirs("perturbed", "perturbed"),
        *ours_and_theirs("optimised, no landmarks", "no_landmarks"),
        *ours_and_theirs("optimised, landmarks", "landmarks"),
        Column("scale, no landmarks", "no_landmarks/scale", digits=3),
        Column("scale, landmarks", "landmarks/scale", digits=3),
        Column("status, no landmarks", "status_no_landmarks"),
        Column("status, landmarks", "status"),
    ]
    head = intro(
        "Structural landmarks",
        about,
        "C-ATE, SE(3), mean over frames. Every camera is moved by up to 100 mm and "
        "0.01 rad in each coordinate, then everything is optimised.",
    )
    parts = [("By sequence", columns, beside)]
    written = write_tables(out, "landmarks", head, parts, about)
    figures.draw_structure(out / "landmarks.png", rows, theirs, about)
    return [*written, out / "landmarks.png"]


def write_motion(out: Path, rows: list[Row], source: str, config: Config) -> list[Path]:
    """Writes the motion model's errors in the paper's form, and their histograms."""
    found = rows[0]
    error, step = paper.MOTION
    nan = float("nan")
    table = [{k: nan if v is None else v for k, v in r.items()} for r in found["rows"]]
    ours = next(r for r in table if r["class"] == "all" and r["drift"] == 0)
    which = "held out of training" if found["held_out"] else "of one person"
    head = (
        "# Prediction of motion\n\n"
        f"{found['clips']} clips of `{Path(source).name}`, {which}. "
        f"Mean error {ours['error_mm']:.1f} mm at a mean step of {ours['step_mm']:.1f} "
        f"mm a frame (ratio {ours['ratio']:.3f}). The paper's, on AMASS, other data: "
        f"{error} mm at {step} mm (ratio {error / step:.3f}). "
        + deviations(Experiment(), config)
    )
    write_text(out / "motion.md", f"{head.rstrip()}\n\n{motion.write_table(table)}")
    names = list(found["rows"][0])
    columns = [Column(name, name) for name in names]
    write_text(out / "motion.csv", to_csv(columns, found["rows"]))
    model = motion.load_motion_model(config.motion_model)
    training, held = motion.split(motion.read_motion(source))
    picture = out / "motion.png"
    body = body_.load_body_model(config.body_model)
    motion.draw_errors(model, body, held or training, picture)
    return [out / "motion.md", out / "motion.csv", picture]


def write_ablation(out: Path, rows: list[Row], *, about: str) -> list[Path]:
    """Writes the errors of each variant, with one table and one figure per sequence."""
    number = functools.partial(
        Column, average=False
    )  # a mean over variants is meaningless
    columns = [
        Column("variant", "label"),
        number("C-ATE SE(3), mm", "c_ate_se3", MM),
        number("H-ATE SE(3), mm", "h_ate_se3", MM),
        number("J-ATE SE(3), mm", "j_ate_se3", MM),
        number("J-ATE Sim(3), mm", "j_ate_sim3", MM),
        number("estimated / true scale", "scale_ratio", digits=3),
        number("leg / true leg", "leg_ratio", digits=3),
        number("past frames", "past", digits=0),
        number("steps", "steps", digits=0),
        number("seconds", "seconds"),
        number("cost", "cost", digits=0),
        Column("status", "status"),
    ]
    parts, written = [], []
    for sequence in dict.fromkeys(row["sequence"] for row in rows):
        own = [row for row in rows if row["sequence"] == sequence]
        parts.append((sequence, columns, own))
        picture = out / f"ablation_{sequence}.png"
        figures.draw_variants(picture, own, about)
        written.append(picture)
    head = intro(
        "Ablations",
        about,
        "`seconds` are wall time with compilation. `past frames` are those that the "
        "motion model sees.",
    )
    files = write_tables(out, "ablation", head, parts, about)
    everything = to_csv([Column("sequence", "sequence"), *columns], rows, about)
    write_text(out / "ablation.csv", everything)
    return [*files, *written]


def about(experiment: Experiment, config: Config) -> str:
    """Returns a sentence or two on simulation and settings of the rows of an
    experiment."""
    first = (
        f"Simulated sequences, noise level `{experiment.noise}`, lifting network "
        f"`{config.people_fit.lifter}`."
    )
    return f"{first} {deviations(experiment, config)}".rstrip()


def deviations(experiment: Experiment, config: Config) -> str:
    """Returns text on seed, length, motion, models and settings that differ from the
    defaults, but for the lifting network, which experiments choose.

    Settings are compared with the nearest preset. A body model that is installed on
    this machine counts as named by the user. The text is empty if nothing differs.
    """
    parts = []
    if experiment.seed is not None:
        parts.append(f"seed {experiment.seed}")
    if experiment.frames is not None:
        parts.append(f"{experiment.frames} frames each")
    if experiment.motion is not None:
        parts.append(f"motion of `{experiment.motion}`")
    body = body_model_file(config.body_model)
    config = dataclasses.replace(config, body_model=None if body is None else str(body))
    mine = dict(_flat(config))
    same = lambda preset: dataclasses.replace(
        preset,
        people_fit=dataclasses.replace(
            preset.people_fit, lifter=config.people_fit.lifter
        ),
    )
    against = {"default": same(Config()), "paper": same(Config.paper())}
    differing = {
        preset: [f"`{k}` {mine[k]}" for k, v in _flat(theirs) if mine[k] != v]
        for preset, theirs in against.items()
    }
    preset = min(differing, key=lambda name: len(differing[name]))
    parts += [f"preset `{preset}`"] if preset != "default" else []
    parts += differing[preset]
    return f"Not as by default: {'; '.join(parts)}." if parts else ""


def _flat(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yields every setting with its name on the command line, such as
    `weights.pixel_sigma`."""
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            yield from _flat(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, value
