"""Structure from motion: features, tracks, cameras and a map up to scale."""

from bodyslam_jax.sfm.bundle import ERROR_PER_SIGMA as ERROR_PER_SIGMA
from bodyslam_jax.sfm.burnt_in import burnt_in_warning as burnt_in_warning
from bodyslam_jax.sfm.burnt_in import without_burnt_in as without_burnt_in
from bodyslam_jax.sfm.camera_model import CameraModel as CameraModel
from bodyslam_jax.sfm.camera_model import find_camera_model as find_camera_model
from bodyslam_jax.sfm.camera_motion import background_motion as background_motion
from bodyslam_jax.sfm.features import brisk_status as brisk_status
from bodyslam_jax.sfm.moving_points import (
    second_motion_warning as second_motion_warning,
)
from bodyslam_jax.sfm.path_clock import place_in_time as place_in_time
from bodyslam_jax.sfm.person_mask import SILHOUETTE_STEP as SILHOUETTE_STEP
from bodyslam_jax.sfm.person_mask import person_masks as person_masks
from bodyslam_jax.sfm.scene_tracks import track as track
from bodyslam_jax.sfm.segments import Segments as Segments
from bodyslam_jax.sfm.segments import find_segments as find_segments
from bodyslam_jax.sfm.sfm import Reconstruction as Reconstruction
from bodyslam_jax.sfm.sfm import reconstruct as reconstruct
from bodyslam_jax.sfm.track_splitting import (
    information_from_other_pieces as information_from_other_pieces,
)
from bodyslam_jax.sfm.track_splitting import split_tracks as split_tracks
from bodyslam_jax.sfm.zoom import without_zoom as without_zoom
