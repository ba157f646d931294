"""Locks a run folder, so that only one run at a time writes it.

The lock is a file, `.lock`, that names the process which holds it. On one machine the
operating system's lock on that file decides, so that a killed process holds nothing. On
a file system shared by several machines such locks may be invisible to the others:
there the holder touches the file every `RENEWAL_PERIOD_S`, and a file that does not
change while another process watches it for `STALE_AFTER_S` is abandoned. Its date is
not compared with any clock: clocks of machines and file servers differ, and a date can
be in the future.
"""

import contextlib
import errno
import json
import logging
import os
import socket
import stat
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bodyslam_jax.config.errors import InputError

try:
    import fcntl
except ImportError:  # Windows: content and changes of the file decide
    fcntl = None

log = logging.getLogger(__name__)
_LOCK_FILE = ".lock"
RENEWAL_PERIOD_S = 10.0
"""Period after which the holder touches the file."""
STALE_AFTER_S = 3 * RENEWAL_PERIOD_S
"""Time after which an unchanged file of another machine is abandoned."""
_POLL_PERIOD_S = 0.5
"""Period at which a file that may be abandoned is checked."""
_MAX_OWNER_BYTES = 4096
"""Number of bytes of a lock file that are read; a host name has at most 255."""
_UNSUPPORTED = {errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL}


class FolderInUse(InputError):
    """Raised if another process is writing the run folder."""


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Holds the run folder for this process. A folder that was created for this and
    stays empty is removed afterwards.

    A lock of a process on another machine is watched for `STALE_AFTER_S` seconds first.

    **Raises:** `FolderInUse`, one line that names folder, process and machine, if
    another process holds it; `InputError` if `.lock` is no file.
    """
    existed = folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / _LOCK_FILE
    file = _acquire(path)
    done = threading.Event()
    renewal = threading.Thread(target=_renew, args=(path, done), daemon=True)
    renewal.start()
    try:
        yield
    finally:
        done.set()
        with contextlib.suppress(OSError):
            path.unlink()
        os.close(file)
        if not existed:
            with contextlib.suppress(OSError):
                folder.rmdir()


def _acquire(path: Path) -> int:
    """Returns the open lock file, with this process as its owner."""
    while True:
        file = _open(path, os.O_RDWR | os.O_CREAT)
        try:
            if (is_granted := _lock(file)) is False:
                raise _held(path, _owner(file))
            if not _is_still(path, file):
                os.close(file)  # its holder has just released and removed it
                continue
            owner = _owner(file)
            if owner is not None and _may_hold(owner, is_granted):
                if _changes(path, file, owner):
                    raise _held(path, owner)
                if not _is_still(path, file):
                    os.close(file)
                    continue
            text = json.dumps({"host": socket.gethostname(), "pid": os.getpid()})
            os.ftruncate(file, 0)
            os.pwrite(file, text.encode(), 0)
            os.utime(path)
            return file
        except BaseException:
            with contextlib.suppress(OSError):
                os.close(file)
            raise


def _open(path: Path, flags: int) -> int:
    """Opens a lock file; a symbolic link of this name is not followed."""
    flags |= getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    try:
        # Permissions are what the umask leaves of these.
        file = os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EISDIR, errno.ENXIO):
            raise _no_file(path) from None
        raise
    if not stat.S_ISREG(os.fstat(file).st_mode):
        os.close(file)
        raise _no_file(path)
    return file


def _no_file(path: Path) -> InputError:
    return InputError(f"{path}: not a file, expected the lock of a run; delete it.")


def _lock(file: int) -> bool | None:
    """Returns whether the system grants the lock; `None` if it does not support locks
    here."""
    if fcntl is None:
        return None
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return None if error.errno in _UNSUPPORTED else False
    return True


def _is_still(path: Path, file: int) -> bool:
    """Returns whether the path still refers to the open file."""
    try:
        on_disk, held = os.stat(path), os.fstat(file)
    except FileNotFoundError:
        return False
    return (on_disk.st_ino, on_disk.st_dev) == (held.st_ino, held.st_dev)


def _may_hold(owner: dict[str, Any], is_granted: bool | None) -> bool:
    """Returns whether the process that a file names may hold it although the system
    reports no lock."""
    if owner.get("host") != socket.gethostname():
        return True
    return is_granted is None and _is_alive(owner.get("pid"))


def _changes(path: Path, file: int, owner: dict[str, Any]) -> bool:
    """Returns whether a lock file changes within `STALE_AFTER_S`; False if it is
    removed."""
    log.info(
        "%s: %s held this run; waiting up to %.0f s to see whether it still does",
        *(path.parent, _named(owner), STALE_AFTER_S),
    )
    first = _state(path)
    until = time.monotonic() + STALE_AFTER_S
    while time.monotonic() < until:
        time.sleep(min(_POLL_PERIOD_S, STALE_AFTER_S / 4))
        if not _is_still(path, file):
            return False  # released: the caller opens its successor
        if _state(path) != first:
            return True
    return False


def _state(path: Path) -> tuple[Any, ...] | None:
    """Returns the properties that change when a holder touches the file.

    The file is opened anew, which makes network file systems query their server.
    """
    try:
        file = _open(path, os.O_RDONLY)
    except OSError:
        return None
    try:
        found = os.fstat(file)
        return found.st_mtime_ns, found.st_size, os.pread(file, _MAX_OWNER_BYTES, 0)
    finally:
        os.close(file)


def _is_alive(pid: Any) -> bool:
    if not isinstance(pid, int):
        return False
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:
        return True
    return True


def _owner(file: int) -> dict[str, Any] | None:
    """Returns the process that a lock file names; `None` if it names none."""
    try:
        found = json.loads(os.pread(file, _MAX_OWNER_BYTES, 0))
    except (OSError, ValueError, RecursionError):
        return None
    return found if isinstance(found, dict) else None


def _held(path: Path, owner: dict[str, Any] | None) -> FolderInUse:
    who = "another process" if owner is None else _named(owner)
    return FolderInUse(
        f"{path.parent}: {who} is writing this run; wait for it or give another folder."
    )


def _named(owner: dict[str, Any]) -> str:
    """Returns a process as text; a file may contain anything instead of one."""
    pid, host = (str(owner.get(key))[:80] for key in ("pid", "host"))
    text = f"process {pid} on {host}"
    return "".join(letter if letter.isprintable() else "?" for letter in text)


def _renew(path: Path, done: threading.Event) -> None:
    while not done.wait(RENEWAL_PERIOD_S):
        with contextlib.suppress(OSError):
            os.utime(path)
