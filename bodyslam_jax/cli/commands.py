"""The table of all commands.

For commands with many options, the table also lists the few that `--help` shows;
`--help-all` shows all of them.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

from bodyslam_jax.cli.batch import batch, collect, sweep
from bodyslam_jax.cli.body import body_check, body_convert, body_show
from bodyslam_jax.cli.completion import completion
from bodyslam_jax.cli.datasets import emdb, rich, threedpw, tum_amass
from bodyslam_jax.cli.environment import doctor
from bodyslam_jax.cli.estimate import demo, evaluate, run
from bodyslam_jax.cli.export import export
from bodyslam_jax.cli.live import live
from bodyslam_jax.cli.make import experiment, simulate, train_motion
from bodyslam_jax.cli.view import view


@dataclasses.dataclass(frozen=True)
class Command:
    """A function of the command line."""

    function: Callable[..., Any]
    shown: frozenset[str] = frozenset()
    """Arguments and settings that `--help` lists; all if empty."""
    in_workers: bool = False
    """Whether other processes compute, so that this one must leave the GPU to them."""


def _command(
    function: Callable[..., Any], shown: str = "", in_workers: bool = False
) -> Command:
    return Command(function, frozenset(shown.split()), in_workers)


COMMANDS = {
    "run": _command(
        run,
        """input out keypoints bodies camera masks preset settings detect device
        height focal fov camera_path camera_path_metric static_camera gravity fps start
        end person open""",
    ),
    "demo": _command(demo, "out from_pixels preset settings device overlay open"),
    "live": _command(
        live,
        """source out camera page port open preset settings detect device focal fov
        gravity fps""",
    ),
    "batch": _command(
        batch,
        """inputs out shard engine workers retries ray_address slurm_minutes slurm
        preset settings detect device overlay height focal fov static_camera fps start
        end person""",
        in_workers=True,
    ),
    "collect": _command(collect, in_workers=True),
    "sweep": _command(
        sweep,
        """inputs grid out engine workers ray_address slurm_minutes slurm preset
        settings detect device height focal fov static_camera fps start end person""",
        in_workers=True,
    ),
    "evaluate": _command(evaluate),
    "export": _command(export),
    "view": _command(view),
    "simulate": _command(
        simulate,
        "out sequence family length seed motion noise people hiding render",
    ),
    "train-motion": _command(
        train_motion, "data out body_model preset network past seed epochs"
    ),
    "experiment": _command(
        experiment,
        """name out preset settings sequences family frames noise motion seed
        motion_models engine workers ray_address device overlay""",
    ),
    "convert-dataset emdb": _command(emdb),
    "convert-dataset 3dpw": _command(threedpw),
    "convert-dataset rich": _command(rich),
    "convert-dataset tum-amass": _command(tum_amass),
    "body-model show": _command(body_show),
    "body-model convert": _command(body_convert),
    "body-model check": _command(body_check),
    "doctor": _command(doctor),
    "completion": _command(completion),
}
"""All commands by name; commands of one group share the first word."""
GROUPS = {
    "body-model": "Body model files: SMPL and models of its shape, SMPL-H, SMPL-X.",
    "convert-dataset": "Sequence folders with ground truth, made from datasets.",
}
