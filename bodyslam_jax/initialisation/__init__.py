"""From tracks and bodies to a first metric state and the factors that refine it.

Section 3.6 of the paper: cameras and landmarks up to scale from structure from motion,
people placed in them by `T_WH = T_WC T_CH`, and the graph's error terms. The first
scale comes in closed form from the motion model, which is linear in s, and from the
ground under people's feet.
"""

from bodyslam_jax.initialisation.carried_people import carried as carried
from bodyslam_jax.initialisation.carried_people import (
    lines_of_carried as lines_of_carried,
)
from bodyslam_jax.initialisation.extra_factors import (
    optional_factors as optional_factors,
)
from bodyslam_jax.initialisation.factors import PIXEL_SIGMA_RANGE as PIXEL_SIGMA_RANGE
from bodyslam_jax.initialisation.factors import keypoint_sigma as keypoint_sigma
from bodyslam_jax.initialisation.factors import landmark_sigma as landmark_sigma
from bodyslam_jax.initialisation.factors import map_factor as map_factor
from bodyslam_jax.initialisation.factors import motion_factor as motion_factor
from bodyslam_jax.initialisation.factors import path_factors as path_factors
from bodyslam_jax.initialisation.factors import people_factors as people_factors
from bodyslam_jax.initialisation.factors import revisit_factor as revisit_factor
from bodyslam_jax.initialisation.factors import stature_factor as stature_factor
from bodyslam_jax.initialisation.placement import first_state as first_state
from bodyslam_jax.initialisation.placement import free_people as free_people
from bodyslam_jax.initialisation.placement import no_people as no_people
from bodyslam_jax.initialisation.scale import ground_contact as ground_contact
from bodyslam_jax.initialisation.scale import scale_start as scale_start
from bodyslam_jax.initialisation.upright import upright_factor as upright_factor
