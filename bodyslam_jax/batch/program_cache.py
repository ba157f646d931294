"""Cache of compiled programs in which one process compiles and the others wait.

With JAX's persistent cache, processes that start together all compile the same
programs, and a process that is killed while it writes leaves a damaged entry. This
cache is the same folder with the same entries: a process that misses an entry holds a
lock on it until it is written, and entries are written atomically. Locks are on byte
ranges of one file, which the system releases with the process.
"""

import contextlib
import logging
import os
import threading
import time
import weakref
import zlib
from pathlib import Path
from typing import Any

from bodyslam_jax.io import atomic

try:
    import fcntl
except ImportError:  # Windows: programs may be compiled by several processes
    fcntl = None

log = logging.getLogger(__name__)
_LOCK_FILE = ".compiling"
_COMPILED_EVENT = "/jax/core/compile/backend_compile_duration"
_MISS_EVENT = "/jax/compilation_cache/cache_misses"
_MAX_WAIT_S = 900.0
"""Time after which a program is compiled although another process is compiling it."""
_LOCK_RANGE_BYTES = 1 << 60


def user_folder() -> Path:
    """Returns the folder of compiled programs that all runs of this user share."""
    home = os.environ.get("BODYSLAM_CACHE") or Path(
        os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "bodyslam_jax"
    )
    return Path(home) / "compiled"


class Compilations:
    """Counts the programs that this process compiled, excluding those that it
    loaded."""

    def __init__(self) -> None:
        import jax

        self.count = 0
        jax.monitoring.register_event_listener(self._on_event)

    def _on_event(self, event: str, **_: object) -> None:
        self.count += event == _MISS_EVENT


class ProgramCache:
    """JAX's persistent cache in `path`, with a lock on each missing entry.

    The interface is that of JAX's own caches: `get` a key, and after a miss `put`.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        self._path.mkdir(parents=True, exist_ok=True)
        self._lock_file = os.open(
            # Permissions are what the umask leaves of these.
            self._path / _LOCK_FILE,
            os.O_RDWR | os.O_CREAT,
            0o666,
        )
        weakref.finalize(self, os.close, self._lock_file)
        self._held: dict[str, int] = {}
        """Keys whose lock this process has, and the thread that compiles them."""

    def get(self, key: str) -> bytes | None:
        """Returns the program of a key; `None` if this process has to compile it."""
        self.release()
        found = self._read(key)
        if found is None:
            self._wait_for(key)
            found = self._read(key)
            if found is not None:
                self._unlock(key)
        return found

    def put(self, key: str, value: bytes) -> None:
        # Existing entries are replaced: JAX compiles programs that it cannot read.
        """Stores the program of a key, and releases its lock."""
        try:
            atomic.write_bytes(self._file(key), value)
        finally:
            self._unlock(key)

    def release(self) -> None:
        """Releases the locks of programs that this thread compiled and did not
        store."""
        me = threading.get_ident()
        for key in [key for key, thread in self._held.items() if thread == me]:
            self._unlock(key)

    def _file(self, key: str) -> Path:
        return self._path / f"{key}-cache"

    def _read(self, key: str) -> bytes | None:
        try:
            return self._file(key).read_bytes()
        except FileNotFoundError:
            return None

    def _wait_for(self, key: str) -> None:
        """Acquires the lock of a key, unless locks are not supported or the wait is too
        long."""
        self._held[key] = threading.get_ident()
        until = time.monotonic() + _MAX_WAIT_S
        pause = 0.02
        while fcntl is not None and time.monotonic() < until:
            try:
                fcntl.lockf(
                    self._lock_file, fcntl.LOCK_EX | fcntl.LOCK_NB, 1, _place(key)
                )
                return
            except (BlockingIOError, PermissionError):
                time.sleep(pause)
                pause = min(2 * pause, 0.5)
            except OSError:  # a file system without locks
                return

    def _unlock(self, key: str) -> None:
        if self._held.pop(key, None) is not None and fcntl is not None:
            with contextlib.suppress(OSError):
                fcntl.lockf(self._lock_file, fcntl.LOCK_UN, 1, _place(key))


def _place(key: str) -> int:
    """Returns the byte of the lock file that represents a key, which ends in its
    hash."""
    text = key.encode()
    # 32 bits above 28 are the 60 of the range.
    return (zlib.crc32(text) << 28 | zlib.adler32(text) >> 4) % _LOCK_RANGE_BYTES


def share() -> None:
    """Makes JAX use `ProgramCache` in this process, in its folder of compiled programs.

    Does nothing if JAX has no such folder, or limits its size. JAX has no public way to
    replace its cache; with a version whose internal names differ, JAX's own cache is
    kept.
    """
    import jax

    options: Any = jax.config  # whose class declares no options
    limit = options.jax_compilation_cache_max_size
    if not options.jax_compilation_cache_dir or limit != -1:
        return
    try:
        from jax._src import compilation_cache as inner

        reset, make = inner.reset_cache, inner.get_file_cache
    except (ImportError, AttributeError):
        log.warning("this version of JAX may compile a program in several processes")
        return
    if getattr(make, "is_shared", False):
        return
    caches: list[ProgramCache] = []

    def shared(path: str) -> tuple[Any, str]:
        caches.append(ProgramCache(path))
        return caches[-1], path

    def on_compiled(event: str, duration_secs: float, **_: str | int) -> None:
        if event == _COMPILED_EVENT:
            for cache in caches:
                cache.release()

    shared.is_shared = True  # pyright: ignore[reportFunctionMemberAccess]
    reset()
    inner.get_file_cache = shared
    jax.monitoring.register_event_duration_secs_listener(on_compiled)
