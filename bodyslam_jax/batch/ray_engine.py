"""Engine of actors on a Ray cluster, one per GPU or core, which Ray places and
restarts.

An actor keeps its compiled programs from item to item. An actor whose process or node
is lost is restarted by Ray where resources are free; its item goes to the next idle
actor.
"""

import collections
import dataclasses
import os
from collections.abc import Callable, Sequence
from typing import Any

from bodyslam_jax.batch.engine import Failure, Setup, Values, attempt
from bodyslam_jax.config.errors import InputError

_PREPARATION = object()
"""Takes the place of an item while an actor is being prepared."""


@dataclasses.dataclass(frozen=True)
class RayEngine:
    """Engine on a Ray cluster."""

    workers: int | None = None
    """Number of actors; by default one per GPU, else one per core of the cluster."""
    retries: int = 2
    address: str | None = None
    """Address of a running cluster; by default Ray is started on this machine."""
    gpu: bool = True
    """Whether actors use GPUs, if the cluster has any."""

    def map(
        self, function: Callable[[Any], Any], items: Sequence[Any], setup: Setup
    ) -> Values:
        """Implements `Engine.map`."""
        ray = _import_ray()
        started = not ray.is_initialized()
        if started:
            try:
                ray.init(
                    address=self.address, log_to_driver=False, logging_level="ERROR"
                )
            except ConnectionError as error:
                raise InputError(f"--ray-address {self.address}: {error}") from None
        try:
            yield from self._map(ray, function, items, setup)
        finally:
            if started:
                ray.shutdown()

    def _map(
        self,
        ray: Any,
        function: Callable[[Any], Any],
        items: Sequence[Any],
        setup: Setup,
    ) -> Values:
        make = self._actor_class(ray)
        count = min(self.workers or _devices(ray, self.gpu), len(items))
        actors = [make.remote(function, setup) for _ in range(count)]
        calls = {actor.prepare.remote(): (actor, _PREPARATION, 0) for actor in actors}
        waiting = collections.deque((item, 0) for item in items)
        idle: list[Any] = []
        left = len(items)
        try:
            while left:
                while idle and waiting:
                    (item, attempts), actor = waiting.popleft(), idle.pop()
                    calls[actor.call.remote(item)] = (actor, item, attempts)
                (reference,), _ = ray.wait(list(calls), num_returns=1)
                actor, item, attempts = calls.pop(reference)
                try:
                    value = ray.get(reference)
                    idle.append(actor)
                except ray.exceptions.RayTaskError as error:
                    if item is _PREPARATION:
                        raise InputError(str(error.cause)) from None
                    value = Failure(" ".join(str(error.cause).split()))
                    idle.append(actor)
                except ray.exceptions.RayError as error:
                    # The actor is used again when Ray has restarted it.
                    calls[actor.prepare.remote()] = (actor, _PREPARATION, 0)
                    if item is _PREPARATION:
                        continue
                    if attempts < self.retries:
                        waiting.appendleft((item, attempts + 1))
                        continue
                    lost = f"its process was lost ({type(error).__name__})"
                    value = Failure(f"{lost}, {attempts + 1} times.")
                if item is not _PREPARATION:
                    left -= 1
                    yield item, value
        finally:
            for actor in actors:
                ray.kill(actor)

    def _actor_class(self, ray: Any) -> Any:
        gpus = 1 if self.gpu and ray.cluster_resources().get("GPU") else 0
        return ray.remote(
            num_cpus=1, num_gpus=gpus, max_restarts=-1, max_task_retries=0
        )(_Actor)


class _Actor:
    """A process of the cluster that evaluates the function."""

    def __init__(self, function: Callable[[Any], Any], setup: Setup) -> None:
        self.function, self.setup = function, setup
        self.is_prepared = False

    def prepare(self) -> None:
        """Calls the setup once. It is not part of `__init__`, after whose errors Ray
        would not restart an actor."""
        if not self.is_prepared:
            self.setup()
            self.is_prepared = True

    def call(self, item: Any) -> Any:
        """Returns the function's value for an item, or a `Failure`."""
        self.prepare()
        return attempt(self.function, item)


def _devices(ray: Any, gpu: bool) -> int:
    resources = ray.cluster_resources()
    gpus = int(resources.get("GPU", 0)) if gpu else 0
    return max(1, gpus or int(resources.get("CPU", 1)))


def _import_ray() -> Any:
    # Ray's usage reports are disabled unless the user enables them.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise InputError(
            "--engine ray: Ray is not installed; pip install 'bodyslam-jax[ray]'."
        ) from None
    return ray
