"""How a problem is solved: structure, linear algebra, steps, baselines, uncertainty."""

from bodyslam_jax.solver._covariance import Marginals as Marginals
from bodyslam_jax.solver._covariance import marginals as marginals
from bodyslam_jax.solver._mapping import over_devices as over_devices
from bodyslam_jax.solver._observability import observability as observability
from bodyslam_jax.solver._schedule import PAPER_SCHEDULE as PAPER_SCHEDULE
from bodyslam_jax.solver._schedule import Stage as Stage
from bodyslam_jax.solver._schedule import paper_schedule as paper_schedule
from bodyslam_jax.solver._solution import Solution as Solution
from bodyslam_jax.solver._solve import restrict as restrict
from bodyslam_jax.solver._solve import solve as solve
from bodyslam_jax.solver._trace import clock as clock
from bodyslam_jax.solver._trace import trace as trace
