"""Progress as plain lines, as a bar on a terminal, or as JSON, from the package's log.

The stages know nothing of it: they log, and attach figures to their records
(`pipeline.progress`).
"""

import contextlib
import json
import logging
import os
import sys
import time
from collections.abc import Iterator
from typing import Any

_FIGURES = ("stage", "done", "total", "seconds", "compile_seconds", "peak_mb")
_SHOW_CURSOR = b"\x1b[?25h"


@contextlib.contextmanager
def handled(argv: list[str]) -> Iterator[list[str]]:
    """Sets logging up as `--quiet` and `--json-log` ask; yields the other arguments.

    Standard error gets one JSON object a line with `--json-log`; a bar if it is a
    terminal that can show one; else plain lines. `--quiet` leaves warnings and errors
    of any of them.
    """
    level = logging.WARNING if "--quiet" in argv else logging.INFO
    rest = [arg for arg in argv if arg not in ("--quiet", "--json-log")]
    package = logging.getLogger("bodyslam_jax")
    package.setLevel(level)
    with contextlib.ExitStack() as stack:
        if "--json-log" in argv:
            handler = logging.StreamHandler(sys.stderr)
            handler.setFormatter(JsonLine())
        elif level == logging.INFO and _is_terminal():
            package.setLevel(logging.DEBUG)
            handler = stack.enter_context(contextlib.closing(Bar()))
        else:
            handler = logging.StreamHandler(sys.stderr)
            handler.setFormatter(logging.Formatter("%(message)s"))
        # Other packages' debugging is not for the user of this one.
        logging.basicConfig(level=level, handlers=[handler])
        yield rest


def restore_terminal() -> None:
    """Shows the cursor again, which a bar hides; callable from a signal's thread."""
    if sys.stderr is not None and _is_terminal():
        os.write(sys.stderr.fileno(), _SHOW_CURSOR)


class JsonLine(logging.Formatter):
    """A record as one JSON object: `time` (s since 1970), `level`, `message`, and the
    figures of a stage where it has them."""

    def format(self, record: logging.LogRecord) -> str:
        entry: dict[str, Any] = {
            "time": round(record.created, 3),
            "level": record.levelname.lower(),
            "message": record.getMessage(),
        }
        found = {name: getattr(record, name, None) for name in _FIGURES}
        entry |= {name: value for name, value in found.items() if value is not None}
        return json.dumps(entry)


class Bar(logging.Handler):
    """Lines above a bar for the stage that is being computed: its frames, rate, time
    left, and how long it has taken."""

    def __init__(self) -> None:
        from rich import console, progress

        super().__init__()
        self._columns = progress
        self._console = console.Console(stderr=True, highlight=False)
        self._bar: Any = None
        self._task: Any = None
        self._total: int | None = None
        self._started = 0.0

    def emit(self, record: logging.LogRecord) -> None:
        """Draws a record's figures, and prints its text unless the bar shows it."""
        stage, done = getattr(record, "stage", None), getattr(record, "done", None)
        if done is not None:
            self._advance(done, getattr(record, "total", 0))
        elif stage is not None and getattr(record, "seconds", None) is None:
            self._begin(stage)
        else:
            if stage is not None:
                self.close_bar()
            if record.levelno >= logging.INFO:
                self._console.print(record.getMessage(), markup=False, soft_wrap=True)

    def _begin(self, stage: str) -> None:
        self.close_bar()
        columns = self._columns
        self._bar = columns.Progress(
            columns.SpinnerColumn(),
            columns.TextColumn("{task.description}", markup=False),
            columns.BarColumn(bar_width=24),
            columns.TextColumn("{task.fields[rate]}", markup=False),
            columns.TimeElapsedColumn(),
            console=self._console,
            transient=True,
            refresh_per_second=4,
        )
        self._started, self._total = time.perf_counter(), None
        self._task = self._bar.add_task(stage, total=None, rate="")
        self._bar.start()

    def _advance(self, done: int, total: int) -> None:
        if self._bar is None:
            return
        seconds = max(time.perf_counter() - self._started, 1e-3)
        rate = done / seconds
        left = (total - done) / rate if rate else 0.0
        text = f"{done} of {total} frames, {rate:.1f}/s, {left:.0f} s left"
        self._bar.update(
            self._task, completed=done, total=total, rate=text, refresh=True
        )

    def close_bar(self) -> None:
        """Takes the bar away; lines above it stay."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None

    def close(self) -> None:
        """Takes the bar away and ends the handler."""
        self.close_bar()
        super().close()


def _is_terminal() -> bool:
    return (
        sys.stderr is not None
        and sys.stderr.isatty()
        and os.environ.get("TERM", "") not in ("", "dumb")
    )
