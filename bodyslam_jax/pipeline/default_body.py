"""Chooses the body model of a run, by gender of given bodies and by motion model."""

import dataclasses
from pathlib import Path

from bodyslam_jax import motion
from bodyslam_jax.body import DEFAULT, load_body_model, search_paths
from bodyslam_jax.body.files import candidates, named_gender
from bodyslam_jax.config import Config
from bodyslam_jax.pipeline.stage_cache import body_model_file


def with_compatible_body(
    config: Config, gender: str | None = None
) -> tuple[Config, tuple[str, ...]]:
    """Returns settings with a body that the motion model was trained on, and warnings.

    Args:
        gender: gender of the body model that given bodies belong to, if stated. The
            model of that gender is taken from the folder in the settings, or from the
            installed ones; if there is none, a warning says so.

    A body model that was found on this machine, not named by the user, is replaced by
    the default body if the motion model belongs to that one; a warning says so. A body
    model that the user names is kept: a mismatch is rejected later.
    """
    config, warnings = _with_default_body(config)
    if gender is None or not config.people:
        return config, warnings
    named = None if config.body_model is None else Path(config.body_model)
    found = search_paths(gender) if named is None else candidates(named, gender)
    found = [file for file in found if file.is_file() and file != DEFAULT]
    fitting = [file for file in found if named_gender(file) in (gender, None)]
    if named is None:
        kind = motion.load_motion_model(config.motion_model).body
        fitting = [file for file in fitting if load_body_model(file).kind == kind]
    if fitting:
        return dataclasses.replace(config, body_model=str(fitting[0])), warnings
    if gender == "neutral" and (named is None or named == DEFAULT or named.is_dir()):
        return config, warnings
    used = "the default body" if named in (None, DEFAULT) else str(named)
    text = (
        f"the given bodies belong to the {gender} model, but {used} is used, in which "
        "their β mean another shape: name a folder with the model of that gender "
        "(--body-model)."
    )
    return config, (*warnings, text)


def _with_default_body(config: Config) -> tuple[Config, tuple[str, ...]]:
    """Replaces a body model that was found on this machine but does not match the
    motion model by the default body; returns settings and warnings."""
    file = body_model_file(config.body_model)
    if config.body_model is not None or file is None or not config.people:
        return config, ()
    model = motion.load_motion_model(config.motion_model)
    found = load_body_model(file)
    if found.kind == model.body or model.body != load_body_model(DEFAULT).kind:
        return config, ()
    text = (
        f"{file} is not used: the motion model was trained on the default body; "
        "name both, --body-model and a --motion-model of `bodyslam train-motion`."
    )
    return dataclasses.replace(config, body_model=str(DEFAULT)), (text,)
