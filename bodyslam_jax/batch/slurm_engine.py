"""Engine of job arrays on a SLURM cluster, through submitit.

The items are distributed over the tasks of one array. A task works on its share, and
appends each value to a file of the shared folder, which the driver follows. A task that
reaches its time limit or is preempted is requeued and continues its share; the rest of
a lost task's share is submitted in another array.
"""

import contextlib
import dataclasses
import logging
import pickle
import shutil
import time
import uuid
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

from bodyslam_jax.batch.engine import Failure, Setup, Values, attempt
from bodyslam_jax.config.errors import InputError

log = logging.getLogger(__name__)
DEFAULT_TASKS = 16
"""Number of tasks of an array, if it is not given."""
_POLL_PERIOD_S = 2.0
"""Period at which new values are read."""


@dataclasses.dataclass(frozen=True)
class SlurmEngine:
    """Engine of job arrays."""

    folder: Path
    """Folder that all machines can access; scripts, logs and values are in its
    `.slurm`."""
    workers: int | None = None
    """Number of tasks of an array; `DEFAULT_TASKS` by default."""
    retries: int = 2
    """Number of times that a task is requeued, and an item given to another array."""
    minutes: int = 240
    """Time limit of a task, min."""
    parameters: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Parameters of submitit: `slurm_partition`, `mem_gb` ..."""
    cluster: str = "slurm"
    """Kind of cluster; `local` runs the tasks as processes of this machine, for
    tests."""

    def map(
        self, function: Callable[[Any], Any], items: Sequence[Any], setup: Setup
    ) -> Values:
        """Implements `Engine.map`."""
        todo = [(number, 0) for number in range(len(items))]
        home = Path(self.folder, ".slurm", uuid.uuid4().hex[:8])
        while todo:
            attempts = dict(todo)
            done: set[int] = set()
            first_left: set[int] = set()
            round_ = self._round(home, function, items, list(attempts), setup)
            with contextlib.closing(round_):
                for number, value in round_:
                    if value is _LOST:
                        first_left.add(number)
                        continue
                    done.add(number)
                    yield items[number], value
            todo = []
            for number, before in attempts.items():
                if number in done:
                    continue
                # The item that a lost task was working on has used up an attempt.
                after = before + (number in first_left)
                if after <= self.retries:
                    todo.append((number, after))
                else:
                    text = f"its SLURM task was lost, {after} times; logs in {home}."
                    yield items[number], Failure(text)
        shutil.rmtree(home, ignore_errors=True)

    def _round(
        self,
        home: Path,
        function: Callable[[Any], Any],
        items: Sequence[Any],
        numbers: Sequence[int],
        setup: Setup,
    ) -> Generator[tuple[int, Any], None, None]:
        """Submits an array for these items; yields values by number, and `_LOST` for
        the item that a lost task was working on."""
        executor = self._executor(home)
        count = min(self.workers or DEFAULT_TASKS, len(numbers))
        files = [home / f"{uuid.uuid4().hex[:8]}.values" for _ in range(count)]
        shares = [
            Share(function, setup, [(n, items[n]) for n in numbers[k::count]], file)
            for k, file in enumerate(files)
        ]
        jobs = executor.map_array(run_share, shares)
        log.info("slurm: array %s, logs in %s", jobs[0].job_id.split("_")[0], home)
        open_ = dict(zip(files, zip(jobs, shares, strict=True), strict=True))
        read = dict.fromkeys(files, 0)
        values: dict[Path, set[int]] = {file: set() for file in files}
        try:
            while open_:
                for file, (job, share) in list(open_.items()):
                    ended = job.done()
                    new, read[file] = read_values(file, read[file])
                    for number, value in new:
                        values[file].add(number)
                        yield number, value
                    if not ended:
                        continue
                    del open_[file]
                    left = [n for n, _ in share.items if n not in values[file]]
                    if left:
                        _raise_setup_error(job)
                        yield left[0], _LOST
                if open_:
                    time.sleep(_POLL_PERIOD_S if self.cluster == "slurm" else 0.1)
        finally:
            for job, _ in open_.values():
                with contextlib.suppress(OSError):
                    job.cancel(check=False)

    def _executor(self, home: Path) -> Any:
        submitit = _import_submitit()
        if self.cluster == "slurm" and shutil.which("sbatch") is None:
            raise InputError(
                "--engine slurm: no sbatch on this machine; run it on a login node of "
                "the cluster, or use --engine local."
            )
        home.mkdir(parents=True, exist_ok=True)
        executor = submitit.AutoExecutor(
            folder=home / "%A" if self.cluster == "slurm" else home,
            cluster=self.cluster,
            slurm_max_num_timeout=self.retries,
        )
        given = {
            "name": "bodyslam",
            "timeout_min": self.minutes,
            "cpus_per_task": 1,
            **self.parameters,
        }
        try:
            executor.update_parameters(**given)
        except (TypeError, NameError) as error:
            text = " ".join(str(error).split())
            raise InputError(f"--slurm: {text}") from None
        return executor


_LOST = object()


@dataclasses.dataclass(frozen=True)
class Share:
    """The items that one task of an array works on."""

    function: Callable[[Any], Any]
    setup: Setup
    items: list[tuple[int, Any]]
    """Numbers and items."""
    values: Path
    """File of pickled numbers and values, in the order in which they were finished."""


class SetupError(RuntimeError):
    """Raised if the process could not be prepared."""


class _Runner:
    """Runs a share; items that a requeued task had finished before are not run
    again."""

    def __call__(self, share: Share) -> None:
        try:
            share.setup()
        except Exception as error:
            raise SetupError(str(error)) from error
        begun, end = read_values(share.values, 0)
        done = {number for number, _ in begun}
        with share.values.open("ab") as file:
            file.truncate(end)  # drops what a killed task wrote incompletely
            for number, item in share.items:
                if number not in done:
                    value = attempt(share.function, item)
                    file.write(pickle.dumps((number, value)))
                    file.flush()

    def checkpoint(self, share: Share) -> Any:
        """Returns the call that submitit submits again after a time-out or
        preemption."""
        return _import_submitit().helpers.DelayedSubmission(self, share)


run_share = _Runner()


def read_values(file: Path, start: int) -> tuple[list[tuple[int, Any]], int]:
    """Returns the complete values after byte `start`, and the position behind them."""
    found: list[tuple[int, Any]] = []
    with contextlib.suppress(FileNotFoundError), file.open("rb") as stream:
        stream.seek(start)
        with contextlib.suppress(EOFError, pickle.UnpicklingError):
            while True:
                found.append(pickle.load(stream))
                start = stream.tell()
    return found, start


def _raise_setup_error(job: Any) -> None:
    """Checks whether the task ended because it could not be prepared.

    **Raises:** `InputError` if so.
    """
    try:
        text = str(job.exception())
    except Exception:  # lost without a result
        return
    lines = [line for line in text.splitlines() if SetupError.__name__ in line]
    if lines:
        raise InputError(lines[-1].partition(f"{SetupError.__name__}: ")[2])


def _import_submitit() -> Any:
    try:
        import submitit  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError(
            "--engine slurm: submitit is not installed; pip install "
            "'bodyslam-jax[slurm]'."
        ) from None
    return submitit
