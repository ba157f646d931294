"""The focal length when it was guessed: found where the camera's path tells it."""

import dataclasses

import numpy as np
import pytest
from test_frontend_motion import CAMERA, camera_error, scene

from bodyslam_jax.config import Config
from bodyslam_jax.pipeline import sfm_stage
from bodyslam_jax.sfm import reconstruct
from bodyslam_jax.types import Intrinsics, Sequence

NUM = 24


def sequence(tracks, factor: float, num: int) -> Sequence:
    params = CAMERA.params * [factor, factor, 1, 1]
    guess = Intrinsics(params, CAMERA.width, CAMERA.height, is_guess=True)
    return Sequence("a", None, np.arange(num) / 30, guess, tracks=tracks)


@pytest.mark.slow
def test_a_guess_off_by_a_fifth_is_corrected():
    """Where the camera goes round something; the standard deviation says how well."""
    tracks, truth = scene("orbit", num=NUM)
    found = sfm_stage.estimate(sequence(tracks, 0.8, NUM), tracks, Config())
    assert found.kind == "moving"
    assert abs(found.focal / 260 - 1) < 0.03
    assert abs(found.focal - 260) < 3 * found.focal_sigma < 0.15 * 260
    np.testing.assert_allclose(found.intrinsics[1], found.focal, rtol=1e-3)
    np.testing.assert_allclose(found.intrinsics[2:], CAMERA.params[2:], atol=0.01)
    assert camera_error(found.T_WC, truth) < 0.03


@pytest.fixture(scope="module")
def orbit():
    tracks, _ = scene("orbit", num=NUM)
    return tracks, reconstruct(tracks, CAMERA, NUM)


@pytest.mark.parametrize(("error", "kind"), [(1.0, "moving"), (0.4, "rotation")])
def test_turning_is_believed_only_if_it_explains_the_images(
    monkeypatch, orbit, error, kind
):
    """A map that fits to 0.3 px, and with a better focal length none, but turning."""
    tracks, first = orbit
    turning = dataclasses.replace(first, kind="rotation", error=error)
    monkeypatch.setattr(sfm_stage, "reconstruct", lambda *_: turning)

    def adjusted(cameras, sigma, config, guess):
        found = np.asarray(guess.params) * [0.9, 0.9, 1, 1]
        return dataclasses.replace(
            cameras, intrinsics=found, focal_sigma=1.0, pixel_sigma=0.3
        )

    monkeypatch.setattr(sfm_stage, "adjust", adjusted)
    found = sfm_stage.estimate(sequence(tracks, 1.0, NUM), tracks, Config())
    assert found.kind == kind
    np.testing.assert_allclose(found.focal, 0.9 * CAMERA.params[0])


@pytest.mark.slow
def test_a_guess_is_kept_where_the_path_says_nothing():
    """Sideways before a wall, depth and focal length trade off against each other."""
    tracks, _ = scene("sideways", num=NUM, planar=True)
    found = sfm_stage.estimate(sequence(tracks, 0.8, NUM), tracks, Config())
    assert found.kind == "moving" and np.isnan(found.focal_sigma)
    np.testing.assert_allclose(found.intrinsics[:2], 0.8 * CAMERA.params[:2], rtol=0.02)
    assert any("focal length not determined" in text for text in found.warnings)
