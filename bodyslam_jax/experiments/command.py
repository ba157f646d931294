"""`bodyslam experiment`: computes the rows that are missing and writes the report."""

import logging
from pathlib import Path

from bodyslam_jax.config import Config, Experiment
from bodyslam_jax.experiments.jobs import check_files
from bodyslam_jax.experiments.plans import PLANS
from bodyslam_jax.experiments.row_cache import Journal, Row

log = logging.getLogger(__name__)


def run_experiment(
    name: str,
    out: Path,
    experiment: Experiment = Experiment(),
    config: Config = Config(),
) -> list[Path]:
    """Computes the rows that `out` lacks and writes tables and figures; their paths.

    Rows are kept in `out/rows` under a fingerprint of their inputs, stages before the
    joint estimate in `out/stages`. Tables are written after every row, so that an
    interrupted experiment leaves those that are finished. A row that cannot be computed
    is left out with a warning.

    **Raises:** `ValueError` if there is no such experiment, if `out` cannot be written,
    or if no row could be computed; `ValueError` or `FileNotFoundError`, before anything
    is computed, if a file that the settings name cannot be used.
    """
    if name not in PLANS:
        raise ValueError(f"no experiment {name!r}; expected one of {sorted(PLANS)}.")
    check_files(experiment, config)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{out}: cannot be written ({error.strerror}).") from None
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
    rows: list[Row] = []
    written: list[Path] = []
    for job in plan.jobs:
        try:
            rows.append(journal.row(name, job.label, job.key, job.compute, job.form))
        except (FileNotFoundError, ValueError) as error:
            log.warning("%s %s: left out: %s", name, job.label, error)
            continue
        if job in missing or job is plan.jobs[-1]:
            written = plan.write(out, rows)
    if not rows:
        raise ValueError(f"{name}: no row could be computed; see above.")
    return written or plan.write(out, rows)
