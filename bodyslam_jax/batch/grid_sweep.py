"""Solves the joint estimate over a grid of weights, start scales and settings
(`sweep`)."""

import contextlib
import hashlib
import json
import logging
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from bodyslam_jax.batch import collection, record
from bodyslam_jax.batch.collection import write_tables
from bodyslam_jax.batch.engine import Engine, Failure, Setup
from bodyslam_jax.batch.grid import Axis, at_point, mapped_points, settings_points
from bodyslam_jax.batch.inputs import Input, find_inputs
from bodyslam_jax.batch.rows import Column, Row, error_columns, present
from bodyslam_jax.batch.sweep_job import ERRORS, SweepJob, run_sweep
from bodyslam_jax.config import Config
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic, files

log = logging.getLogger(__name__)


def sweep(
    inputs: Iterable[str | Path] | str | Path,
    axes: Sequence[Axis],
    config: Config,
    out: Path,
    engine: Engine,
    setup: Setup,
) -> tuple[list[Path], list[str]]:
    """Solves every clip at every point, and writes `table.csv`, `.md`, `.tex` and
    `plots.png`.

    Returns their paths, and a line for each problem that was not solved. A clip at one
    point of the settings is one job: its weights and scales are solved by one program,
    and its rows are cached in `out/rows`, so that the same call resumes.

    **Raises:** `InputError` if inputs have mistakes, or nothing could be solved.
    """
    try:
        (out / "rows").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}).") from None
    jobs = list(_jobs(find_inputs(inputs, config), axes, config, out.resolve()))
    places = {job.label: _file(out, job) for job in jobs}
    found = {job.label: _kept(places[job.label], job) for job in jobs}
    missing = [job for job in jobs if found[job.label] is None]
    log.info("%d problems, %d of them solved", len(jobs), len(jobs) - len(missing))
    failed = []
    with contextlib.closing(engine.map(run_sweep, missing, setup)) as values:
        for job, value in values:
            if isinstance(value, Failure):
                failed.append(f"{job.label}: {value.message}")
                log.warning("%s", failed[-1])
                continue
            atomic.write_text(places[job.label], json.dumps(value))
            found[job.label] = value
            log.info("%s: %d points", job.label, len(value))
    rows = [row for job in jobs for row in found[job.label] or []]
    if not rows:
        raise InputError(failed[0] if failed else f"{out}: nothing to solve.")
    columns = present(_columns(axes), rows)
    written = write_tables(out, columns, rows)
    collection.draw_sweep(out / "plots.png", rows, axes, columns)
    return [*written, out / "plots.png"], failed


def _jobs(
    inputs: Iterable[Input], axes: Sequence[Axis], config: Config, out: Path
) -> Iterator[SweepJob]:
    points = tuple(mapped_points(axes))
    for one in inputs:
        settings = one.settings(config)
        for point in settings_points(axes):
            yield SweepJob(
                one, at_point(settings, point), point, points, out / "stages" / one.name
            )


def _file(out: Path, job: SweepJob) -> Path:
    """Returns the file of a job's rows; its name contains a hash of everything they
    depend on."""
    parts = (
        record.source_hash(job.source, job.config),
        record.settings_hash(job.config),
        json.dumps(job.points),
        json.dumps(job.setting),
    )
    mark = hashlib.sha256("\n".join(parts).encode()).hexdigest()[:12]
    return out / "rows" / f"{job.source.name}-{mark}.json"


def _kept(file: Path, job: SweepJob) -> list[Row] | None:
    if not file.exists():
        return None
    try:
        found = files.read_json(file, "rows of a sweep")
    except InputError as error:
        log.warning("%s Solved again.", error)
        return None
    if not _are_rows(found, job):
        log.warning("%s: not the rows of its problem; solved again.", file)
        return None
    return found


def _are_rows(found: Any, job: SweepJob) -> bool:
    """Returns whether a value is the rows of a job: one row of plain values for each
    point."""
    if not isinstance(found, list) or len(found) != len(job.points):
        return False
    plain = (str, int, float, bool, type(None))
    return all(
        isinstance(row, dict)
        and row.get("name") == job.source.name
        and row.items() >= {**job.setting, **point}.items()
        and all(isinstance(value, plain) for value in row.values())
        for row, point in zip(found, job.points, strict=True)
    )


def _columns(axes: Sequence[Axis]) -> list[Column]:
    named = [Column(axis.name, _title(axis)) for axis in axes]
    return [
        Column("name", "clip"),
        *named,
        Column("status", "status"),
        Column("cost", "cost", 1),
        Column("iterations", "steps"),
        Column("estimate", "scale, m per map unit", 3),
        Column("camera_path", "camera path, m", 3),
        *error_columns(ERRORS),
    ]


def _title(axis: Axis) -> str:
    if axis.is_setting:
        return axis.name
    return f"λ of {axis.term}" if axis.term else "start's scale"
