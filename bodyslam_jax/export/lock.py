"""One run at a time writes a run folder.

The lock is a file, `.lock`, that names the process which holds it. On one machine the
operating system's lock on that file decides, so that a killed process holds nothing.
On a file system shared by several machines such locks may be invisible to the others:
there the existence of the file decides. Its holder renews its modification time; a file
that is older than `STALE` is abandoned.
"""

import contextlib
import errno
import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from bodyslam_jax.config.errors import InputError

try:
    import fcntl
except ImportError:  # Windows: the file's content and age decide
    fcntl = None

_NAME = ".lock"
RENEWED = 10.0
"""Period after which the holder renews the file's modification time, s."""
STALE = 60.0
"""Age from which a file that is not renewed is abandoned, s."""
_UNSUPPORTED = {errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL}


class FolderInUse(InputError):
    """Another process is writing the run folder."""


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Holds the run folder for this process. A folder that was created for it and stays
    empty is removed afterwards.

    **Raises:** `FolderInUse`, one line that names folder, process and machine, if
    another process holds it.
    """
    existed = folder.exists()
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / _NAME
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
    """The open lock file, with this process as its owner."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if not _lock(file):
                raise _held(path, _owner(file))
            if not _is_still(path, file):
                os.close(file)  # its holder has just released and removed it
                continue
            owner = _owner(file)
            if owner is not None and _holds(owner, os.fstat(file).st_mtime, path):
                raise _held(path, owner)
            text = json.dumps({"host": socket.gethostname(), "pid": os.getpid()})
            os.ftruncate(file, 0)
            os.pwrite(file, text.encode(), 0)
            os.utime(path)
            return file
        except BaseException:
            with contextlib.suppress(OSError):
                os.close(file)
            raise


def _lock(file: int) -> bool:
    """Whether the system grants the lock, or does not support locks here."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        return error.errno in _UNSUPPORTED
    return True


def _is_still(path: Path, file: int) -> bool:
    """Whether the path still refers to the open file."""
    try:
        on_disk, held = os.stat(path), os.fstat(file)
    except FileNotFoundError:
        return False
    return (on_disk.st_ino, on_disk.st_dev) == (held.st_ino, held.st_dev)


def _holds(owner: dict[str, Any], renewed: float, path: Path) -> bool:
    """Whether the process that a file names may still hold it, although the system
    reports no lock."""
    if owner.get("host") == socket.gethostname():
        # A lock of the system, if supported, would have been found before.
        return fcntl is None and _is_alive(owner.get("pid")) and _is_new(renewed, path)
    return _is_new(renewed, path)


def _is_new(renewed: float, path: Path) -> bool:
    """Whether a file is not yet abandoned, by the clock of the shared file system."""
    probe = path.with_name(f"{path.name}-{os.getpid()}")
    try:
        probe.touch()
        now = probe.stat().st_mtime
    except OSError:
        now = time.time()
    finally:
        probe.unlink(missing_ok=True)
    return now - renewed < STALE


def _is_alive(pid: Any) -> bool:
    if not isinstance(pid, int):
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except OSError:
        return True
    return True


def _owner(file: int) -> dict[str, Any] | None:
    try:
        found = json.loads(os.pread(file, 4096, 0))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def _held(path: Path, owner: dict[str, Any] | None) -> FolderInUse:
    who = "another process"
    if owner is not None:
        who = f"process {owner.get('pid')} on {owner.get('host')}"
    advice = "wait for it or give another folder"
    if owner is not None and owner.get("host") != socket.gethostname():
        advice += f"; if it is no more, try again in {STALE:.0f} s"
    return FolderInUse(f"{path.parent}: {who} is writing this run; {advice}.")


def _renew(path: Path, done: threading.Event) -> None:
    while not done.wait(RENEWED):
        with contextlib.suppress(OSError):
            os.utime(path)
