"""Every reader is given damaged and hostile files: a result, or one line, and no more.

Inputs are well-formed ones with mutations (`fuzz_mutations`), read by processes with
limits of memory and time (`fuzz_worker`). An input must end in finite numbers or in an
`InputError` of one line that names the file, within 10 s and 2 GB of resident memory.

`pytest -m fuzz -n 0` goes on for an hour. Variables of the environment:
`BODYSLAM_FUZZ_MINUTES`, `BODYSLAM_FUZZ_SEED` (random without it, and printed),
`BODYSLAM_FUZZ_TARGETS` (a regular expression), `BODYSLAM_FUZZ_WORKERS`, and
`BODYSLAM_FUZZ_OUT`: a folder for what failed and for the table of
`benchmarks/robustness.md`.
"""

import dataclasses
import itertools
import json
import os
import random
import re
import select
import shutil
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import fuzz_targets
import fuzz_worker
import pytest
from fuzz_mutations import mutated
from fuzz_targets import TARGETS, Target

if not Path("/proc/self/clear_refs").exists():
    pytest.skip("memory is measured by Linux", allow_module_level=True)

SUITE_SECONDS = 25.0
"""Of inputs in the default suite, after the processes have started."""
_START_SECONDS, _END_SECONDS = 300.0, 40.0
"""Time for a process to start, and for an input before its process is killed."""
_KEPT = 3
"""Number of inputs that are kept of each failure."""


class Worker:
    """A process that reads one input after the other; a new one where it dies."""

    def __init__(self) -> None:
        self.process: subprocess.Popen | None = None

    def start(self) -> None:
        # Without the type checks of tests: their errors are not the package's.
        self.process = subprocess.Popen(
            [sys.executable, fuzz_worker.__file__],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"JAX_ENABLE_X64": "1", "JAX_PLATFORMS": "cpu"},
        )
        answer = self._answer(_START_SECONDS)
        assert answer is not None and answer["end"] == "ready", answer

    def read(self, target: str, path: Path) -> dict[str, Any]:
        if self.process is None:
            self.start()
        assert self.process is not None and self.process.stdin is not None
        job = json.dumps({"target": target, "path": str(path)})
        try:
            self.process.stdin.write(job.encode() + b"\n")
            self.process.stdin.flush()
            answer = self._answer(_END_SECONDS)
        except OSError:
            answer = None
        if answer is not None:
            return answer
        hangs = self.process.poll() is None
        code = self.stop()
        why = f"no end in {_END_SECONDS:.0f} s" if hangs else f"killed by {-code}"
        return {"end": "bad", "why": why, "seconds": _END_SECONDS, "growth": 0}

    def stop(self) -> int:
        if self.process is None:
            return 0
        self.process.kill() if self.process.poll() is None else None
        code = self.process.wait()
        for stream in (self.process.stdin, self.process.stdout):
            if stream is not None:
                try:
                    stream.close()
                except OSError:
                    pass
        self.process = None
        return code

    def _answer(self, seconds: float) -> dict[str, Any] | None:
        """What the process says; `None` if it says nothing in time, or ends."""
        assert self.process is not None and self.process.stdout is not None
        if not select.select([self.process.stdout], [], [], seconds)[0]:
            return None
        line = self.process.stdout.readline()
        if not line and self.process.poll() is None:
            self.process.wait(10)
        return json.loads(line) if line else None


@dataclasses.dataclass
class Tally:
    """What became of the inputs of a target."""

    ends: Counter = dataclasses.field(default_factory=Counter)
    seconds: float = 0.0
    """The longest."""
    growth: int = 0
    """The largest, bytes."""
    failures: Counter = dataclasses.field(default_factory=Counter)
    """By what was wrong, numbers left out."""


def input_of(target: Target, tree: Any, seed: int, number: int) -> bytes:
    """The input of a number, the same wherever it is made."""
    rng = random.Random(f"{seed} {target.name} {number}")
    return mutated(target.form, tree, rng)


