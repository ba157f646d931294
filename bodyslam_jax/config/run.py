"""Settings of a whole run, with one class per stage, limits of its inputs, and the
engine that runs many.
"""

import dataclasses
from typing import Literal

from bodyslam_jax.config.errors import NOT_NEGATIVE, InputError, check
from bodyslam_jax.config.front_end import (
    Association,
    Detect,
    PeopleFit,
    Structure,
    Tracking,
)
from bodyslam_jax.config.known import RANGES, Known
from bodyslam_jax.config.weights import GraphWeights

_GIGABYTE = 1_000_000_000
"""Bytes."""


@dataclasses.dataclass(frozen=True)
class Limits:
    """Upper bounds for one input, which is rejected unread if it exceeds them."""

    input_gigabytes: float = 1.0
    """Size of a file, and of what it expands to, GB. Videos are exempt: they are read
    frame by frame."""
    frames: int = 100_000
    """Number of frames of inputs without a video, which only numbers in a file tell."""

    def __post_init__(self) -> None:
        check(self, {"input_gigabytes": (0.001, 1000.0), "frames": (1, 100_000_000)})

    @property
    def bytes(self) -> int:
        """The limit `input_gigabytes` in bytes."""
        return round(self.input_gigabytes * _GIGABYTE)


@dataclasses.dataclass(frozen=True)
class Config(Known):
    """Settings of a whole run, one class per stage."""

    body_model: str | None = None
    """Body model file or folder. Without it, the body model found on this machine or
    that of the package (`bodyslam doctor`)."""
    motion_model: str | None = None
    """Motion model: a weights file, or `paper` for the paper's network. Without it, the
    default model; both are in the package."""
    people: bool = True
    """Whether people are estimated. Without them cameras and map have no metric
    scale."""
    detect: Literal["auto", "built-in", "yolox", "none"] = "auto"
    """Networks that detect people if no keypoints are given: `built-in` (also `auto`)
    are in the package, `yolox` (YOLOX and RTMPose) are downloaded once."""
    offline: bool = False
    """Whether downloads are forbidden; networks must then be present already."""
    device: Literal["cpu", "gpu"] | None = None
    """Device for computations. Without it JAX's default: a GPU if there is one."""
    overlay: bool = True
    """Whether `overlay.webm` is written."""
    overlay_video: Literal["webm", "mp4"] = "webm"
    """Format of the overlay: `webm` (VP8), or `mp4` (H.264, smaller), which needs the
    extra `video`."""
    overlay_measurements: bool = False
    """Whether the overlay also shows measurements: tracked points of the scene, and
    keypoints beside those of the bodies."""
    uncertainty: bool = True
    """Whether standard deviations and unobservable directions are computed."""
    detection: Detect = Detect()
    association: Association = Association()
    tracking: Tracking = Tracking()
    structure: Structure = Structure()
    people_fit: PeopleFit = PeopleFit()
    weights: GraphWeights = GraphWeights()
    solver: Literal["structured", "adam", "optimistix_lm", "jaxopt_lm"] = "structured"
    """Solver: structured Levenberg-Marquardt; the paper's 200 + 100 steps of Adam; or
    dense Levenberg-Marquardt of optimistix or jaxopt, for small problems."""
    motion_coupling: Literal["frozen", "refreshed"] = "refreshed"
    """When motion is predicted: once, before the joint solve, or again after each
    accepted step. No derivative of the prediction enters the solve."""
    smoothing_hz: float | None = 6.0
    """Cut-off frequency above which the motion of regressed bodies is smoothed as noise
    in the result, Hz. Without it, nothing is smoothed; bodies that are fitted to
    keypoints never are."""
    limits: Limits = Limits()

    def __post_init__(self):
        check(self, RANGES)
        self.check_known()

    @classmethod
    def paper(cls) -> "Config":
        """Returns the settings of sections 3.4 and 3.6 of the paper: its weights, its
        motion network, whose predictions are constant measurements, and its first-order
        schedule. See docs/differences_from_the_paper.md for remaining differences."""
        return cls(
            motion_model="paper",
            motion_coupling="frozen",
            weights=GraphWeights.paper(),
            people_fit=PeopleFit(regressor_shape_gain=1.0),
            solver="adam",
            smoothing_hz=None,
        )

    def for_simulated_people(self) -> "Config":
        """Returns the settings with networks that have not been trained on the people
        whose motion simulated people have, for errors against their truth."""
        fit = dataclasses.replace(self.people_fit, lifter="held-out")
        return dataclasses.replace(self, people_fit=fit)


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
