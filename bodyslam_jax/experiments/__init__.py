"""The paper's experiments, and additional ones, on simulated sequences.

`bodyslam experiment NAME --out FOLDER` calls `run_experiment`: inputs are the settings
of `config.Experiment` and `Config`; outputs are tables and figures in the folder, rows
in `rows`, finished stages in `stages`.
"""

from bodyslam_jax.config import Experiment as Experiment
from bodyslam_jax.experiments.ablation import VARIANTS as VARIANTS
from bodyslam_jax.experiments.ablation import ablate as ablate
from bodyslam_jax.experiments.ablation import as_published as as_published
from bodyslam_jax.experiments.ablation import landmark_ablation as landmark_ablation
from bodyslam_jax.experiments.ablation import with_motion_model as with_motion_model
from bodyslam_jax.experiments.ablation import with_weights as with_weights
from bodyslam_jax.experiments.comparison import METHODS as METHODS
from bodyslam_jax.experiments.comparison import compare_methods as compare_methods
from bodyslam_jax.experiments.comparison import depth_scale as depth_scale
from bodyslam_jax.experiments.plans import run_experiment as run_experiment
from bodyslam_jax.experiments.scale import PERTURBATIONS as PERTURBATIONS
from bodyslam_jax.experiments.scale import ScaleRecovery as ScaleRecovery
from bodyslam_jax.experiments.scale import scale_recovery as scale_recovery
from bodyslam_jax.experiments.scenario import errors as errors
from bodyslam_jax.experiments.scenario import score as score
from bodyslam_jax.experiments.scenario import score_of as score_of
from bodyslam_jax.experiments.scenario import without_map as without_map
