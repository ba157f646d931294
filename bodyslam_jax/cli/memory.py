"""Memory that is done with goes back to the system, where the C library is GNU's.

It keeps what is freed for later: hundreds of megabytes for each program compiled, in
small pieces, and arrays up to 32 MB. A long video's run would hold twice what it needs.
"""

import ctypes
import platform

_COMPILED = "/jax/core/compile/backend_compile_duration"
_LEAST = 0.5
"""Compilations quicker than this leave little, s."""
_MMAP_THRESHOLD = -3
"""`M_MMAP_THRESHOLD` of `malloc.h`."""
_LARGE = 1 << 20
"""Arrays from this size on have pages of their own, bytes."""


def return_memory() -> None:
    """From now on, in this process: of arrays at once, of compilations after each."""
    if platform.libc_ver()[0] != "glibc":
        return
    import jax

    library = ctypes.CDLL(None)
    library.mallopt(_MMAP_THRESHOLD, _LARGE)

    def trim(event: str, seconds: float, **_: object) -> None:
        if event == _COMPILED and seconds > _LEAST:
            library.malloc_trim(0)

    jax.monitoring.register_event_duration_secs_listener(trim)
