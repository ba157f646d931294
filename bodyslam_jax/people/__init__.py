"""People: bodies from keypoints or from a regressor, made ready for the graph."""

from bodyslam_jax.people.bodies import estimate_bodies as estimate_bodies
from bodyslam_jax.people.bodies import nobody as nobody
from bodyslam_jax.people.bodies import select_people as select_people
from bodyslam_jax.people.bodies import without_bodies as without_bodies
from bodyslam_jax.people.clean_regressed import BodyNoise as BodyNoise
from bodyslam_jax.people.clean_regressed import body_noise as body_noise
from bodyslam_jax.people.clean_regressed import prepare_bodies as prepare_bodies
from bodyslam_jax.people.definitions import as_body_keypoints as as_body_keypoints
from bodyslam_jax.people.depths import with_depths as with_depths
from bodyslam_jax.people.detect import detect_people as detect_people
from bodyslam_jax.people.find import find_people_tracked as find_people_tracked
from bodyslam_jax.people.fit import fit_bodies as fit_bodies
from bodyslam_jax.people.found import Found as Found
from bodyslam_jax.people.keypoint_errors import keypoint_sigma as keypoint_sigma
from bodyslam_jax.people.networks import network_status as network_status
from bodyslam_jax.people.person_state import PersonState as PersonState
from bodyslam_jax.people.person_state import bodies_from_roots as bodies_from_roots
from bodyslam_jax.people.person_state import roots_from_bodies as roots_from_bodies
from bodyslam_jax.people.shown import joints_of as joints_of
from bodyslam_jax.people.shown import legs_shown as legs_shown
from bodyslam_jax.people.shown import shown_keypoints as shown_keypoints
from bodyslam_jax.people.shown import without_keypoints as without_keypoints
from bodyslam_jax.people.sides import correct_left_right as correct_left_right
from bodyslam_jax.people.stature import linear_stature as linear_stature
from bodyslam_jax.people.stature import statures_of as statures_of
from bodyslam_jax.people.stature import with_statures as with_statures
