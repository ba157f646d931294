"""The command line `bodyslam`: the only package that prints and sets up JAX.

Each command is a typed function whose docstring is its help; its options are its
arguments and the fields of `bodyslam_jax.config`. JAX is imported when a command runs,
never for help or wrong usage. `main` has the exit codes.
"""

from bodyslam_jax.cli.commands import COMMANDS as COMMANDS
from bodyslam_jax.cli.main import main as main
from bodyslam_jax.cli.main import program as program
from bodyslam_jax.cli.options import options as options
from bodyslam_jax.cli.reference import reference as reference
from bodyslam_jax.cli.settings import base_config as base_config
from bodyslam_jax.cli.settings import option as option
from bodyslam_jax.cli.settings import read_settings as read_settings
