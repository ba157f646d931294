"""Logs the durations of stages and the progress within them.

The records carry their figures as attributes (`stage`, `done`, `total`, `seconds`,
`compile_seconds`, `peak_mb`) beside the text, so that a handler can draw a bar or write
JSON without parsing messages.
"""

import contextlib
import functools
import logging
import sys
import time
from collections.abc import Iterator

import jax

log = logging.getLogger(__name__)

_LINE_INTERVAL_S = 5.0
_UPDATE_INTERVAL_S = 0.2
_COMPILATION_EVENTS = (
    "/jax/core/compile/jaxpr_to_mlir_module_duration",
    "/jax/core/compile/backend_compile_duration",
)
"""JAX's monitoring events of lowering and of XLA (or of reading its cached result)."""
_MIN_COMPILATION_S = 1.0
"""Time of compilation below which the log line of a stage does not mention it, s."""


class Stopwatch:
    """Measures the seconds of each stage, and logs a line at its start and its end."""

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
            text if compiling >= _MIN_COMPILATION_S else "",
            extra=figures,
        )


class Counter:
    """Reports how many frames of a stage are done: by a log line every few seconds, and
    by DEBUG records in between, from which a handler can draw a bar."""

    def __init__(self, stage: str, total: int) -> None:
        self.stage, self.total = stage, total
        self._last_line = self._last_update = time.perf_counter()

    def __call__(self, done: int) -> None:
        now = time.perf_counter()
        is_line = now - self._last_line > _LINE_INTERVAL_S
        if now - self._last_update < _UPDATE_INTERVAL_S and done < self.total:
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
    """Returns a list of one number, to which JAX's events add: the seconds that this
    process has spent on compilation since the first call."""
    clock = [0.0]

    def add(event: str, duration_secs: float, **_: object) -> None:
        if event in _COMPILATION_EVENTS:
            clock[0] += duration_secs

    jax.monitoring.register_event_duration_secs_listener(add)
    return clock


def _peak_mb() -> int | None:
    """Returns the peak memory of this process, MB; `None` if the system does not report
    it."""
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (1e6 if sys.platform == "darwin" else 1e3))
