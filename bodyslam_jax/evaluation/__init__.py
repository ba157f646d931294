"""Compares estimates with the truth: alignments, errors, and readers of both."""

from bodyslam_jax.evaluation.alignment import Alignment as Alignment
from bodyslam_jax.evaluation.alignment import Similarity as Similarity
from bodyslam_jax.evaluation.alignment import align as align
from bodyslam_jax.evaluation.alignment import umeyama as umeyama
from bodyslam_jax.evaluation.association import associate as associate
from bodyslam_jax.evaluation.association import evaluate as evaluate
from bodyslam_jax.evaluation.association import stack_pairs as stack_pairs
from bodyslam_jax.evaluation.datasets import convert_3dpw as convert_3dpw
from bodyslam_jax.evaluation.datasets import convert_emdb as convert_emdb
from bodyslam_jax.evaluation.datasets import convert_rich as convert_rich
from bodyslam_jax.evaluation.datasets import convert_tum_amass as convert_tum_amass
from bodyslam_jax.evaluation.datasets import read_truth as read_truth
from bodyslam_jax.evaluation.errors import FIGURES as FIGURES
from bodyslam_jax.evaluation.errors import NOBODY as NOBODY
from bodyslam_jax.evaluation.errors import Evaluation as Evaluation
from bodyslam_jax.evaluation.errors import Pair as Pair
from bodyslam_jax.evaluation.errors import Scope as Scope
from bodyslam_jax.evaluation.errors import Trajectories as Trajectories
from bodyslam_jax.evaluation.errors import (
    evaluate_trajectories as evaluate_trajectories,
)
from bodyslam_jax.evaluation.metrics import Errors as Errors
from bodyslam_jax.evaluation.metrics import acceleration_error as acceleration_error
from bodyslam_jax.evaluation.metrics import camera_frame as camera_frame
from bodyslam_jax.evaluation.metrics import foot_sliding as foot_sliding
from bodyslam_jax.evaluation.metrics import jitter as jitter
from bodyslam_jax.evaluation.metrics import (
    joint_trajectory_error as joint_trajectory_error,
)
from bodyslam_jax.evaluation.metrics import mpjpe as mpjpe
from bodyslam_jax.evaluation.metrics import pa_mpjpe as pa_mpjpe
from bodyslam_jax.evaluation.metrics import (
    relative_pose_errors as relative_pose_errors,
)
from bodyslam_jax.evaluation.metrics import (
    root_trajectory_error as root_trajectory_error,
)
from bodyslam_jax.evaluation.metrics import trajectory_error as trajectory_error
from bodyslam_jax.evaluation.metrics import world_mpjpe as world_mpjpe
from bodyslam_jax.evaluation.readers import body_of_run as body_of_run
from bodyslam_jax.evaluation.readers import check_body as check_body
from bodyslam_jax.evaluation.readers import read_groundtruth as read_groundtruth
from bodyslam_jax.evaluation.readers import read_result as read_result
from bodyslam_jax.evaluation.readers import read_summary as read_summary
from bodyslam_jax.evaluation.readers import read_tum as read_tum
from bodyslam_jax.evaluation.report import ROWS as ROWS
from bodyslam_jax.evaluation.report import describe as describe
from bodyslam_jax.evaluation.report import gaps as gaps
from bodyslam_jax.evaluation.report import to_json as to_json
from bodyslam_jax.evaluation.report import to_rows as to_rows
from bodyslam_jax.evaluation.report import to_table as to_table
from bodyslam_jax.evaluation.resampling import pad_frames as pad_frames
