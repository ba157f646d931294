"""Engine of processes on this machine, each of which runs one item at a time and keeps
its compiled programs.

A process that ends unexpectedly is replaced, and its item is given to another.
Processes end with the driver, however that ends.
"""

import collections
import contextlib
import dataclasses
import importlib.util
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from bodyslam_jax.batch.engine import Failure, Setup, Values, attempt
from bodyslam_jax.config.errors import InputError

WORKER_MEMORY_BYTES = 3 << 30
"""Memory that a process may need; measured in benchmarks/batch.md."""
_GPU_PLUGINS = ("jax_cuda12_plugin", "jax_cuda13_plugin")
_SPAWN_CONTEXT = multiprocessing.get_context("spawn")


@dataclasses.dataclass(frozen=True)
class LocalEngine:
    """Engine of processes on this machine."""

    workers: int | None = None
    """Number of processes; by default one per GPU, else one per core as far as memory
    allows."""
    retries: int = 2
    gpu: bool = True
    """Whether GPUs are used if there are any."""

    def map(
        self, function: Callable[[Any], Any], items: Sequence[Any], setup: Setup
    ) -> Values:
        """Implements `Engine.map`."""
        devices = _gpus() if self.gpu else []
        most = len(devices) or max(
            1, min(len(_cores()), _memory() // WORKER_MEMORY_BYTES)
        )
        count = min(self.workers or most, len(items))
        threads = max(1, len(_cores()) // max(count, 1))
        waiting = collections.deque((item, 0) for item in items)
        make = lambda k: _Worker(_environment(threads, devices, k), function, setup)
        workers = [make(k) for k in range(count)]
        try:
            while waiting or any(worker.busy for worker in workers):
                for worker in workers:
                    if waiting and not worker.busy:
                        worker.start(*waiting.popleft())
                busy = [worker for worker in workers if worker.busy]
                ready = wait([worker.connection for worker in busy])
                for worker in busy:
                    if worker.connection not in ready:
                        continue
                    item, attempts = worker.item, worker.attempts + 1
                    try:
                        yield item, worker.receive()
                    except _Ended as ended:
                        place = workers.index(worker)
                        workers[place] = make(place)
                        if attempts <= self.retries:
                            waiting.appendleft((item, attempts))
                        else:
                            yield item, Failure(f"{ended}, {attempts} times.")
        finally:
            for worker in workers:
                worker.close()
            for worker in workers:
                worker.join()


class _Ended(Exception):
    """Raised if a worker's process has ended; the text says how."""


class _Worker:
    """A process with its current item; it is started with the first item."""

    def __init__(
        self,
        environment: Mapping[str, str],
        function: Callable[[Any], Any],
        setup: Setup,
    ) -> None:
        self.connection, theirs = _SPAWN_CONTEXT.Pipe()
        self._theirs: Connection | None = theirs
        self.process = _SPAWN_CONTEXT.Process(
            target=_work, args=(theirs, dict(environment), function, setup), daemon=True
        )
        self.item: Any = None
        self.attempts = 0
        self.busy = False

    def start(self, item: Any, attempts: int) -> None:
        """Sends an item to the process, which is started if it is the first."""
        self.item, self.attempts, self.busy = item, attempts, True
        if self._theirs is not None:
            self.process.start()
            self._theirs.close()
            self._theirs = None
        with contextlib.suppress(OSError):  # the process has ended; `receive` notices
            self.connection.send(item)

    def receive(self) -> Any:
        """Returns the value of the item.

        **Raises:** `_Ended` if the process has ended; `InputError` if it could not be
        set up.
        """
        try:
            kind, value = self.connection.recv()
        except (EOFError, OSError):
            self.process.join()
            raise _Ended(_describe(self.process.exitcode)) from None
        if kind == "setup":
            raise InputError(value)
        self.busy = False
        return value

    def close(self) -> None:
        """Asks the process to end; a busy process is terminated."""
        self.connection.close()
        if self.busy:
            self.process.terminate()

    def join(self) -> None:
        """Waits until the process has ended, and kills it after a timeout."""
        if self.process.pid is not None:
            self.process.join(_SHUTDOWN_TIMEOUT_S)
            if self.process.is_alive():
                self.process.kill()


_SHUTDOWN_TIMEOUT_S = 2.0
"""Time after which an idle process that has not ended is killed."""


def _describe(code: int | None) -> str:
    if code is not None and code < 0:
        name = signal.Signals(-code).name
        hint = " (out of memory?)" if -code == signal.SIGKILL else ""
        return f"the process was ended by {name}{hint}"
    return f"the process ended with code {code}"


def _environment(threads: int, devices: Sequence[str], number: int) -> dict[str, str]:
    """Returns the environment variables that give a process its share of the machine.

    `NPROC` is read by XLA, the others by OpenMP and OpenCV.
    """
    names = ("NPROC", "OMP_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
    found = {name: os.environ.get(name, str(threads)) for name in names}
    if devices:
        found["CUDA_VISIBLE_DEVICES"] = devices[number % len(devices)]
    return found


def _work(
    connection: Connection,
    environment: Mapping[str, str],
    function: Callable[[Any], Any],
    setup: Setup,
) -> None:
    """Runs in a worker's process: receives items and sends values until the driver
    closes."""
    os.environ.update(environment)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        try:
            setup()
        except Exception as error:
            connection.send(("setup", str(error)))
            return
        while True:
            connection.send(("value", attempt(function, connection.recv())))
    except (EOFError, OSError, KeyboardInterrupt):
        # Closed or interrupted: the driver decides whether the item is run again.
        pass


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)


def _cores() -> list[int]:
    """Returns the cores that this process may use; JAX, which would occupy them, is not
    asked."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def _memory() -> int:
    """Returns the memory of the machine, or of the container of this process, bytes."""
    total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    try:
        limit = Path("/sys/fs/cgroup/memory.max").read_text().strip()
    except OSError:
        return total
    return min(total, int(limit)) if limit.isdigit() else total


def _gpus() -> list[str]:
    """Returns the names of GPUs for `CUDA_VISIBLE_DEVICES`; none if JAX has no build
    for GPUs.

    JAX is not asked, because it would occupy them.
    """
    if not any(importlib.util.find_spec(name) for name in _GPU_PLUGINS):
        return []
    if os.environ.get("JAX_PLATFORMS", "").startswith("cpu"):
        return []
    chosen = os.environ.get("CUDA_VISIBLE_DEVICES")
    if chosen is not None:
        return [name for name in chosen.split(",") if name.strip() not in ("", "-1")]
    found = Path("/dev").glob("nvidia[0-9]*")
    return sorted(path.name.removeprefix("nvidia") for path in found)
