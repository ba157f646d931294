"""Ctrl-C ends the process at once with exit code 130.

Python raises `KeyboardInterrupt` in the main thread between two bytecodes, which lets
partial files and locks be removed. Compiled code can delay that by minutes, and the
exception is lost where Python ignores exceptions (callbacks of the garbage collector).
A second thread, woken by the signal itself, ends the process where the main thread has
not done so within `GRACE`.
"""

import contextlib
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any, NoReturn

from bodyslam_jax.cli.progress import restore_terminal

EXIT_CODE = 130
"""128 + SIGINT, as shells report a process that Ctrl-C ended."""
GRACE = 1.0
"""Time for removing partial files and locks, s."""
_MESSAGE = b"bodyslam: interrupted; the same command continues it\n"
_ARRIVED = threading.Event()


def install() -> None:
    """Handles SIGINT in this process, unless its parent had it ignored (`nohup`)."""
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        return
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    signal.set_wakeup_fd(writer.detach(), warn_on_full_buffer=False)
    threading.Thread(target=_end_after_grace, args=(reader,), daemon=True).start()
    signal.signal(signal.SIGINT, _interrupt)
    sys.unraisablehook = _ignore_interrupt


def arrived() -> bool:
    """Returns True if this process was interrupted, even where `KeyboardInterrupt` was
    lost: the import of a compiled module replaces it by an error of its own."""
    return _ARRIVED.is_set()


@contextlib.contextmanager
def deferred() -> Iterator[None]:
    """Delays `KeyboardInterrupt` to the end of the block: raised while jaxlib is being
    imported, it crashes Python."""
    handler = signal.getsignal(signal.SIGINT)
    if not callable(handler):
        yield
        return
    held = []
    signal.signal(signal.SIGINT, lambda *_: held.append(True))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
    if held:
        handler(signal.SIGINT, None)


@contextlib.contextmanager
def as_event() -> Iterator[threading.Event]:
    """Yields an event that the first Ctrl-C in the block sets, without any other
    effect; the next one is handled as outside of the block."""
    event = threading.Event()
    handler = signal.getsignal(signal.SIGINT)
    if not callable(handler):  # ignored, as by `nohup`
        yield event
        return
    wakeup = signal.set_wakeup_fd(-1)

    def restore() -> None:
        signal.signal(signal.SIGINT, handler)
        signal.set_wakeup_fd(wakeup, warn_on_full_buffer=False)

    def first(*_: object) -> None:
        event.set()
        restore()

    signal.signal(signal.SIGINT, first)
    try:
        yield event
    finally:
        if not event.is_set():
            restore()


def leave() -> NoReturn:
    """Ends the process without Python's own shutdown, which waits for threads that
    compile."""
    restore_terminal()
    os.write(2, _MESSAGE)
    os._exit(EXIT_CODE)


def _interrupt(*_: object) -> NoReturn:
    _ARRIVED.set()
    raise KeyboardInterrupt


def _end_after_grace(reader: socket.socket) -> None:
    while signal.SIGINT not in reader.recv(64):
        pass
    time.sleep(GRACE)
    leave()


def _ignore_interrupt(unraisable: Any) -> None:
    """Prints no traceback of an interrupt; `_end_after_grace` acts on it."""
    if unraisable.exc_type is not KeyboardInterrupt:
        sys.__unraisablehook__(unraisable)
