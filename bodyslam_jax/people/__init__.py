"""People: bodies from keypoints or from a regressor, made ready for the graph."""

from bodyslam_jax.people._bodies import estimate_bodies as estimate_bodies
from bodyslam_jax.people._bodies import nobody as nobody
from bodyslam_jax.people._bodies import select_people as select_people
from bodyslam_jax.people._bodies import without_bodies as without_bodies
from bodyslam_jax.people._built_in import find_tracked as find_tracked
from bodyslam_jax.people._depths import with_depths as with_depths
from bodyslam_jax.people._detect import detect_people as detect_people
from bodyslam_jax.people._fit import fit_bodies as fit_bodies
from bodyslam_jax.people._found import Found as Found
from bodyslam_jax.people._keypoint_errors import keypoint_sigma as keypoint_sigma
from bodyslam_jax.people._networks import network_status as network_status
from bodyslam_jax.people._prepare import BodyNoise as BodyNoise
from bodyslam_jax.people._prepare import body_noise as body_noise
from bodyslam_jax.people._prepare import prepare_bodies as prepare_bodies
from bodyslam_jax.people._roots import Roots as Roots
from bodyslam_jax.people._roots import bodies_from_roots as bodies_from_roots
from bodyslam_jax.people._roots import roots_from_bodies as roots_from_bodies
from bodyslam_jax.people._stature import linear_stature as linear_stature
from bodyslam_jax.people._stature import of_each as of_each
from bodyslam_jax.people._stature import with_statures as with_statures
