"""Readers and writers of files: video, keypoints, bodies, cameras, masks, tracks."""

from bodyslam_jax.io.camera.tum import read_tum as read_tum
from bodyslam_jax.io.keypoints.layouts import BODY25_FROM as BODY25_FROM
from bodyslam_jax.io.sequence import read_sequence as read_sequence
from bodyslam_jax.io.sequence import with_detections as with_detections
from bodyslam_jax.io.video import frames as frames
