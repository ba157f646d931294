"""What tracks say of the lens: zoom, pixels, distortion; and of a second motion."""

import dataclasses
import re

import cv2
import numpy as np
import pytest
from test_frontend_motion import CAMERA, SIZE, camera_error, scene

from bodyslam_jax import simulation
from bodyslam_jax.config import Simulation, Structure
from bodyslam_jax.pipeline.people_stage import with_intrinsics
from bodyslam_jax.sfm import find_camera_model, reconstruct, second_motion_warning
from bodyslam_jax.sfm.camera_model import _turning_zoom
from bodyslam_jax.sfm.zoom import without_zoom
from bodyslam_jax.types import Bodies, Keypoints, Sequence, Tracks

# Bundle adjustment runs for longer than it compiles.
pytestmark = pytest.mark.usefixtures("optimised")

CENTRE = CAMERA.params[2:4]
GUESS = dataclasses.replace(CAMERA, is_guess=True)


def about_centre(tracks, size):
    uv = CENTRE + (tracks.uv - CENTRE) * size
    return dataclasses.replace(tracks, uv=uv)


def zoomed(tracks, ratio):
    return about_centre(tracks, ratio ** (tracks.frame / 59)[:, None])


def model_of(tracks, camera=CAMERA):
    return find_camera_model(tracks, camera, 60, Structure())


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind", ["sideways", pytest.param("orbit", marks=pytest.mark.slow)]
)
def test_a_zoom_of_a_moving_camera_is_undone(kind):
    tracks, truth = scene(kind, seed=3)
    model = model_of(zoomed(tracks, 1.4))
    assert model.zoom is not None and model.found.kind == "moving"
    assert np.exp(np.ptp(model.zoom)) == pytest.approx(1.4, rel=0.04)
    assert camera_error(model.found.T_WC, truth) < 0.04
    assert "frame 59 is 1." in model.warnings[0] and "zoom" in model.warnings[0]


@pytest.mark.parametrize("ratio", [1.12, 1.6])
def test_a_zoom_on_a_tripod_is_no_way_forward(ratio):
    tracks, _ = scene("static", seed=3)
    model = model_of(zoomed(tracks, ratio))
    assert model.found.kind == "static" and model.zoom is not None
    assert np.exp(model.zoom[-1] - model.zoom[0]) == pytest.approx(ratio, rel=0.01)


@pytest.mark.parametrize("kind", ["sideways", "forward", "orbit", "turn", "static"])
def test_a_camera_that_does_not_zoom_is_left_as_it_is(kind):
    tracks, _ = scene(kind, seed=4)
    model = model_of(tracks, GUESS)
    assert model.zoom is None and model.warnings == ()
    assert model.intrinsics is GUESS and model.tracks is tracks


@pytest.mark.slow
def test_a_long_walk_is_no_zoom():
    """In these frames of a long walk pairs are found that a rotation and a zoom
    explain."""
    walk = simulation.simulate(Simulation(sequence="D1", family="room"))
    sequence = simulation.as_sequence(walk)
    tracks, camera, start, count = sequence.tracks, sequence.intrinsics, 150, 100
    there = (tracks.frame >= start) & (tracks.frame < start + count)
    tracks = Tracks(
        tracks.frame[there] - start, tracks.landmark[there], tracks.uv[there]
    )
    assert _turning_zoom(tracks, camera, count) is not None
    model = find_camera_model(tracks, camera, count, Structure())
    assert model.zoom is None
    assert camera_error(model.found.T_WC, walk.T_WC[start : start + count]) < 0.02


@pytest.mark.slow
def test_pixels_that_are_not_square_are_seen_in_the_tracks():
    """They are used, or said with their figures where the odds do not suffice: here
    focal length and aspect ratio are known together better than each alone."""
    (tracks, truth), ratio = scene("orbit", seed=3), 4 / 3
    model = model_of(about_centre(tracks, np.array([ratio, 1.0])), GUESS)
    (said,) = [re.search(r"fx/fy = ([\d.]+)", text) for text in model.warnings]
    assert said is not None
    assert abs(np.log(float(said[1]) / ratio)) < 0.1
    assert camera_error(model.found.T_WC, truth) < 0.02


@pytest.mark.slow
def test_what_camera_json_says_of_the_pixels_is_doubted_aloud():
    tracks, _ = scene("orbit", seed=3)
    model = model_of(about_centre(tracks, np.array([0.75, 1.0])))
    assert any("fx/fy" in text for text in model.warnings)


