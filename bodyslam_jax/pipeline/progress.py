"""Durations of stages and progress within them, through the log."""

import contextlib
import logging
import time
from collections.abc import Iterator

log = logging.getLogger(__name__)

_SECONDS_BETWEEN_LINES = 5.0


class Stopwatch:
    """Seconds by stage, and a log line at the end of each."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextlib.contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        log.info("%s ...", stage)
        start = time.perf_counter()
        yield
        self.seconds[stage] = round(time.perf_counter() - start, 2)
        log.info("%s: %.1f s", stage, self.seconds[stage])


class Counter:
    """A log line every few seconds: how many frames are done."""

    def __init__(self, name: str, total: int) -> None:
        self.name, self.total = name, total
        self._last_line = time.perf_counter()

    def __call__(self, done: int) -> None:
        now = time.perf_counter()
        if now - self._last_line > _SECONDS_BETWEEN_LINES:
            log.info("%s: frame %d of %d", self.name, done, self.total)
            self._last_line = now
