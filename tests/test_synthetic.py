"""Exact scenes: what they promise holds to machine precision."""

import numpy as np
import pytest
from scipy.signal import lfilter

from bodyslam_jax import simulation
from bodyslam_jax.simulation import sensor_noise


@pytest.mark.parametrize("num_frames", [2, 10, 200])
def test_scene_is_exact_and_every_landmark_is_seen_twice(num_frames):
    s = simulation.scene(3, num_frames, num_landmarks=80)
    T_CW = np.linalg.inv(s.T_WC)[s.frame]
    p_C = np.einsum("mij,mj->mi", T_CW[:, :3, :3], s.landmarks[s.landmark])
    p_C = p_C + T_CW[:, :3, 3]
    uv = p_C[:, :2] / p_C[:, 2:] * s.intrinsics[:2] + s.intrinsics[2:]
    assert abs(uv - s.uv).max() < 1e-9  # px, only rounding
    assert np.bincount(s.landmark, minlength=80).min() >= 2
    assert (np.diff(s.frame) >= 0).all()


def test_scene_has_the_person_in_view():
    s = simulation.scene(1, 60)
    pelvis = s.T_CH[:, :3, 3]
    uv = pelvis[:, :2] / pelvis[:, 2:] * s.intrinsics[:2] + s.intrinsics[2:]
    assert (np.abs(uv - [320, 240]) < 200).all()
    assert (abs(pelvis[:, 2] - 4) < 1).all()  # m


def test_scene_depends_on_nothing_but_its_seed():
    a, b, c = simulation.scene(5), simulation.scene(5), simulation.scene(6)
    assert (a.uv == b.uv).all()
    assert a.uv.shape != c.uv.shape or (a.uv != c.uv).any()


def test_noise_and_outliers_have_the_size_asked_for():
    clean = simulation.scene(2, 60, 400)
    noisy = simulation.scene(2, 60, 400, noise=0.7)
    assert abs((noisy.uv - clean.uv).std() - 0.7) < 0.03
    wrong = simulation.scene(2, 60, 400, outliers=0.1)
    share = (np.linalg.norm(wrong.uv - clean.uv, axis=1) > 1).mean()
    assert abs(share - 0.1) < 0.02


def test_lasting_noise_is_an_autoregressive_filter_of_white_noise():
    """Against SciPy's filter; its deviation is 1 from the first frame on."""
    found = sensor_noise.ar1(np.random.default_rng(3), (400, 2000), 0.9)
    white = np.random.default_rng(3).standard_normal((400, 2000))
    white[1:] *= np.sqrt(1 - 0.9**2)
    expected = lfilter([1.0], [1.0, -0.9], white, axis=0)
    np.testing.assert_allclose(found, expected, atol=1e-12)
    assert abs(found[[0, 1, 10, 399]].std(axis=1) - 1).max() < 0.06
