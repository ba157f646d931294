"""Processes on this machine: each runs one item at a time and keeps its programs.

A process that ends by itself is replaced and its item given to another. Processes end
with the driver, however that ends.
"""

import collections
import contextlib
import dataclasses
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any

from bodyslam_jax.batch.devices import cores, gpus, memory
from bodyslam_jax.batch.engine import Failure, Setup, Values, attempt
from bodyslam_jax.config.errors import InputError

MEMORY = 3 << 30
"""Memory that a process may need, bytes; measured in benchmarks/batch.md."""
_SPAWN = multiprocessing.get_context("spawn")


@dataclasses.dataclass(frozen=True)
class LocalEngine:
    """`Engine` of processes on this machine."""

    workers: int | None = None
    """Without it one per GPU, else one per core as far as memory allows."""
    retries: int = 2
    gpu: bool = True
    """Whether GPUs are used where there are any."""

    def map(
        self, function: Callable[[Any], Any], items: Sequence[Any], setup: Setup
    ) -> Values:
        """As `Engine.map`."""
        devices = gpus() if self.gpu else []
        most = len(devices) or max(1, min(len(cores()), memory() // MEMORY))
        count = min(self.workers or most, len(items))
        threads = max(1, len(cores()) // max(count, 1))
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
    """A worker's process has ended; the text says how."""


class _Worker:
    """A process and what it is doing; started with its first item."""

    def __init__(
        self,
        environment: Mapping[str, str],
        function: Callable[[Any], Any],
        setup: Setup,
    ) -> None:
        self.connection, theirs = _SPAWN.Pipe()
        self._theirs: Connection | None = theirs
        self.process = _SPAWN.Process(
            target=_work, args=(theirs, dict(environment), function, setup), daemon=True
        )
        self.item: Any = None
        self.attempts = 0
        self.busy = False

    def start(self, item: Any, attempts: int) -> None:
        self.item, self.attempts, self.busy = item, attempts, True
        if self._theirs is not None:
            self.process.start()
            self._theirs.close()
            self._theirs = None
        with contextlib.suppress(OSError):  # It has ended: `receive` finds out.
            self.connection.send(item)

    def receive(self) -> Any:
        """The value of the item.

        **Raises:** `_Ended` if the process is no more; `ValueError` if it could not be
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
        """Lets the process end; one that is busy is terminated."""
        self.connection.close()
        if self.busy:
            self.process.terminate()

    def join(self) -> None:
        if self.process.pid is not None:
            self.process.join(_GRACE)
            if self.process.is_alive():
                self.process.kill()


_GRACE = 2.0
"""Time that an idle process has to end, s."""


def _describe(code: int | None) -> str:
    if code is not None and code < 0:
        name = signal.Signals(-code).name
        hint = " (out of memory?)" if -code == signal.SIGKILL else ""
        return f"the process was ended by {name}{hint}"
    return f"the process ended with code {code}"


def _environment(threads: int, devices: Sequence[str], number: int) -> dict[str, str]:
    """Variables that give a process its share of the machine.

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
    """A worker's process: items in, values out, until the driver closes."""
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
        # Closed or interrupted: the driver decides what becomes of the item.
        pass


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
