"""The factor graph: state, factors, robust losses and the problem to be solved."""

from bodyslam_jax.geometry.lengths import round_up as round_up
from bodyslam_jax.graph.check_factor import FactorReport as FactorReport
from bodyslam_jax.graph.check_factor import check_factor as check_factor
from bodyslam_jax.graph.edit import disable as disable
from bodyslam_jax.graph.edit import rescaled as rescaled
from bodyslam_jax.graph.edit import set_constant as set_constant
from bodyslam_jax.graph.factor import Factor as Factor
from bodyslam_jax.graph.factor import Frame as Frame
from bodyslam_jax.graph.factor import FrameFactor as FrameFactor
from bodyslam_jax.graph.factor import Shared as Shared
from bodyslam_jax.graph.factor import residual_of as residual_of
from bodyslam_jax.graph.factors.body_pose_prior import BodyPosePrior as BodyPosePrior
from bodyslam_jax.graph.factors.camera_prior import CameraPrior as CameraPrior
from bodyslam_jax.graph.factors.camera_prior import ScalePrior as ScalePrior
from bodyslam_jax.graph.factors.foot_contact import FootContact as FootContact
from bodyslam_jax.graph.factors.ground_contact import HEELS_AND_TOES as HEELS_AND_TOES
from bodyslam_jax.graph.factors.ground_contact import GroundContact as GroundContact
from bodyslam_jax.graph.factors.human_motion import HumanMotion as HumanMotion
from bodyslam_jax.graph.factors.intrinsics_prior import (
    AspectRatioPrior as AspectRatioPrior,
)
from bodyslam_jax.graph.factors.intrinsics_prior import (
    IntrinsicsPrior as IntrinsicsPrior,
)
from bodyslam_jax.graph.factors.keypoint_reprojection import (
    KeypointReprojection as KeypointReprojection,
)
from bodyslam_jax.graph.factors.marginal_prior import MarginalPrior as MarginalPrior
from bodyslam_jax.graph.factors.reprojection import LandmarkPrior as LandmarkPrior
from bodyslam_jax.graph.factors.reprojection import Reprojection as Reprojection
from bodyslam_jax.graph.factors.root_orientation import (
    RootOrientation as RootOrientation,
)
from bodyslam_jax.graph.factors.root_position_prior import (
    RootPositionPrior as RootPositionPrior,
)
from bodyslam_jax.graph.factors.root_smoothness import (
    AngularAccelerationPrior as AngularAccelerationPrior,
)
from bodyslam_jax.graph.factors.root_smoothness import RootSmoothness as RootSmoothness
from bodyslam_jax.graph.factors.shape_prior import ShapePrior as ShapePrior
from bodyslam_jax.graph.factors.shape_prior import Stature as Stature
from bodyslam_jax.graph.globals import GlobalPrior as GlobalPrior
from bodyslam_jax.graph.globals import Variable as Variable
from bodyslam_jax.graph.layout import Layout as Layout
from bodyslam_jax.graph.layout import make_layout as make_layout
from bodyslam_jax.graph.losses import BlakeZisserman as BlakeZisserman
from bodyslam_jax.graph.losses import Cauchy as Cauchy
from bodyslam_jax.graph.losses import GemanMcClure as GemanMcClure
from bodyslam_jax.graph.losses import Loss as Loss
from bodyslam_jax.graph.losses import Squared as Squared
from bodyslam_jax.graph.losses import ar1_correlation as ar1_correlation
from bodyslam_jax.graph.losses import robustify as robustify
from bodyslam_jax.graph.losses import squared_norm as squared_norm
from bodyslam_jax.graph.losses import whitening_of as whitening_of
from bodyslam_jax.graph.ordering import CHUNK as CHUNK
from bodyslam_jax.graph.padding import extend as extend
from bodyslam_jax.graph.padding import extend_state as extend_state
from bodyslam_jax.graph.padding import pad_factor as pad_factor
from bodyslam_jax.graph.pelvis_displacement import displacement as displacement
from bodyslam_jax.graph.problem import VARIABLES as VARIABLES
from bodyslam_jax.graph.problem import MotionPredictor as MotionPredictor
from bodyslam_jax.graph.problem import Problem as Problem
from bodyslam_jax.graph.problem import in_one_layout as in_one_layout
from bodyslam_jax.graph.problem import layout_of as layout_of
from bodyslam_jax.graph.problem import make_problem as make_problem
from bodyslam_jax.graph.state import TURNS as TURNS
from bodyslam_jax.graph.state import State as State
from bodyslam_jax.graph.state import Step as Step
from bodyslam_jax.graph.state import gauge as gauge
from bodyslam_jax.graph.state import retract_pose as retract_pose
from bodyslam_jax.graph.state import retract_rotation as retract_rotation
from bodyslam_jax.graph.state import world_from_root as world_from_root
from bodyslam_jax.graph.validation import check_state as check_state
from bodyslam_jax.graph.weights import weights as weights
from bodyslam_jax.graph.weights import with_weights as with_weights
