"""The body model: file -> shaped body -> posed joints -> keypoints -> vertices."""

from bodyslam_jax.body.files import DEFAULT as DEFAULT
from bodyslam_jax.body.files import check as check
from bodyslam_jax.body.files import load_body_model as load_body_model
from bodyslam_jax.body.files import search_paths as search_paths
from bodyslam_jax.body.files import write_npz as write_npz
from bodyslam_jax.body.keypoint_definitions import (
    KEYPOINT_DEFINITIONS as KEYPOINT_DEFINITIONS,
)
from bodyslam_jax.body.keypoint_definitions import (
    definition_offsets as definition_offsets,
)
from bodyslam_jax.body.kinematics import joints as joints
from bodyslam_jax.body.kinematics import keypoints as keypoints
from bodyslam_jax.body.kinematics import local_joints as local_joints
from bodyslam_jax.body.kinematics import local_keypoints as local_keypoints
from bodyslam_jax.body.kinematics import rest_joints as rest_joints
from bodyslam_jax.body.model import BodyModel as BodyModel
from bodyslam_jax.body.show import draw_body as draw_body
from bodyslam_jax.body.show import posture as posture
from bodyslam_jax.body.show import save_picture as save_picture
from bodyslam_jax.body.skeleton import BODY25 as BODY25
from bodyslam_jax.body.skeleton import DETECTOR_BIAS as DETECTOR_BIAS
from bodyslam_jax.body.skeleton import JOINT_NAMES as JOINT_NAMES
from bodyslam_jax.body.skeleton import KEYPOINT_NAMES as KEYPOINT_NAMES
from bodyslam_jax.body.skeleton import KEYPOINT_SPREAD as KEYPOINT_SPREAD
from bodyslam_jax.body.skeleton import MIRRORED as MIRRORED
from bodyslam_jax.body.skeleton import PARENTS as PARENTS
from bodyslam_jax.body.skeleton import SURFACE_POINTS as SURFACE_POINTS
from bodyslam_jax.body.skinning import stature as stature
from bodyslam_jax.body.skinning import vertices as vertices
