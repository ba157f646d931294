"""Computes the rows of `bodyslam experiment video`: estimates from rendered video.

Every sequence is rendered with people in clothes; medium ones have furniture that
occludes them, difficult ones also a second person and a rolling shutter. Inputs of the
pipeline are the video and camera.json, and: nothing else (`pixels`); simulated
keypoints (`keypoints`); or these and simulated bodies of a regressor (`bodies`).

With `motion="other"` the first person does something else than walk, in each of the ten
sequences something else; a second person walks.
"""

import dataclasses
import functools
from pathlib import Path
from typing import Any

from bodyslam_jax import body as body_
from bodyslam_jax import evaluation, io, pipeline, simulation
from bodyslam_jax.config import Config, Experiment, Simulation
from bodyslam_jax.experiments.detector import detection_figures
from bodyslam_jax.experiments.jobs import COMPILATION_S, Job, named
from bodyslam_jax.experiments.row_cache import Row
from bodyslam_jax.experiments.scenario import simulations
from bodyslam_jax.experiments.scoring import leg_of
from bodyslam_jax.pipeline.stage_cache import Cache, fingerprint
from bodyslam_jax.simulation import OTHER, RECORDINGS

INPUTS = ("pixels", "keypoints", "bodies")
FRAMES = 300
FIGURES = (
    *("c_ate_se3", "c_ate_sim3", "h_ate_se3", "h_ate_sim3", "j_ate_se3", "j_ate_sim3"),
    *("scale", "pa_mpjpe", "gravity_error", *evaluation.FIGURES),
    *(f"{name}_of_truth" for name in evaluation.FIGURES),
)
FORM: dict[str, Any] = {
    **dict.fromkeys((*FIGURES, "size"), float),
    "status": str,
}
"""Fields of a cached row beside its sequence, and their types (`row_cache.fits`)."""
_SECONDS_PER_FRAME = 0.6
"""Processor time of all stages per frame and input, s."""
_READOUT_S = 0.015


def jobs(
    experiment: Experiment, config: Config, stages: Path, sequences: tuple[str, ...]
) -> list[Job]:
    """Returns one row for each sequence and input."""
    if experiment.frames is None:
        experiment = dataclasses.replace(experiment, frames=FRAMES)
    if experiment.family is None:
        experiment = dataclasses.replace(experiment, family="both")
    out = []
    for plain in simulations(experiment, sequences, ("room", "follow")):
        settings = filmed(plain)
        for which in INPUTS:
            label = f"{named(settings)}-{which}"
            form = {"sequence": named(settings), **FORM, "input": which}
            if settings.motion == OTHER:
                form["motion"] = what_is_done(settings)
            seconds = COMPILATION_S + _SECONDS_PER_FRAME * (settings.length or FRAMES)
            one = functools.partial(video_row, settings, which, config, stages)
            out.append(Job(label, (settings, which, config), seconds, one, form))
    return out


def what_is_done(settings: Simulation) -> str:
    """Returns what the first person does, and the CMU trial of it, where they do not
    walk."""
    trial, what = RECORDINGS[settings.sequence]
    return f"{what} ({trial})"


def filmed(settings: Simulation) -> Simulation:
    """Returns the simulation with occluding furniture and further people, by its
    difficulty."""
    level = settings.sequence[0]
    return dataclasses.replace(
        settings,
        render=True,
        hiding=level in "MD",
        people=2 if level == "D" else 1,
        readout=_READOUT_S if level == "D" else 0.0,
    )


def video_row(
    settings: Simulation, which: str, config: Config = Config(), stages: Path = Path()
) -> Row:
    """Renders a video, runs the pipeline on it, and compares the result with the truth.

    `which` is one of `INPUTS`. The film and finished stages are kept in `stages`.

    **Raises:** as `simulation.simulate` and `pipeline.run`.
    """
    body = body_.load_body_model(config.body_model)
    simulated = simulation.simulate(settings, body)
    folder = stages / f"{simulated.name}-{fingerprint(settings)}"
    film = simulation.film_scene(folder / "film", simulated)
    sequence, measured = io.read_sequence(film), simulation.as_sequence(simulated)
    cache = Cache(folder / which)
    row: Row = {"sequence": simulated.name, "input": which}
    if settings.motion == OTHER:
        row["motion"] = what_is_done(settings)
    if which == "pixels":
        sequence = pipeline.find_people(sequence, config, cache)
        row |= detection_figures(simulated, sequence)
    else:
        sequence = dataclasses.replace(sequence, keypoints=measured.keypoints)
    if which == "bodies":
        sequence = dataclasses.replace(sequence, bodies=measured.bodies)
    result = pipeline.run(sequence, config, cache=cache)
    pair = evaluation.associate(result, simulation.as_truth(simulated), body)
    errors = evaluation.evaluate(*pair)
    row |= {name: float(errors[name]) for name in FIGURES}
    row["size"] = float(leg_of(pair[0]) / leg_of(pair[1]))
    row["status"] = result.summary["status"]
    return row
