"""Makes the initial state, in metres, and the factors of the graph (section 3.6).

Cameras and landmarks come from structure from motion, up to scale; people are placed by
`T_WH = T_WC T_CH`. The initial scale has a closed form: the motion model's residual is
linear in s, and so is the height of people's feet above the ground.
"""

from bodyslam_jax.initialisation.carried_people import carried as carried
from bodyslam_jax.initialisation.carried_people import (
    lines_of_carried as lines_of_carried,
)
from bodyslam_jax.initialisation.ground import ground_contact as ground_contact
from bodyslam_jax.initialisation.ground import mean_up as mean_up
from bodyslam_jax.initialisation.ground import with_elevation as with_elevation
from bodyslam_jax.initialisation.ground import (
    with_visible_feet as with_visible_feet,
)
from bodyslam_jax.initialisation.map_factors import (
    PIXEL_SIGMA_RANGE as PIXEL_SIGMA_RANGE,
)
from bodyslam_jax.initialisation.map_factors import landmark_sigma as landmark_sigma
from bodyslam_jax.initialisation.map_factors import map_factor as map_factor
from bodyslam_jax.initialisation.map_factors import path_factors as path_factors
from bodyslam_jax.initialisation.map_factors import revisit_factor as revisit_factor
from bodyslam_jax.initialisation.motion_factors import motion_factor as motion_factor
from bodyslam_jax.initialisation.motion_factors import steps_shown as steps_shown
from bodyslam_jax.initialisation.people_factors import contact_factor as contact_factor
from bodyslam_jax.initialisation.people_factors import keypoint_sigma as keypoint_sigma
from bodyslam_jax.initialisation.people_factors import people_factors as people_factors
from bodyslam_jax.initialisation.people_factors import stature_factor as stature_factor
from bodyslam_jax.initialisation.people_factors import (
    without_contacts as without_contacts,
)
from bodyslam_jax.initialisation.placement import first_state as first_state
from bodyslam_jax.initialisation.placement import free_people as free_people
from bodyslam_jax.initialisation.placement import no_people as no_people
from bodyslam_jax.initialisation.scale import scale_start as scale_start