class Fuzzing:
    """Inputs of all targets in turn, by several processes, until the time is up."""

    def __init__(self, targets: list[Target], seed: int, home: Path, out: Path):
        self.targets, self.seed, self.home, self.out = targets, seed, home, out
        self.trees = {target.name: target.seed() for target in targets}
        self.beside = {target.name: target.beside() for target in targets}
        self.tallies = {target.name: Tally() for target in targets}
        self.lock = threading.Lock()
        self.errors: list[BaseException] = []

    def run(self, seconds: float, count: int) -> None:
        workers = [Worker() for _ in range(count)]
        jobs = self._jobs()
        ready = threading.Barrier(count + 1)
        until = [0.0]
        threads = [
            threading.Thread(target=self._work, args=(k, worker, jobs, ready, until))
            for k, worker in enumerate(workers)
        ]
        for thread in threads:
            thread.start()
        try:
            ready.wait(_START_SECONDS)
            until[0] = time.monotonic() + seconds
            ready.wait(10)
        except threading.BrokenBarrierError:
            pass  # a process has not started: its error is raised below
        finally:
            for thread in threads:
                thread.join()
        if self.errors:
            raise self.errors[0]

    def _jobs(self) -> Iterator[tuple[Target, int]]:
        for number in itertools.count():
            for target in self.targets:
                yield target, number

    def _work(
        self,
        k: int,
        worker: Worker,
        jobs: Iterator[tuple[Target, int]],
        ready: threading.Barrier,
        until: list[float],
    ) -> None:
        try:
            worker.start()
            ready.wait(_START_SECONDS)
            ready.wait(10)
            while time.monotonic() < until[0]:
                with self.lock:
                    target, number = next(jobs)
                self._try(worker, target, number, self.home / f"{k}-{number % 97}")
        except BaseException as error:
            self.errors.append(error)
            ready.abort()
        finally:
            worker.stop()

    def _try(self, worker: Worker, target: Target, number: int, folder: Path) -> None:
        content = input_of(target, self.trees[target.name], self.seed, number)
        path = folder / target.file
        try:
            for name, other in self.beside[target.name].items():
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                (folder / name).write_bytes(other)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
            answer = worker.read(target.name, path)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        tally = self.tallies[target.name]
        with self.lock:
            tally.ends[answer["end"]] += 1
            tally.seconds = max(tally.seconds, answer["seconds"])
            tally.growth = max(tally.growth, answer["growth"])
            if answer["end"] == "bad":
                kind = re.sub(r"/\S+|\d+", "#", answer["why"].split(": ")[0])
                tally.failures[kind] += 1
                if tally.failures[kind] <= _KEPT:
                    self._keep(target, number, content, answer["why"])

    def _keep(self, target: Target, number: int, content: bytes, why: str) -> None:
        folder = self.out / f"{target.name}-{self.seed}-{number}"
        (folder / target.file).parent.mkdir(parents=True, exist_ok=True)
        (folder / target.file).write_bytes(content)
        (folder / "why.txt").write_text(f"{target.name}: {why}\n")

    @property
    def failures(self) -> list[str]:
        return [
            f"{name}: {count} x {kind}"
            for name, tally in self.tallies.items()
            for kind, count in tally.failures.items()
        ]

    def table(self) -> str:
        """Markdown, a row for each reader."""
        head = "| reader | inputs | read | refused | failures | longest, s | most, MB |"
        lines = [head, "|---|---:|---:|---:|---:|---:|---:|"]
        total: Counter = Counter()
        for name, tally in self.tallies.items():
            ends = tally.ends
            total += ends
            lines.append(
                f"| {name} | {ends.total()} | {ends['ok']} | {ends['refused']} | "
                f"{ends['bad']} | {tally.seconds:.2f} | {tally.growth / 1e6:.0f} |"
            )
        lines.append(
            f"| **all** | {total.total()} | {total['ok']} | {total['refused']} | "
            f"{total['bad']} | {max(t.seconds for t in self.tallies.values()):.2f} | "
            f"{max(t.growth for t in self.tallies.values()) / 1e6:.0f} |"
        )
        return "\n".join(lines) + "\n"


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_the_inputs_that_are_mutated_are_well_formed(target, tmp_path):
    path = tmp_path / "home" / target.file
    fuzz_targets.write(target, path, fuzz_targets.dumped(target))
    answer = fuzz_worker.judged(target.read, path, target.may_be_nan)
    assert answer == {"end": "ok", "why": ""}


def test_the_worker_tells_every_kind_of_failure(tmp_path):
    from bodyslam_jax.config.errors import InputError

    path = tmp_path / "a.npz"

    def judged(read):
        return fuzz_worker.judged(read, path, ())

    def fails(error):
        def read(path):
            raise error

        return read

    assert judged(lambda path: 1.0)["end"] == "ok"
    assert judged(fails(InputError(f"{path}: no array.")))["end"] == "refused"
    for bad in (
        lambda path: {"a": [1.0, float("nan")]},
        fails(InputError("no name of a file")),
        fails(ValueError(f"{path}: not of the input's class")),
        fails(RecursionError()),
        fails(MemoryError()),
    ):
        assert judged(bad)["end"] == "bad"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of making inputs that are wrong
def test_inputs_of_a_fixed_seed_end_in_a_result_or_a_line(tmp_path):
    fuzzing = Fuzzing(TARGETS, 20261127, tmp_path / "in", tmp_path / "failures")
    fuzzing.run(SUITE_SECONDS, min(2, os.cpu_count() or 1))
    tried = sum(tally.ends.total() for tally in fuzzing.tallies.values())
    assert tried >= len(TARGETS), fuzzing.table()
    assert not fuzzing.failures, "\n".join([*fuzzing.failures, str(fuzzing.out)])


@pytest.mark.fuzz
@pytest.mark.filterwarnings("ignore")
def test_inputs_of_a_random_seed_end_in_a_result_or_a_line(tmp_path, capsys):
    setting = lambda name, default: os.environ.get(f"BODYSLAM_FUZZ_{name}", default)
    seed = int(setting("SEED", str(random.SystemRandom().randrange(10**9))))
    minutes = float(setting("MINUTES", "60"))
    wanted = re.compile(setting("TARGETS", ""))
    count = int(setting("WORKERS", str(os.cpu_count() or 1)))
    out = Path(setting("OUT", str(tmp_path / "failures"))).resolve()
    out.mkdir(parents=True, exist_ok=True)
    with capsys.disabled():
        print(f"\nseed {seed}, {minutes:g} minutes; failures go to {out}")
    chosen = [target for target in TARGETS if wanted.search(target.name)]
    fuzzing = Fuzzing(chosen, seed, tmp_path / "in", out)
    try:
        fuzzing.run(60 * minutes, count)
    finally:
        (out / "table.md").write_text(fuzzing.table())
        with capsys.disabled():
            print(fuzzing.table())
    assert not fuzzing.failures, "\n".join([*fuzzing.failures, f"seed {seed}: {out}"])
