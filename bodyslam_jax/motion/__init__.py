"""The motion model predicts displacements of the body, in metres, from postures.

It follows section 3.4 of the paper, and is robust to errors of estimated postures.
"""

from bodyslam_jax.config import MotionTraining as MotionTraining
from bodyslam_jax.motion.capture.clips import FPS as FPS
from bodyslam_jax.motion.capture.clips import Clip as Clip
from bodyslam_jax.motion.capture.clips import fit_shape as fit_shape
from bodyslam_jax.motion.capture.clips import place as place
from bodyslam_jax.motion.capture.clips import resample as resample
from bodyslam_jax.motion.capture.clips import split as split
from bodyslam_jax.motion.capture.readers import read_motion as read_motion
from bodyslam_jax.motion.contact_network import ContactModel as ContactModel
from bodyslam_jax.motion.contact_network import load_contact_model as load_contact_model
from bodyslam_jax.motion.contact_network import predict_contact as predict_contact
from bodyslam_jax.motion.contact_network import save_contact_model as save_contact_model
from bodyslam_jax.motion.network import Guess as Guess
from bodyslam_jax.motion.network import MotionNetwork as MotionNetwork
from bodyslam_jax.motion.network import Window as Window
from bodyslam_jax.motion.own_model import make_motion_model as make_motion_model
from bodyslam_jax.motion.prediction import MotionModel as MotionModel
from bodyslam_jax.motion.prediction import Prediction as Prediction
from bodyslam_jax.motion.prediction import Rollout as Rollout
from bodyslam_jax.motion.prediction import check_compatible as check_compatible
from bodyslam_jax.motion.prediction import leg_length as leg_length
from bodyslam_jax.motion.prediction import predict as predict
from bodyslam_jax.motion.prediction import rollout as rollout
from bodyslam_jax.motion.resampling import Clock as Clock
from bodyslam_jax.motion.resampling import contact_between as contact_between
from bodyslam_jax.motion.resampling import make_clock as make_clock
from bodyslam_jax.motion.resampling import predict_between as predict_between
from bodyslam_jax.motion.scale import Scale as Scale
from bodyslam_jax.motion.scale import scale_from_motion as scale_from_motion
from bodyslam_jax.motion.training.command import train_from_data as train_from_data
from bodyslam_jax.motion.training.contact import judge_contact as judge_contact
from bodyslam_jax.motion.training.contact import train_contact as train_contact
from bodyslam_jax.motion.training.evaluation import evaluate_model as evaluate_model
from bodyslam_jax.motion.training.figures import compare as compare
from bodyslam_jax.motion.training.figures import draw_errors as draw_errors
from bodyslam_jax.motion.training.figures import draw_history as draw_history
from bodyslam_jax.motion.training.figures import draw_rollout as draw_rollout
from bodyslam_jax.motion.training.figures import write_table as write_table
from bodyslam_jax.motion.training.sampling import disturb as disturb
from bodyslam_jax.motion.training.sampling import drift as drift
from bodyslam_jax.motion.training.train import train as train
from bodyslam_jax.motion.weights import load_motion_model as load_motion_model
from bodyslam_jax.motion.weights import save_motion_model as save_motion_model
