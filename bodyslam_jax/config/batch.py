"""Settings of the engine that runs the jobs of a batch."""

import dataclasses
from typing import Literal

from bodyslam_jax.config.check import NOT_NEGATIVE, check
from bodyslam_jax.config.errors import InputError


@dataclasses.dataclass(frozen=True)
class Distribution:
    """The engine that runs independent jobs, and its resources."""

    engine: Literal["local", "ray", "slurm"] = "local"
    """`local`: processes on this machine; `ray`: actors on a Ray cluster; `slurm`: job
    arrays on a SLURM cluster. The last two need the extra of that name and an output
    folder that all machines share."""
    workers: int | None = None
    """Number of simultaneous jobs. Without it: for `local` one per GPU, else one per
    core as far as memory allows; for `ray` one per GPU, else one per core of the
    cluster; for `slurm` 16 tasks."""
    retries: int = 2
    """How often a job is restarted if its process, machine or allocation is lost."""
    ray_address: str | None = None
    """Address of a running Ray cluster, HOST:PORT or `auto`. Without it, Ray is started
    on this machine."""
    slurm_minutes: int = 240
    """Time limit of each task of the array, min. A task that reaches it is requeued and
    continues."""
    slurm: tuple[str, ...] = ()
    """Parameters of submitit, NAME=VALUE: `slurm_partition=gpu gpus_per_node=1
    mem_gb=8 cpus_per_task=2`."""

    def __post_init__(self):
        check(self, {"retries": NOT_NEGATIVE})
        self.slurm_parameters()

    def slurm_parameters(self) -> dict[str, int | str]:
        """Returns `slurm` as a dictionary, with whole numbers as `int`.

        **Raises:** `InputError` for an entry without `=`.
        """
        found: dict[str, int | str] = {}
        for entry in self.slurm:
            name, sign, value = entry.partition("=")
            if not sign or not name or not value:
                raise InputError(f"slurm: found {entry!r}, expected NAME=VALUE.")
            found[name] = int(value) if value.isdigit() else value
        return found
