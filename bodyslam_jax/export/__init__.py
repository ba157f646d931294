"""Writes the run folder, the report, and files for other programs."""

from bodyslam_jax.export.folder import check_folder as check_folder
from bodyslam_jax.export.folder import clear_partial as clear_partial
from bodyslam_jax.export.folder import clear_run as clear_run
from bodyslam_jax.export.folder import run_folder as run_folder
from bodyslam_jax.export.folder import to_yaml as to_yaml
from bodyslam_jax.export.folder import write_files as write_files
from bodyslam_jax.export.folder import write_mesh as write_mesh
from bodyslam_jax.export.folder import write_points as write_points
from bodyslam_jax.export.folder import write_run as write_run
from bodyslam_jax.export.formats import FORMATS as FORMATS
from bodyslam_jax.export.formats import export as export
from bodyslam_jax.export.formats import read_observations as read_observations
from bodyslam_jax.export.formats.bvh import write_bvh as write_bvh
from bodyslam_jax.export.formats.trc import write_trc as write_trc
from bodyslam_jax.export.lock import FolderInUse as FolderInUse
from bodyslam_jax.export.lock import locked as locked
from bodyslam_jax.export.report import write_report as write_report
from bodyslam_jax.io import write_body as write_body
from bodyslam_jax.io import write_tum as write_tum
