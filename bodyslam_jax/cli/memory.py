"""Freed memory is returned to the system, where the C library is glibc.

glibc keeps freed memory for later allocations: hundreds of megabytes in small pieces
after each compilation, and arrays up to 32 MB. A long video would need
twice the memory.
"""

import ctypes
import platform

_COMPILATION_EVENT = "/jax/core/compile/backend_compile_duration"
_MIN_COMPILATION_S = 0.5
"""Compilations shorter than this free little memory, s."""
_MMAP_THRESHOLD = -3
"""`M_MMAP_THRESHOLD` of `malloc.h`."""
_MIN_MMAP_BYTES = 1 << 20
"""Size from which arrays have pages of their own, bytes."""


def return_memory() -> None:
    """Returns arrays when they are freed, and memory of compilations after each."""
    if platform.libc_ver()[0] != "glibc":
        return
    import jax

    library = ctypes.CDLL(None)
    library.mallopt(_MMAP_THRESHOLD, _MIN_MMAP_BYTES)

    def trim(event: str, duration_secs: float, **_: object) -> None:
        if event == _COMPILATION_EVENT and duration_secs > _MIN_COMPILATION_S:
            library.malloc_trim(0)

    jax.monitoring.register_event_duration_secs_listener(trim)
