"""What comes in: video, features, tracks, structure from motion, and people's files.

NumPy and OpenCV; knows the camera and nothing of the graph.
"""

from bodyslam_jax.frontend._features import brisk_status as brisk_status
from bodyslam_jax.frontend._layouts import BODY25_FROM as BODY25_FROM
from bodyslam_jax.frontend._person_mask import SILHOUETTE_STEP as SILHOUETTE_STEP
from bodyslam_jax.frontend._reconstruct import Reconstruction as Reconstruction
from bodyslam_jax.frontend._reconstruct import reconstruct as reconstruct
from bodyslam_jax.frontend._revisits import cut_tracks as cut_tracks
from bodyslam_jax.frontend._revisits import told_by_other_pieces as told_by_other_pieces
from bodyslam_jax.frontend._sequence import read_sequence as read_sequence
from bodyslam_jax.frontend._sequence import with_detections as with_detections
from bodyslam_jax.frontend._tracks import track as track
from bodyslam_jax.frontend._video import frames as frames
