"""Runs a job, one clip with its settings, into a folder; it depends on nothing else."""

import dataclasses
import logging
import socket
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

from bodyslam_jax.batch import record
from bodyslam_jax.batch.inputs import Input
from bodyslam_jax.config import Config
from bodyslam_jax.config.errors import InputError, error_line

log = logging.getLogger(__name__)
Status = Literal["ok", "doubtful", "failed", "error"]
_MAX_WAIT_S, _POLL_PERIOD_S = 3600.0, 1.0
"""Time to wait for another process that writes the same run folder, and time between
two attempts."""


@dataclasses.dataclass(frozen=True)
class Job:
    """A clip to be estimated, its settings, and its run folder."""

    source: Input
    config: Config
    """Settings, including the options of this clip."""
    out: Path
    """Run folder, in the folder `RUNS_FOLDER` of the batch."""

    @property
    def name(self) -> str:
        """Name of the clip."""
        return self.source.name

    @property
    def batch(self) -> Path:
        """Folder of the batch."""
        return self.out.parents[1]


@dataclasses.dataclass(frozen=True)
class Outcome:
    """Result of a job: its status, with a message and measurements of the run."""

    name: str
    status: Status
    """`ok`, `doubtful` or `failed` as in `summary.json`; `error` if there is no
    result."""
    folder: Path
    """Run folder."""
    message: str = ""
    """Reason why the job failed or its result is doubtful."""
    seconds: float = 0.0
    """Duration, s; 0 for a job that was finished before."""
    machine: str = ""
    was_finished: bool = False
    """Whether an earlier run had finished it."""

    @property
    def is_failure(self) -> bool:
        """Whether there is no usable result."""
        return self.status in ("failed", "error")

    def result(self) -> Any:
        """Reads the `Result` from the run folder."""
        from bodyslam_jax import evaluation

        return evaluation.read_result(self.folder)


Estimate = Callable[[Job], dict[str, Any]]
"""Runs a job, writes its run folder, and returns its summary."""


def finished(job: Job) -> Outcome | None:
    """Returns the outcome of a job that is finished and whose files are unchanged
    since.

    Only the record and the dates of files are read, not their content.
    """
    found = record.read(job.out)
    if found is None or found.get("settings") != record.settings_hash(job.config):
        return None
    try:
        stamp = record.stamp(job.source, job.config)
    except (OSError, ValueError):
        return None
    return _recorded(job, found) if found.get("stamp") == stamp else None


def run_job(job: Job, *, estimate: Estimate | None = None) -> Outcome:
    """Runs a job unless its input and settings are those of the run in its folder.

    Errors become the outcome's message; their traceback is written to the log of the
    job, `logs/NAME.txt` in the folder of the batch. If another process is running the
    job, the function waits for it.
    """
    start = time.monotonic()
    try:
        home = job.batch
        if not job.out.parent.is_dir():
            raise InputError(
                f"{job.out.parent}: no such folder on {socket.gethostname()}; expected "
                "one that all machines share."
            )
        with _logged(home / "logs" / f"{job.name}.txt"):
            try:
                outcome = _run(job, estimate or estimate_clip)
            except Exception:
                log.error("%s", traceback.format_exc())
                raise
    except Exception as error:
        outcome = failure(job, error_line(error))
    return dataclasses.replace(
        outcome,
        seconds=0.0 if outcome.was_finished else round(time.monotonic() - start, 2),
        machine=socket.gethostname(),
    )


def estimate_clip(job: Job) -> dict[str, Any]:
    """Runs the whole pipeline on the job's clip, as `bodyslam run` does."""
    from bodyslam_jax import io, pipeline

    source = job.source
    sequence = io.read_sequence(
        source.path,
        keypoints=source.keypoints,
        bodies=source.bodies,
        camera=source.camera,
        config=job.config.association,
        known=job.config,
    )
    if source.groundtruth is not None:
        sequence = dataclasses.replace(sequence, groundtruth=source.groundtruth)
    return pipeline.run_to_folder(sequence, job.out, job.config).summary


def failure(job: Job, message: str) -> Outcome:
    """Returns the outcome of a job without a result."""
    return Outcome(job.name, "error", job.out, message)


def _run(job: Job, estimate: Estimate) -> Outcome:
    from bodyslam_jax import export

    until = time.monotonic() + _MAX_WAIT_S
    source = record.source_hash(job.source, job.config)
    settings = record.settings_hash(job.config)
    hashes = {"source": source, "settings": settings}
    while True:
        found = record.read(job.out)
        stamp = record.stamp(job.source, job.config)
        if found is not None and found.items() >= hashes.items():
            record.finish(job.out, found | {"stamp": stamp})
            return _recorded(job, found)
        if record.begun_for(job.out) not in (None, source):
            with export.locked(job.out):
                export.clear_run(job.out)
        start = time.monotonic()
        try:
            with record.begun(job.out, source):
                summary = estimate(job)
        except export.FolderInUse:
            if time.monotonic() > until:
                raise
            time.sleep(_POLL_PERIOD_S)
            continue
        outcome = {
            "status": summary["status"],
            "message": _reasons(summary),
            "seconds": round(time.monotonic() - start, 2),
        }
        record.finish(job.out, {**hashes, **outcome, "stamp": stamp})
        return Outcome(job.name, outcome["status"], job.out, outcome["message"])


def _recorded(job: Job, found: dict[str, Any]) -> Outcome:
    status, message = found["status"], found["message"]
    return Outcome(job.name, status, job.out, message, was_finished=True)


def _reasons(summary: dict[str, Any]) -> str:
    return " ".join(str(one.get("message")) for one in summary.get("reasons") or [])


class _logged:
    """Writes the package's log messages during a block to a file."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> None:
        self.path.parent.mkdir(exist_ok=True)
        # The file is opened at the first message, so that a finished job keeps its log.
        self.handler = logging.FileHandler(self.path, "w", "utf-8", delay=True)
        self.handler.setFormatter(logging.Formatter("%(asctime)s %(message)s"))
        logging.getLogger("bodyslam_jax").addHandler(self.handler)

    def __exit__(self, *_: object) -> None:
        logging.getLogger("bodyslam_jax").removeHandler(self.handler)
        self.handler.close()
