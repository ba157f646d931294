"""Logs the durations of stages and the progress within them.

The records carry their figures as attributes (`stage`, `done`, `total`, `seconds`,
`compile_seconds`, `peak_mb`) beside the text, so that a handler can draw a bar or write
JSON without parsing messages.
"""

import contextlib
import functools
import importlib.metadata
import json
import logging
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import jax

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic
from bodyslam_jax.io.files import read_json

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
_TYPICAL_COMPILATION_S = {"people": 5.0, "joint": 26.0, "live": 60.0}
"""Time that the programs of a stage take to compile on two cores, before this machine
has been measured (`benchmarks/run.md`). That of `live`, which compiles the front end,
the joint estimate and covariances, is about their sum."""
_MIN_ANNOUNCED_COMPILATION_S = 4.0
"""Time of compilation from which it is announced."""
_TIMES_FILE = "compile_times.json"
"""In the folder of compiled programs: seconds by stage, size and versions."""

T = TypeVar("T")


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

    def __init__(self, stage: str, total: int = 0) -> None:
        self.stage, self.total = stage, total
        self._last_line = self._last_update = time.perf_counter()

    def __call__(self, done: int, total: int | None = None) -> None:
        """Reports `done` frames of `total`; without it, of that of the constructor."""
        self.total = total or self.total
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


def counted(items: Iterable[T], stage: str, total: int) -> Iterator[T]:
    """Yields the items, of which there are `total`, with the progress of a
    `Counter`."""
    counter = Counter(stage, total)
    for k, item in enumerate(items):
        yield item
        counter(k + 1)


@contextlib.contextmanager
def compiling(stage: str, size: str) -> Iterator[None]:
    """Announces, before the block, that the programs of a stage are compiled in it,
    unless they have been.

    Says before it how long that takes, once for a stage and `size` (the same for
    problems that share programs) on a machine: about as long as for another size of the
    stage, or as where this was measured. JAX's folder of compiled programs also has the
    record of what they took; without such a folder a process says it once.
    """
    names = ("bodyslam-jax", "jax")
    versions = ", ".join(f"{n} {importlib.metadata.version(n)}" for n in names)
    key = f"{stage}: {size}; {jax.default_backend()}, {versions}"
    known = _compile_times()
    others = [s for name, s in known.items() if name.startswith(f"{stage}: ")]
    seconds = max(others, default=0.0)
    if seconds < _MIN_ANNOUNCED_COMPILATION_S:
        seconds = _TYPICAL_COMPILATION_S[stage]
    if key not in known and seconds >= _MIN_ANNOUNCED_COMPILATION_S:
        once = ", once" if _programs() is not None else ""
        log.info("%s: compiling, about %.0f s%s", stage, seconds, once)
    clock = _compile_clock()
    before = clock[0]
    yield
    if key not in known:
        _remember(key, round(clock[0] - before, 1))


_of_process: dict[str, float] = {}
"""Compile times where no folder keeps programs."""


def _programs() -> Path | None:
    """JAX's folder of compiled programs, if there is one."""
    options: Any = jax.config  # whose class declares no options
    folder = options.jax_compilation_cache_dir
    return Path(folder) if folder else None


def _compile_times() -> dict[str, float]:
    """Seconds by key of `compiling`; nothing where the record is damaged."""
    folder = _programs()
    if folder is None:
        return _of_process
    try:
        found = read_json(folder / _TIMES_FILE)
    except InputError:
        return {}
    items = found.items() if isinstance(found, dict) else ()
    return {k: float(s) for k, s in items if isinstance(s, int | float)}


def _remember(key: str, seconds: float) -> None:
    folder = _programs()
    if folder is None:
        _of_process[key] = seconds
        return
    text = json.dumps(_compile_times() | {key: seconds}, indent=1)
    with contextlib.suppress(OSError, InputError):  # It is for a message only.
        folder.mkdir(parents=True, exist_ok=True)
        atomic.write_text(folder / _TIMES_FILE, text + "\n")


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
