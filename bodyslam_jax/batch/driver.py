"""Runs the clips of a batch by an engine; the same call resumes an interrupted
batch."""

import contextlib
import dataclasses
import functools
import json
import logging
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from bodyslam_jax.batch import failures, record
from bodyslam_jax.batch.engine import Engine, Failure, Setup
from bodyslam_jax.batch.engines import CallersJax, make_engine, prepared
from bodyslam_jax.batch.inputs import (
    BATCH_FILE,
    RUNS_FOLDER,
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
    yielded first and not run again. An error becomes the outcome of its clip, does not
    stop other clips, and is listed in `out/failed.jsonl`. The same call resumes a batch
    that was interrupted.

    Args:
        inputs: clips, or folders, globs and manifests of clips (`find_inputs`).
        config: settings of all clips, which the options of a clip override.
        engine: name of an engine, settings, or an `Engine`.
        out: folder of the batch; all machines must access it under this path.
        part: `I/N`, to run every N-th clip only.
        setup: prepares each process. By default JAX is configured as in this process,
            and caches compiled programs in the user's cache unless it has another one.
        estimate: function that computes a clip instead of the pipeline.

    **Raises:** `InputError`, before anything runs, if inputs or settings have mistakes,
    with a line for each.
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
    """Returns the jobs of a batch, and writes `batch.json` into `out`.

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
        jobs.append(Job(_absolute(one), settings, out / RUNS_FOLDER / one.name))
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
    """Yields the outcomes of jobs: first those that are finished, the others as they
    finish."""
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
    """Writes `batch.json`, which lists the clips and marks the folder as that of a
    batch.

    **Raises:** `InputError` if the folder cannot be written.
    """
    clips = {one.name: str(one.path) for one in inputs}
    text = json.dumps({"clips": clips}, indent=0)
    try:
        (out / RUNS_FOLDER).mkdir(parents=True, exist_ok=True)
        if (out / BATCH_FILE).is_file():
            _move_runs(out, clips)
        atomic.write_text(out / BATCH_FILE, text)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}).") from None


def _move_runs(out: Path, names: Iterable[str]) -> None:
    """Moves run folders from the place at which earlier versions had them, beside the
    files of the batch."""
    for name in names:
        old, new = out / name, out / RUNS_FOLDER / name
        if name == RUNS_FOLDER:  # is not moved, but run again
            continue
        if record.is_begun(old) and not new.exists():
            with contextlib.suppress(FileNotFoundError):  # another driver has moved it
                old.rename(new)
                log.info("%s: moved to %s", old, new)
