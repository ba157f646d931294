"""Represents experiments as plans: rows that are computed one by one and cached, and a
report."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bodyslam_jax import body as body_
from bodyslam_jax import motion
from bodyslam_jax.config import Config, Experiment, Simulation
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.experiments.row_cache import Row
from bodyslam_jax.experiments.scenario import simulations
from bodyslam_jax.pipeline.case import Case, simulate_case
from bodyslam_jax.simulation import LENGTH, motion_file

FRONT_END_S_PER_FRAME, SOLVE_S_PER_FRAME, COMPILATION_S = 0.15, 0.08, 25.0
"""Processor time on a 2.5 GHz core: of the stages before the joint estimate, of a solve
of all variables, and of compiling a problem of new shapes."""


@dataclasses.dataclass(frozen=True)
class Job:
    """A row: its inputs, its cost, and the function that computes it."""

    label: str
    key: tuple[Any, ...]
    seconds: float
    """Estimated processor time, s."""
    compute: Callable[[], Row]
    form: Any
    """Form that a cached row must have for the report (`row_cache.fits`)."""


@dataclasses.dataclass(frozen=True)
class Plan:
    """An experiment: its rows in order, and the function that reports on the finished
    ones."""

    jobs: list[Job]
    write: Callable[[Path, list[Row]], list[Path]]


def check_files(experiment: Experiment, config: Config) -> None:
    """Reads the files that rows will need, before any row is computed.

    **Raises:** `InputError`, naming the file or the option.
    """
    if experiment.frames is not None and experiment.frames < 2:
        raise InputError(
            f"--frames {experiment.frames}: a sequence needs 2 frames or more."
        )
    if experiment.motion is not None:
        source = motion_file(experiment.motion)
        if not source.is_dir():  # a folder may be large, and is read when it is needed
            motion.read_motion(source)
    body = body_.load_body_model(config.body_model)
    for file in (config.motion_model, *experiment.motion_models):
        model = motion.load_motion_model(file)
        try:
            motion.check_compatible(model, body, model.fps)
        except ValueError as error:
            raise InputError(f"{file or 'the default'}: {error}") from None


def named(settings: Simulation) -> str:
    """Returns the name of a sequence and its family, such as `M2-room`."""
    return f"{settings.sequence}-{settings.family}"


def cost(settings: Simulation, solves: float, shapes: float) -> float:
    """Returns the processor time, s, of `solves` solves on one sequence, with problems
    of `shapes` different shapes."""
    own = LENGTH[settings.sequence]
    frames = own if settings.length is None else settings.length
    return (
        frames * (FRONT_END_S_PER_FRAME + SOLVE_S_PER_FRAME * solves)
        + COMPILATION_S * shapes
    )


def cases(config: Config, stages: Path) -> Callable[[Simulation], Case]:
    """Returns a function that makes cases and caches the last one, because the rows of
    one sequence follow one another."""

    @functools.lru_cache(maxsize=1)
    def case(settings: Simulation) -> Case:
        return simulate_case(settings, config=config, cache=stages)

    return case


def by_sequence(
    experiment: Experiment,
    config: Config,
    stages: Path,
    sequences: Sequence[str],
    families: Sequence[str],
    compute: Callable[[Case], Row],
    effort: tuple[float, float],
    form: dict[str, Any],
) -> list[Job]:
    """Returns one row per sequence; `effort` is the number of solves and of compiled
    problems.

    `form` lists the fields of a row beside its sequence.
    """
    case = cases(config, stages)

    def job(settings: Simulation) -> Job:
        name = named(settings)
        run = lambda: {"sequence": name, **compute(case(settings))}
        seconds = cost(settings, *effort)
        full = {"sequence": name, **form}
        return Job(name, (settings, config), seconds, run, full)

    return [job(s) for s in simulations(experiment, sequences, families)]
