"""Runs many clips on many cores or machines: `run_many`, engines, tables of results.

A clip is a job that depends on its input and settings only. An engine (`engine.py`)
runs jobs in other processes; engines are independent of clips, and jobs of engines. The
names below are imported on first use, so that processes of an engine start quickly.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from bodyslam_jax.batch.collection import collect as collect
    from bodyslam_jax.batch.driver import run_many as run_many
    from bodyslam_jax.batch.engine import Engine as Engine
    from bodyslam_jax.batch.engine import Failure as Failure
    from bodyslam_jax.batch.engines import make_engine as make_engine
    from bodyslam_jax.batch.grid_sweep import sweep as sweep
    from bodyslam_jax.batch.inputs import Input as Input
    from bodyslam_jax.batch.inputs import find_inputs as find_inputs
    from bodyslam_jax.batch.job import Job as Job
    from bodyslam_jax.batch.job import Outcome as Outcome

_MODULES = {
    "Engine": "engine",
    "Failure": "engine",
    "Input": "inputs",
    "Job": "job",
    "Outcome": "job",
    "collect": "collection",
    "find_inputs": "inputs",
    "make_engine": "engines",
    "run_many": "driver",
    "sweep": "grid_sweep",
}
__all__ = sorted(_MODULES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'bodyslam_jax.batch' has no attribute {name!r}")
    return getattr(
        importlib.import_module(f"bodyslam_jax.batch.{_MODULES[name]}"), name
    )


def __dir__() -> list[str]:
    return list(__all__)
