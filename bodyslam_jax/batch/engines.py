"""Makes the engine that settings name, and prepares its processes."""

import dataclasses
import functools
import logging
import os
from typing import Any

from bodyslam_jax.batch import program_cache
from bodyslam_jax.batch.engine import Engine, Setup
from bodyslam_jax.config import Distribution

_JAX_OPTIONS = (
    "jax_enable_x64",
    "jax_platforms",
    "jax_compilation_cache_dir",
    "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)


def make_engine(distribution: Distribution, folder: Any, gpu: bool) -> Engine:
    """Returns the engine that the settings name.

    Args:
        folder: folder for the engine's own files, accessible from all machines.
        gpu: whether GPUs are used if there are any.
    """
    if distribution.engine == "ray":
        from bodyslam_jax.batch.ray_engine import RayEngine

        return RayEngine(
            distribution.workers, distribution.retries, distribution.ray_address, gpu
        )
    if distribution.engine == "slurm":
        from bodyslam_jax.batch.slurm_engine import SlurmEngine

        return SlurmEngine(
            folder,
            distribution.workers,
            distribution.retries,
            distribution.slurm_minutes,
            distribution.slurm_parameters(),
        )
    from bodyslam_jax.batch.local_engine import LocalEngine

    return LocalEngine(distribution.workers, distribution.retries, gpu)


@dataclasses.dataclass(frozen=True)
class CallersJax:
    """A `Setup` that configures JAX as in the process that called `read`."""

    settings: dict[str, Any]

    @classmethod
    def read(cls, device: str | None = None) -> "CallersJax":
        """Reads JAX's configuration of this process, for processes that compute on
        `device`."""
        import jax

        found = {name: getattr(jax.config, name) for name in _JAX_OPTIONS}
        if not found["jax_compilation_cache_dir"]:
            found["jax_compilation_cache_dir"] = str(program_cache.user_folder())
            found["jax_persistent_cache_min_compile_time_secs"] = 0.0
        if device == "cpu":
            found["jax_platforms"] = "cpu"
        return cls(found)

    def __call__(self) -> None:
        import jax

        for name, value in self.settings.items():
            jax.config.update(name, value)


def prepared(settings: Setup, each_core_a_device: bool = False) -> Setup:
    """Returns a `Setup` that configures JAX and the cache that processes share.

    Args:
        each_core_a_device: whether mapped solves use all cores that the process has.
    """
    return functools.partial(_prepare, settings, each_core_a_device)


def _prepare(settings: Setup, each_core_a_device: bool) -> None:
    logging.getLogger("bodyslam_jax").setLevel(logging.INFO)
    settings()
    program_cache.share()
    threads = int(os.environ.get("NPROC", "1"))
    if each_core_a_device and threads > 1:
        import jax

        jax.config.update("jax_num_cpu_devices", threads)
