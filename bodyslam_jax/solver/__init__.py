"""Solves factor-graph problems by structured Levenberg-Marquardt; covariances.

`solve.py` has the interface, `levenberg_marquardt.py` damping and acceptance,
`linear_system.py` one step and its elimination order, `covariance.py` the posterior,
`marginalisation.py` the prior that replaces the first frames, `implicit.py` derivatives
of a solution.
"""

from bodyslam_jax.solver.batching import vmap_over_devices as vmap_over_devices
from bodyslam_jax.solver.compilation import quick_options as quick_options
from bodyslam_jax.solver.convergence_trace import trace as trace
from bodyslam_jax.solver.covariance import Marginals as Marginals
from bodyslam_jax.solver.covariance import marginals as marginals
from bodyslam_jax.solver.marginalisation import Remainder as Remainder
from bodyslam_jax.solver.marginalisation import marginalise as marginalise
from bodyslam_jax.solver.observability import observability as observability
from bodyslam_jax.solver.solution import Solution as Solution
from bodyslam_jax.solver.solve import PAPER_SCHEDULE as PAPER_SCHEDULE
from bodyslam_jax.solver.solve import Stage as Stage
from bodyslam_jax.solver.solve import paper_schedule as paper_schedule
from bodyslam_jax.solver.solve import restrict as restrict
from bodyslam_jax.solver.solve import solve as solve
