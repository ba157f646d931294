"""Represents experiments as plans: rows that are computed one by one and cached, and a
report.

`Journal` caches finished rows on disk, so that an interrupted experiment is resumed.
"""

import dataclasses
import functools
import json
import logging
import math
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from bodyslam_jax import body as body_
from bodyslam_jax import motion
from bodyslam_jax.config import Config, Experiment, Simulation
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.experiments.scenario import simulations
from bodyslam_jax.io import atomic, files
from bodyslam_jax.pipeline.case import Case, simulate_case
from bodyslam_jax.pipeline.stage_cache import fingerprint
from bodyslam_jax.simulation import LENGTH, motion_file

FRONT_END_S_PER_FRAME, SOLVE_S_PER_FRAME, COMPILATION_S = 0.15, 0.08, 25.0
"""Processor time on a 2.5 GHz core: of the stages before the joint estimate, of a solve
of all variables, and of compiling a problem of new shapes."""
log = logging.getLogger(__name__)
Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class Job:
    """A row: its inputs, its cost, and the function that computes it."""

    label: str
    key: tuple[Any, ...]
    seconds: float
    """Estimated processor time, s."""
    compute: Callable[[], Row]


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
) -> list[Job]:
    """Returns one row per sequence; `effort` is the number of solves and of compiled
    problems."""
    case = cases(config, stages)

    def job(settings: Simulation) -> Job:
        name = named(settings)
        run = lambda: {"sequence": name, **compute(case(settings))}
        return Job(name, (settings, config), cost(settings, *effort), run)

    return [job(s) for s in simulations(experiment, sequences, families)]


class Journal:
    """Cache of rows: a folder with one JSON file per row, named by a fingerprint of its
    inputs."""

    def __init__(self, folder: Path):
        self.folder = folder
        self.computed = 0
        """Number of rows that were not on disk."""

    def path(self, name: str, label: str, *key: Any) -> Path:
        """Returns the file of the row with this label and key."""
        words = re.sub(r"[^A-Za-z0-9.]+", "_", label).strip("_")
        return self.folder / f"{name}-{words}-{fingerprint(name, label, *key)}.json"

    def kept(self, name: str, label: str, key: Sequence[Any]) -> Row | None:
        """Returns the row of this `key` if it is on disk, else `None`."""
        path = self.path(name, label, *key)
        if not path.exists():
            return None
        try:
            found = files.read_json(path, "a row of an experiment")
        except InputError:
            return None
        return found if isinstance(found, dict) else None

    def row(
        self,
        name: str,
        label: str,
        key: Sequence[Any],
        compute: Callable[[], Row],
    ) -> Row:
        """Returns the row of this `key`, from disk if present; `label` is used in the
        log."""
        found = self.kept(name, label, key)
        if found is not None:
            log.info("%s %s: taken from an earlier run", name, label)
            return found
        path = self.path(name, label, *key)
        if path.exists():
            log.warning("%s: not a row as expected; computed again", path)
        start = time.perf_counter()
        row = _plain(compute())
        self.computed += 1
        log.info("%s %s: %.0f s", name, label, time.perf_counter() - start)
        self.folder.mkdir(parents=True, exist_ok=True)
        atomic.write_text(path, json.dumps(row, indent=1))
        return row


def _plain(value: Any) -> Any:
    """Converts arrays to lists and numbers that are not finite to null, as standard
    JSON requires."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
