"""What tables say they are of: the noise level, and whatever is not as by default."""

import dataclasses
from collections.abc import Iterator
from typing import Any

from bodyslam_jax.config import Config, Experiment
from bodyslam_jax.pipeline.stage_cache import body_model_file


def about(experiment: Experiment, config: Config) -> str:
    """What the rows of an experiment are of, in a sentence or two."""
    first = f"Simulated sequences, noise level `{experiment.noise}`."
    return f"{first} {deviations(experiment, config)}".rstrip()


def deviations(experiment: Experiment, config: Config) -> str:
    """Seed, length, motion, models and settings that are not as by default, if any.

    Settings are told against the preset that they are nearest to. A body model that
    was found on this machine counts as one that was named.
    """
    said = []
    if experiment.seed is not None:
        said.append(f"seed {experiment.seed}")
    if experiment.frames is not None:
        said.append(f"{experiment.frames} frames each")
    if experiment.motion is not None:
        said.append(f"motion of `{experiment.motion}`")
    body = body_model_file(config.body_model)
    config = dataclasses.replace(config, body_model=None if body is None else str(body))
    mine = dict(_flat(config))
    against = {"default": Config(), "paper": Config.paper()}
    differing = {
        preset: [f"`{k}` {mine[k]}" for k, v in _flat(theirs) if mine[k] != v]
        for preset, theirs in against.items()
    }
    preset = min(differing, key=lambda name: len(differing[name]))
    said += [f"preset `{preset}`"] if preset != "default" else []
    said += differing[preset]
    return f"Not as by default: {'; '.join(said)}." if said else ""


def _flat(settings: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Every setting under its name on the command line: `weights.pixel_sigma`."""
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            yield from _flat(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, value
