"""Checks whether inputs agree with each other and whether a result is plausible.

`verdict.py` decides the status of a result (`ok`, `doubtful`, `failed`) by the rules in
`checks.py`; `agreement/` compares the inputs.
"""

from bodyslam_jax.diagnostics.agreement import reconcile as reconcile
from bodyslam_jax.diagnostics.checks import Reason as Reason
from bodyslam_jax.diagnostics.gait import Gait as Gait
from bodyslam_jax.diagnostics.gait import gait as gait
from bodyslam_jax.diagnostics.gait import gait_of_joints as gait_of_joints
from bodyslam_jax.diagnostics.standing_height import ground_scale as ground_scale
from bodyslam_jax.diagnostics.statistics import PathStatistics as PathStatistics
from bodyslam_jax.diagnostics.statistics import camera_statistics as camera_statistics
from bodyslam_jax.diagnostics.statistics import person_statistics as person_statistics
from bodyslam_jax.diagnostics.statistics import stature as stature
from bodyslam_jax.diagnostics.verdict import Verdict as Verdict
from bodyslam_jax.diagnostics.verdict import assess as assess
