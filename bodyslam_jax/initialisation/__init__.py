"""From tracks and bodies to a first metric state and the factors that refine it.

Section 3.6 of the paper: cameras and landmarks up to scale from structure from motion,
people placed in them by `T_WH = T_WC T_CH`, and the graph's error terms. The first
scale comes in closed form from the motion model, which is linear in s, and from the
ground under people's feet.
"""

from bodyslam_jax.initialisation._carried import carried as carried
from bodyslam_jax.initialisation._carried import lines_of_carried as lines_of_carried
from bodyslam_jax.initialisation._factors import PIXEL_SIGMA_RANGE as PIXEL_SIGMA_RANGE
from bodyslam_jax.initialisation._factors import keypoint_sigma as keypoint_sigma
from bodyslam_jax.initialisation._factors import landmark_sigma as landmark_sigma
from bodyslam_jax.initialisation._factors import map_factor as map_factor
from bodyslam_jax.initialisation._factors import motion_factor as motion_factor
from bodyslam_jax.initialisation._factors import path_factors as path_factors
from bodyslam_jax.initialisation._factors import people_factors as people_factors
from bodyslam_jax.initialisation._factors import revisit_factor as revisit_factor
from bodyslam_jax.initialisation._factors import stature_factor as stature_factor
from bodyslam_jax.initialisation._optional import optional_factors as optional_factors
from bodyslam_jax.initialisation._optional import stance_factor as stance_factor
from bodyslam_jax.initialisation._optional import (
    steady_camera_factor as steady_camera_factor,
)
from bodyslam_jax.initialisation._scale import ScaleStart as ScaleStart
from bodyslam_jax.initialisation._scale import ground_contact as ground_contact
from bodyslam_jax.initialisation._scale import scale_start as scale_start
from bodyslam_jax.initialisation._state import first_state as first_state
from bodyslam_jax.initialisation._state import free_people as free_people
from bodyslam_jax.initialisation._state import no_people as no_people
from bodyslam_jax.initialisation._upright import upright_factor as upright_factor
