"""What is written: the run folder, the report, files for other programs."""

from bodyslam_jax.export.folder import check_folder as check_folder
from bodyslam_jax.export.folder import run_folder as run_folder
from bodyslam_jax.export.folder import to_yaml as to_yaml
from bodyslam_jax.export.folder import write_files as write_files
from bodyslam_jax.export.folder import write_points as write_points
from bodyslam_jax.export.folder import write_run as write_run
from bodyslam_jax.export.ground import ground_scale as ground_scale
from bodyslam_jax.export.lock import locked as locked
from bodyslam_jax.export.meshes import write_bvh as write_bvh
from bodyslam_jax.export.meshes import write_mesh as write_mesh
from bodyslam_jax.export.meshes import write_trc as write_trc
from bodyslam_jax.export.report import write_report as write_report
from bodyslam_jax.export.statistics import PathFacts as PathFacts
from bodyslam_jax.export.statistics import camera_facts as camera_facts
from bodyslam_jax.export.statistics import person_facts as person_facts
from bodyslam_jax.export.statistics import stature as stature
from bodyslam_jax.export.walking import Gait as Gait
from bodyslam_jax.export.walking import gait as gait
from bodyslam_jax.export.walking import gait_of_joints as gait_of_joints
from bodyslam_jax.io import write_body as write_body
from bodyslam_jax.io import write_tum as write_tum
