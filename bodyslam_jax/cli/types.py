"""Types of arguments that several commands share."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from bodyslam_jax.config import Config

Input = tyro.conf.Positional[Path]
Preset = Literal["default", "paper"]
Flat = Annotated[Config, tyro.conf.arg(name="")]
"""Settings whose names are options: `--weights.pixel-sigma`."""
