"""All settings, one frozen class per stage.

The command line and `config.yaml` are generated from these classes. The package does
not import JAX, so that `--help` is quick.
"""

from bodyslam_jax.config.front_end import Association as Association
from bodyslam_jax.config.front_end import Detect as Detect
from bodyslam_jax.config.front_end import PeopleFit as PeopleFit
from bodyslam_jax.config.front_end import Structure as Structure
from bodyslam_jax.config.front_end import Tracking as Tracking
from bodyslam_jax.config.known import FOCAL_SIGMA as FOCAL_SIGMA
from bodyslam_jax.config.known import GRAVITY_SIGMA as GRAVITY_SIGMA
from bodyslam_jax.config.known import PATH_SIGMA as PATH_SIGMA
from bodyslam_jax.config.known import Known as Known
from bodyslam_jax.config.known import Measured as Measured
from bodyslam_jax.config.motion import ContactTraining as ContactTraining
from bodyslam_jax.config.motion import MotionTraining as MotionTraining
from bodyslam_jax.config.options import field_names as field_names
from bodyslam_jax.config.options import removed as removed
from bodyslam_jax.config.options import with_options as with_options
from bodyslam_jax.config.options import with_values as with_values
from bodyslam_jax.config.run import Config as Config
from bodyslam_jax.config.run import Distribution as Distribution
from bodyslam_jax.config.run import Limits as Limits
from bodyslam_jax.config.simulation import Experiment as Experiment
from bodyslam_jax.config.simulation import Simulation as Simulation
from bodyslam_jax.config.weights import GraphWeights as GraphWeights
