"""A result as other programs read it: one module a format, all in one table.

The metric world is that of the run (`docs/conventions.md`); `up="z"` turns it so that z
is up. Everything that is written from one result shares that world.
"""

from bodyslam_jax.export.formats.files import export as export
from bodyslam_jax.export.formats.observations import Observations as Observations
from bodyslam_jax.export.formats.observations import (
    read_observations as read_observations,
)
from bodyslam_jax.export.formats.registry import FORMATS as FORMATS
from bodyslam_jax.export.formats.registry import Format as Format
from bodyslam_jax.export.formats.registry import table as table
