"""Runs `bodyslam experiment`: computes the missing rows and writes the report."""

import functools
import logging
from pathlib import Path

from bodyslam_jax.batch.engine import Engine, Failure, Setup
from bodyslam_jax.config import Config, Experiment
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.experiments.jobs import Journal, Plan, Row, check_files
from bodyslam_jax.experiments.plans import PLANS

log = logging.getLogger(__name__)


def run_experiment(
    name: str,
    out: Path,
    experiment: Experiment = Experiment(),
    config: Config = Config(),
    engine: Engine | None = None,
    setup: Setup | None = None,
) -> list[Path]:
    """Computes the rows that `out` lacks, writes tables and figures, and returns their
    paths.

    Rows are cached in `out/rows` under a fingerprint of their inputs, stages before the
    joint estimate in `out/stages`. Tables are written after every row, so that an
    interrupted experiment leaves those of the finished rows. A row that cannot be
    computed is left out with a warning.

    Args:
        engine: computes the rows elsewhere, in processes that `setup` prepares; `out`
            is then a folder that they see. Without it, this process does.

    **Raises:** `InputError` if there is no such experiment, if `out` cannot be written,
    or if no row could be computed; `ValueError` or `FileNotFoundError`, before anything
    is computed, if a file that the settings name cannot be used.
    """
    if name not in PLANS:
        raise InputError(f"no experiment {name!r}; expected one of {sorted(PLANS)}.")
    check_files(experiment, config)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be written ({error.strerror}).") from None
    if engine is not None:
        out = out.resolve()
    plan = PLANS[name](experiment, config, out / "stages")
    journal = Journal(out / "rows")
    missing = [
        job
        for job in plan.jobs
        if journal.kept(name, job.label, job.key, job.form) is None
    ]
    minutes = sum(job.seconds for job in missing) / 60
    log.info(
        "%s: %d rows, %d of them done; about %.0f min of processor time to go",
        name,
        len(plan.jobs),
        len(plan.jobs) - len(missing),
        minutes,
    )
    if engine is not None and missing:
        numbers = [k for k, job in enumerate(plan.jobs) if job in missing]
        compute = functools.partial(compute_row, name, out, experiment, config)
        for number, value in engine.map(compute, numbers, setup or _nothing):
            label = plan.jobs[number].label
            if isinstance(value, Failure):
                log.warning("%s %s: left out: %s", name, label, value.message)
            else:
                log.info("%s %s: computed", name, label)
    rows: list[Row] = []
    written: list[Path] = []
    for job in plan.jobs:
        if engine is not None:
            row = journal.kept(name, job.label, job.key, job.form)
            rows += [] if row is None else [row]
            continue
        try:
            rows.append(journal.row(name, job.label, job.key, job.compute, job.form))
        except (FileNotFoundError, ValueError) as error:
            log.warning("%s %s: left out: %s", name, job.label, error)
            continue
        if job in missing or job is plan.jobs[-1]:
            written = plan.write(out, rows)
    if not rows:
        raise InputError(f"{name}: no row could be computed; see above.")
    return written or plan.write(out, rows)


def compute_row(
    name: str, out: Path, experiment: Experiment, config: Config, number: int
) -> None:
    """Computes one row of an experiment into `out/rows`, in any process."""
    job = _plan(name, out, experiment, config).jobs[number]
    Journal(out / "rows").row(name, job.label, job.key, job.compute, job.form)


@functools.lru_cache(maxsize=1)
def _plan(name: str, out: Path, experiment: Experiment, config: Config) -> Plan:
    """Returns the plan, cached so that further rows share what its jobs have
    computed."""
    return PLANS[name](experiment, config, out / "stages")


def _nothing() -> None:
    pass
