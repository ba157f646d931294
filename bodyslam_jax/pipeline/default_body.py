"""Which body model a run takes where the settings name none."""

import dataclasses

from bodyslam_jax import motion
from bodyslam_jax.body import DEFAULT, load_body_model
from bodyslam_jax.config import Config
from bodyslam_jax.pipeline.stage_cache import body_model_file


def with_compatible_body(config: Config) -> tuple[Config, tuple[str, ...]]:
    """The settings with a body that the motion model was trained on, and warnings.

    A body model that was found on this machine, not named by the user, is replaced by
    the default body if the motion model belongs to that one; a warning says so. A body
    model that the user names is kept: the mismatch is refused later.
    """
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
