"""Durations of stages and progress within them, through the log.

The records carry their figures as attributes (`stage`, `done`, `total`, `seconds`,
`compile_seconds`, `peak_mb`) beside the text, so that a handler can draw a bar or write
JSON without reading messages.
"""

import contextlib
import functools
import logging
import sys
import time
from collections.abc import Iterator

import jax

log = logging.getLogger(__name__)

_SECONDS_BETWEEN_LINES = 5.0
_SECONDS_BETWEEN_UPDATES = 0.2
_COMPILING = (
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",
)
"""JAX's events for lowering and for XLA (or reading XLA's result from the cache)."""
_LEAST_COMPILING = 1.0
"""Seconds of compilation below which a stage's line leaves them out."""


class Stopwatch:
    """Seconds by stage, and a log line at the start and at the end of each."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextlib.contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        log.info("%s ...", stage, extra={"stage": stage})
        compiled = _compile_clock()
        start, before = time.perf_counter(), compiled[0]
        yield
        self.seconds[stage] = round(time.perf_counter() - start, 2)
        compiling = round(compiled[0] - before, 2)
        figures = {
            "stage": stage,
            "seconds": self.seconds[stage],
            "compile_seconds": compiling,
            "peak_mb": _peak_mb(),
        }
        text = f", {compiling:.1f} s of it compiling"
        log.info(
            "%s: %.1f s%s",
            stage,
            self.seconds[stage],
            text if compiling >= _LEAST_COMPILING else "",
            extra=figures,
        )


class Counter:
    """How many frames of a stage are done: a log line every few seconds, and records of
    level DEBUG in between for whoever draws a bar."""

    def __init__(self, stage: str, total: int) -> None:
        self.stage, self.total = stage, total
        self._last_line = self._last_update = time.perf_counter()

    def __call__(self, done: int) -> None:
        now = time.perf_counter()
        is_line = now - self._last_line > _SECONDS_BETWEEN_LINES
        if now - self._last_update < _SECONDS_BETWEEN_UPDATES and done < self.total:
            return
        log.log(
            logging.INFO if is_line else logging.DEBUG,
            "%s: frame %d of %d",
            *(self.stage, done, self.total),
            extra={"stage": self.stage, "done": done, "total": self.total},
        )
        self._last_update = now
        self._last_line = now if is_line else self._last_line


@functools.cache
def _compile_clock() -> list[float]:
    """The seconds that this process has spent on compiling since the first call, in a
    list of one number that JAX's events add to."""
    clock = [0.0]

    def add(event: str, duration_secs: float, **_: object) -> None:
        if event in _COMPILING:
            clock[0] += duration_secs

    jax.monitoring.register_event_duration_secs_listener(add)
    return clock


def _peak_mb() -> int | None:
    """The largest memory that this process has had, MB; `None` where it is not
    counted."""
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (1e6 if sys.platform == "darwin" else 1e3))
