"""Cameras, people and map in metres from one moving camera, in JAX.

`docs/toolkit.md` shows these names in use. They are imported on first use, so that
`bodyslam --help` and tools that only read the version do not wait for JAX.
"""

import importlib
import os
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# Small blocks are factorised here. OpenBLAS, loaded with the first of them, has threads
# that wait by spinning: ten times slower where other programs run.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

if TYPE_CHECKING:
    from bodyslam_jax.batch import run_many as run_many
    from bodyslam_jax.body import BodyModel as BodyModel
    from bodyslam_jax.body import load_body_model as load_body_model
    from bodyslam_jax.config import Config as Config
    from bodyslam_jax.evaluation import evaluate as evaluate
    from bodyslam_jax.evaluation import stack_pairs as stack_pairs
    from bodyslam_jax.graph import FrameFactor as FrameFactor
    from bodyslam_jax.graph import Problem as Problem
    from bodyslam_jax.graph import State as State
    from bodyslam_jax.graph import Variable as Variable
    from bodyslam_jax.graph import check_factor as check_factor
    from bodyslam_jax.graph import rescaled as rescaled
    from bodyslam_jax.graph import weights as weights
    from bodyslam_jax.graph import with_weights as with_weights
    from bodyslam_jax.io import read_sequence as read_sequence
    from bodyslam_jax.motion import MotionModel as MotionModel
    from bodyslam_jax.motion import load_motion_model as load_motion_model
    from bodyslam_jax.online import Online as Online
    from bodyslam_jax.pipeline import run as run
    from bodyslam_jax.pipeline.case import build as build
    from bodyslam_jax.pipeline.case import simulate_case as simulate_case
    from bodyslam_jax.pipeline.case import stack_cases as stack_cases
    from bodyslam_jax.solver import quick_options as quick_options
    from bodyslam_jax.solver import solve as solve
    from bodyslam_jax.solver import vmap_over_devices as vmap_over_devices
    from bodyslam_jax.types import Result as Result
    from bodyslam_jax.types import Sequence as Sequence

_HOME = {
    "BodyModel": "body",
    "Config": "config",
    "FrameFactor": "graph",
    "MotionModel": "motion",
    "Online": "online",
    "Problem": "graph",
    "Result": "types",
    "Sequence": "types",
    "State": "graph",
    "Variable": "graph",
    "build": "pipeline.case",
    "check_factor": "graph",
    "evaluate": "evaluation",
    "load_body_model": "body",
    "load_motion_model": "motion",
    "quick_options": "solver",
    "read_sequence": "io",
    "rescaled": "graph",
    "run": "pipeline",
    "run_many": "batch",
    "simulate_case": "pipeline.case",
    "solve": "solver",
    "stack_cases": "pipeline.case",
    "stack_pairs": "evaluation",
    "vmap_over_devices": "solver",
    "weights": "graph",
    "with_weights": "graph",
}
__all__ = sorted(_HOME)  # pyright: ignore[reportUnsupportedDunderAll]


def _export(*args: Any, **more: Any) -> Any:
    from bodyslam_jax.export.formats import export

    return export(*args, **more)


def _view(*args: Any, **more: Any) -> Any:
    from bodyslam_jax.view import notebook_scene

    return notebook_scene(*args, **more)


USES_OF_RESULTS = {"export": _export, "view": _view}
"""Functions behind the methods of `Result`, whose module is below those that write and
show a result."""


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'bodyslam_jax' has no attribute {name!r}")
    return getattr(importlib.import_module(f"bodyslam_jax.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
