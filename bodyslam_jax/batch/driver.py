"""Runs the clips of a batch by an engine, in a folder that the same call continues."""

import contextlib
import dataclasses
import functools
import json
import logging
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from bodyslam_jax.batch import failures, record
from bodyslam_jax.batch.engine import Engine, Failure, Setup, make_engine
from bodyslam_jax.batch.inputs import (
    MARK,
    RUNS,
    Input,
    find_inputs,
    shard,
    wrong_name,
)
from bodyslam_jax.batch.job import (
    Estimate,
    Job,
    Outcome,
    failure,
    finished,
    run_job,
)
from bodyslam_jax.batch.worker import CallersJax, prepared
from bodyslam_jax.config import Config, Distribution
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic

log = logging.getLogger(__name__)


def run_many(
    inputs: Iterable[str | Path | Input] | str | Path,
    config: Config = Config(),
    engine: str | Distribution | Engine = "local",
    *,
    out: str | Path,
    part: str | None = None,
    setup: Setup | None = None,
    estimate: Estimate | None = None,
) -> Iterator[Outcome]:
    """Runs many clips, each into its folder in `out`; yields outcomes as they finish.

    Clips that are finished there, with the same content, settings and version, are
    yielded first and not run again. What goes wrong with a clip is its outcome, stops
    no other, and is listed in `out/failed.jsonl`. The same call continues a batch that
    was interrupted.

    Args:
        inputs: clips, or folders, globs and manifests of clips (`find_inputs`).
        engine: name of an engine, settings, or an `Engine`.
        out: folder of the batch; all machines must see it under this path.
        part: `I/N`, to run every N-th clip only.
        setup: prepares each process. Without it JAX is set as in this process, and
            keeps compiled programs in the user's cache if it has none here.
        estimate: in place of the pipeline, what computes a clip.

    **Raises:** `InputError`, before anything runs, if inputs or settings have mistakes,
    a line for each.
    """
    jobs = plan(inputs, config, Path(out), part)
    if isinstance(engine, str):
        # `Distribution` refuses other names.
        engine = Distribution(engine=engine)  # pyright: ignore[reportArgumentType]
    if isinstance(engine, Distribution):
        engine = make_engine(engine, Path(out).resolve(), config.device != "cpu")
    setup = setup or CallersJax.read(config.device)
    return run_jobs(jobs, engine, prepared(setup), estimate)


def plan(
    inputs: Iterable[str | Path | Input] | str | Path,
    config: Config,
    out: Path,
    part: str | None = None,
) -> list[Job]:
    """The jobs of a batch; writes the mark of a batch into `out`.

    **Raises:** as `run_many`.
    """
    found = _inputs(inputs, config)
    out = out.resolve()
    chosen = found if part is None else shard(found, part)
    jobs, mistakes = [], []
    for one in chosen:
        if wrong := wrong_name(one.name):
            mistakes.append(f"name: {wrong}")
            continue
        try:
            settings = one.settings(config)
        except ValueError as error:
            mistakes.append(f"{one.name}: {error}")
            continue
        jobs.append(Job(_absolute(one), settings, out / RUNS / one.name))
    if mistakes:
        raise InputError(*mistakes)
    _mark(out, found)
    return jobs


def run_jobs(
    jobs: Sequence[Job],
    engine: Engine,
    setup: Setup,
    estimate: Estimate | None = None,
) -> Iterator[Outcome]:
    """Outcomes of jobs: those that are finished first, the others as they finish."""
    missing = []
    folder = jobs[0].batch if jobs else None
    listed = {line["name"] for line in failures.read(folder)} if folder else set()
    for job in jobs:
        outcome = finished(job)
        if outcome is None:
            missing.append(job)
            continue
        if outcome.is_failure and job.name not in listed:
            failures.add(job.batch, outcome)
        yield outcome
    if folder is None or not missing:
        return
    log.info("%d clips, %d of them done", len(jobs), len(jobs) - len(missing))
    failures.forget(folder, {job.name for job in missing})
    function = functools.partial(run_job, estimate=estimate)
    with contextlib.closing(engine.map(function, missing, setup)) as values:
        for job, value in values:
            if isinstance(value, Failure):
                # Its process may have been lost after it had finished.
                value = finished(job) or failure(job, value.message)
            if value.is_failure:
                failures.add(folder, value)
            yield value


def _inputs(
    inputs: Iterable[str | Path | Input] | str | Path, config: Config
) -> list[Input]:
    if isinstance(inputs, (str, Path)):
        return find_inputs(inputs, config)
    items = list(inputs)
    ready = [one for one in items if isinstance(one, Input)]
    if not ready:
        return find_inputs([str(one) for one in items], config)
    if len(ready) < len(items):
        raise InputError("inputs: expected paths or `Input`s, not both.")
    return ready


def _absolute(one: Input) -> Input:
    paths = ("path", "keypoints", "bodies", "camera", "groundtruth")
    given = {name: getattr(one, name) for name in paths}
    return dataclasses.replace(
        one, **{k: p.resolve() for k, p in given.items() if p is not None}
    )


def _mark(out: Path, inputs: Sequence[Input]) -> None:
    """Writes `batch.json`: the clips of the batch, which a folder shows to be one.

    **Raises:** `InputError` if the folder cannot be written.
    """
    clips = {one.name: str(one.path) for one in inputs}
    text = json.dumps({"clips": clips}, indent=0)
    try:
        (out / RUNS).mkdir(parents=True, exist_ok=True)
        if (out / MARK).is_file():
            _move_runs(out, clips)
        atomic.write_text(out / MARK, text)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}).") from None


def _move_runs(out: Path, names: Iterable[str]) -> None:
    """Moves run folders to where they belong: earlier versions had them beside the
    files of the batch."""
    for name in names:
        old, new = out / name, out / RUNS / name
        if name == RUNS:  # stays where it is, and is run again
            continue
        if record.is_begun(old) and not new.exists():
            with contextlib.suppress(FileNotFoundError):  # another driver has
                old.rename(new)
                log.info("%s: moved to %s", old, new)
