"""Exports a result to files of other programs: one module per format, and a table of
all.

The metric world is that of the run (`docs/conventions.md`); `up="z"` rotates it so that
z is up. All files that are written from one result share that world.
"""

from bodyslam_jax.export.formats.files import export as export
from bodyslam_jax.export.formats.registry import FORMATS as FORMATS
from bodyslam_jax.export.formats.registry import Format as Format
from bodyslam_jax.export.formats.registry import table as table
from bodyslam_jax.export.formats.scene import Observations as Observations
from bodyslam_jax.export.formats.scene import (
    read_observations as read_observations,
)
