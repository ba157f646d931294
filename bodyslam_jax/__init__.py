"""Cameras, people and map in metres from one moving camera, in JAX.

The names below are imported on first use, so that `bodyslam --help` and tools that
only read the version do not wait for JAX.
"""

import importlib
import os
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# Small blocks are factorised here. OpenBLAS, loaded with the first of them, has threads
# that wait by spinning: ten times slower where other programs run.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

if TYPE_CHECKING:
    from bodyslam_jax.body import BodyModel as BodyModel
    from bodyslam_jax.body import load_body_model as load_body_model
    from bodyslam_jax.types import Result as Result
    from bodyslam_jax.types import Sequence as Sequence

_HOME = {
    "BodyModel": "body",
    "MotionModel": "motion",
    "Problem": "graph",
    "Result": "types",
    "Sequence": "types",
    "State": "graph",
    "evaluate": "evaluation",
    "load_body_model": "body",
    "load_motion_model": "motion",
    "vmap_over_devices": "solver",
    "read_sequence": "io",
    "run": "pipeline",
    "solve": "solver",
    "stack_pairs": "evaluation",
}
__all__ = sorted(_HOME)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'bodyslam_jax' has no attribute {name!r}")
    return getattr(importlib.import_module(f"bodyslam_jax.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
