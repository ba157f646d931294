"""Describes the data behind a table: noise level, and settings that are not default."""

import dataclasses
from collections.abc import Iterator
from typing import Any

from bodyslam_jax.config import Config, Experiment
from bodyslam_jax.pipeline.stage_cache import body_model_file


def about(experiment: Experiment, config: Config) -> str:
    """Returns a sentence or two on simulation and settings of the rows of an
    experiment."""
    first = f"Simulated sequences, noise level `{experiment.noise}`."
    return f"{first} {deviations(experiment, config)}".rstrip()


def deviations(experiment: Experiment, config: Config) -> str:
    """Returns text on seed, length, motion, models and settings that differ from the
    defaults.

    Settings are compared with the nearest preset. A body model that is installed on
    this machine counts as named by the user. The text is empty if nothing differs.
    """
    parts = []
    if experiment.seed is not None:
        parts.append(f"seed {experiment.seed}")
    if experiment.frames is not None:
        parts.append(f"{experiment.frames} frames each")
    if experiment.motion is not None:
        parts.append(f"motion of `{experiment.motion}`")
    body = body_model_file(config.body_model)
    config = dataclasses.replace(config, body_model=None if body is None else str(body))
    mine = dict(_flat(config))
    against = {"default": Config(), "paper": Config.paper()}
    differing = {
        preset: [f"`{k}` {mine[k]}" for k, v in _flat(theirs) if mine[k] != v]
        for preset, theirs in against.items()
    }
    preset = min(differing, key=lambda name: len(differing[name]))
    parts += [f"preset `{preset}`"] if preset != "default" else []
    parts += differing[preset]
    return f"Not as by default: {'; '.join(parts)}." if parts else ""


def _flat(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yields every setting with its name on the command line, such as
    `weights.pixel_sigma`."""
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            yield from _flat(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, value
