"""Tracks -> cameras and map: bundle adjustment, and what the graph is handed."""

import dataclasses

import numpy as np
import pytest
from test_frontend_motion import CAMERA, camera_error, scene

from bodyslam_jax.config import Config, Structure
from bodyslam_jax.pipeline import sfm_stage
from bodyslam_jax.types import Sequence

NUM = 24


@pytest.mark.slow
def test_long_tracks_are_cut_only_after_they_have_shown_the_path():
    """Pieces that are adjusted by themselves leave the path as it was before."""
    tracks, truth = scene("orbit", num=NUM)
    sequence = Sequence("a", None, np.arange(NUM) / 30, CAMERA, tracks=tracks)
    found = {}
    for span in (NUM, 9):
        config = dataclasses.replace(Config(), structure=Structure(landmark_span=span))
        found[span] = sfm_stage.estimate(sequence, tracks, config)
    whole, cut = found[NUM], found[9]
    np.testing.assert_allclose(cut.T_WC, whole.T_WC, atol=1e-9)
    assert camera_error(cut.T_WC, truth) < 0.01
    seen = [cut.tracks.frame[cut.tracks.landmark == i] for i in range(99)]
    assert max(np.ptp(frames) for frames in seen if len(frames)) < 9
    assert len(cut.landmarks) > 1.5 * len(whole.landmarks)
    # A piece knows of the others, and is where all of them together are.
    told = np.trace(cut.prior_information, axis1=1, axis2=2)
    assert np.mean(told > 0) > 0.6  # tracks that were not cut know of none
    np.testing.assert_array_equal(cut.prior_mean, cut.landmarks)
