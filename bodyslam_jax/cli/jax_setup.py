"""Sets up JAX for the command line: 64 bit, cache of programs, device, memory."""

import ctypes
import gc
import importlib.metadata
import logging
import os
import platform

from bodyslam_jax.batch.program_cache import user_folder
from bodyslam_jax.cli import interrupts
from bodyslam_jax.config.errors import InputError

_COLLECT_AFTER = 50_000
"""New objects between two collections of reference cycles. Tracing makes millions of
objects that stay alive: Python's 700 costs a tenth of tracing time."""
_COMPILATION_EVENT = "/jax/core/compile/backend_compile_duration"
_MIN_COMPILATION_S = 0.5
"""Compilations shorter than this free little memory, s."""
_MMAP_THRESHOLD = -3
"""`M_MMAP_THRESHOLD` of `malloc.h`."""
_MIN_MMAP_BYTES = 1 << 20
"""Size from which arrays have pages of their own, bytes."""


def prepare(device: str | None) -> None:
    """Imports JAX with double precision and the persistent compilation cache.

    Args:
        device: `cpu`, `gpu`, or `None` for JAX's default device.

    **Raises:** `InputError` if a GPU is requested and JAX finds none.
    """
    set_compiler_flags()
    with interrupts.deferred():
        import jax
        import jax.numpy

    # After the import: JAX passes the level that it finds at import on to XLA.
    logging.getLogger("jax").setLevel(logging.WARNING)
    gc.set_threshold(_COLLECT_AFTER)
    return_memory()
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_compilation_cache_dir", str(user_folder()))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
    _choose_device(device)


def set_compiler_flags() -> None:
    """Selects XLA's older code generator for CPUs, which compiles a third faster and
    runs as fast, for the jaxlib versions known to have it: XLA aborts on an unknown
    flag. Silences XLA's alarms about slow compilation; errors are raised as well."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    flag = "--xla_cpu_use_fusion_emitters"
    given = os.environ.get("XLA_FLAGS", "")
    if importlib.metadata.version("jaxlib").startswith("0.10.") and flag not in given:
        os.environ["XLA_FLAGS"] = f"{given} {flag}=false".strip()


def return_memory() -> None:
    """Returns freed memory to the system, where the C library is glibc.

    glibc keeps it for later allocations: hundreds of megabytes in small pieces after
    each compilation, and arrays up to 32 MB. A long video would need twice the memory.
    """
    if platform.libc_ver()[0] != "glibc":
        return
    import jax

    library = ctypes.CDLL(None)
    library.mallopt(_MMAP_THRESHOLD, _MIN_MMAP_BYTES)

    def trim(event: str, duration_secs: float, **_: object) -> None:
        if event == _COMPILATION_EVENT and duration_secs > _MIN_COMPILATION_S:
            library.malloc_trim(0)

    jax.monitoring.register_event_duration_secs_listener(trim)


def _choose_device(device: str | None) -> None:
    import jax

    if device == "cpu":
        jax.config.update("jax_platforms", "cpu")
    if device == "gpu":
        try:
            jax.config.update("jax_default_device", jax.devices("gpu")[0])
        except RuntimeError:
            raise InputError(
                "--device gpu: JAX finds no GPU; install its build for one "
                "(pip install 'jax[cuda13]'), or leave the option out."
            ) from None