@pytest.mark.slow
def test_a_fisheye_is_given_distortion():
    tracks, truth = scene("orbit", seed=3)
    r = np.linalg.norm((tracks.uv - CENTRE) / CAMERA.params[0], axis=-1)[:, None]
    model = model_of(about_centre(tracks, np.arctan(r) / r), GUESS)
    assert len(model.intrinsics.params) == 8 and model.intrinsics.params[4] < -0.15
    assert camera_error(model.found.T_WC, truth) < 0.02
    assert any("distorted" in text for text in model.warnings)


def test_keypoints_and_bodies_lose_the_zoom_too():
    zoom = np.log([1.0, 1.2])
    rng = np.random.default_rng(0)
    uv = rng.uniform(0, 200, (1, 2, 25, 2))
    confidence = np.ones((1, 2, 25))
    confidence[0, 1, 3], uv[0, 1, 3] = 0.0, 0.0
    trans = np.array([[[0.5, 0.2, 4.0], [0.5, 0.2, 4.0]]])
    bodies = Bodies(
        np.ones((1, 2), bool), np.zeros((1, 2, 72)), np.zeros((1, 2, 10)), trans
    )
    people = Keypoints(uv, confidence)
    sequence = Sequence("z", None, np.arange(2) / 30, CAMERA, people, bodies)
    found = with_intrinsics(sequence, CAMERA.params, zoom)
    assert found.keypoints is not None and found.bodies is not None
    np.testing.assert_allclose(found.keypoints.uv[0, 0], uv[0, 0])
    expected = CENTRE + (uv[0, 1] - CENTRE) / 1.2
    expected[3] = 0.0
    np.testing.assert_allclose(found.keypoints.uv[0, 1], expected)
    project = lambda p: CAMERA.params[:2] * p[:2] / p[2]
    now, before = project(found.bodies.trans[0, 1]), project(trans[0, 1])
    np.testing.assert_allclose(now, before / 1.2)


def test_images_lose_the_zoom_about_the_centre():
    image = np.zeros((240, 320), np.uint8)
    cv2.circle(image, (240, 120), 4, 255, -1)
    (seen,) = without_zoom([image], np.log([2.0]), CENTRE)
    where = np.argwhere(seen > 100).mean(axis=0)
    expected = 0.5 * (np.array([120.0, 240.0]) + CENTRE[::-1])
    np.testing.assert_allclose(where, expected, atol=0.7)


def with_traffic(tracks, count):
    """Things that all go the same way across the lower part of the image."""
    rng = np.random.default_rng(5)
    rows, first = [], tracks.landmark.max() + 1
    for i in range(count):
        start, y = rng.integers(0, 44), rng.uniform(120, 220)
        place = np.array([rng.uniform(10, 200), y])
        for k in range(start, start + 16):
            place = place + [7.0, -2.0 * np.sin(0.1 * k)]
            if place[0] < SIZE[0] - 3:
                rows.append((k, first + i, *place))
    more = np.array(rows)
    return Tracks(
        np.concatenate([tracks.frame, more[:, 0].astype(int)]),
        np.concatenate([tracks.landmark, more[:, 1].astype(int)]),
        np.concatenate([tracks.uv, more[:, 2:]]),
    )


@pytest.mark.slow
def test_traffic_is_warned_of_and_a_scene_alone_is_not():
    tracks, _ = scene("turn", seed=3)
    both = with_traffic(tracks, 120)
    alone = reconstruct(tracks, CAMERA, 60)
    crowded = reconstruct(both, CAMERA, 60)
    assert second_motion_warning(tracks, alone, CAMERA) is None
    assert "move together" in (second_motion_warning(both, crowded, CAMERA) or "")


@pytest.mark.slow
def test_a_cut_within_one_scene_is_said():
    tracks, _ = scene("sideways", seed=3)
    # The same points are seen beyond the cut, as after it they are found again.
    beyond = tracks.frame >= 45
    kept = beyond | (tracks.frame < 30)
    fresh = tracks.landmark.max() + 1
    late = beyond & (tracks.frame < 48)  # not found again at once
    landmark = np.where(late, tracks.landmark + fresh, tracks.landmark)
    frame = np.where(beyond, tracks.frame - 15, tracks.frame)
    _, landmark = np.unique(landmark[kept], return_inverse=True)
    cut = Tracks(frame[kept], landmark, tracks.uv[kept])
    found = reconstruct(cut, CAMERA, 45)
    assert any("cut" in text and "30" in text for text in found.warnings)
    assert not reconstruct(tracks, CAMERA, 60).warnings
