"""The front end of the estimate while a video runs: map, points, people."""

import cv2
import numpy as np
import pytest
from passing_camera import CAMERA, passing

import bodyslam_jax as bs
from bodyslam_jax import simulation
from bodyslam_jax.config import Simulation
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.io.camera.calibration import as_opencv, project_points, rays
from bodyslam_jax.people.filter import PersonFilter
from bodyslam_jax.people.live import LivePeople
from bodyslam_jax.sfm import multiview
from bodyslam_jax.sfm.live_map import LiveMap
from bodyslam_jax.sfm.live_tracks import PointFollower
from bodyslam_jax.sfm.places import Place
from bodyslam_jax.types import Intrinsics


def test_a_map_grows_from_two_views_and_locates_every_frame():
    scene, truth, found = LiveMap(CAMERA, 0.02), [], []
    for T, ids, uv in passing(90, np.random.default_rng(0)):
        truth.append(T)
        if scene.begun:
            found.append(scene.locate(ids, uv))
        elif (poses := scene.begin(ids, uv)) is not None:
            found = [*poses]
    assert len(found) == len(truth) and all(T is not None for T in found)
    true, centre = (np.array(x)[:, :3, 3] for x in (truth, found))
    ratio = np.linalg.norm(true[-1] - true[0]) / np.linalg.norm(centre[-1] - centre[0])
    turn = truth[0][:3, :3] @ found[0][:3, :3].T
    away = (centre - centre[0]) @ turn.T * ratio - (true - true[0])
    assert np.linalg.norm(away, axis=1).max() < 0.05  # m, of 4.5 m


def test_rounding_of_one_pose_is_not_in_the_next():
    """A guess is made of two poses: their rounding would be extrapolated and grow."""
    scene = LiveMap(CAMERA, 0.02)
    for _, ids, uv in passing(60, np.random.default_rng(0)):
        if not scene.begun:
            scene.begin(ids, uv)
            continue
        scene.T_WC[:3, :3] *= 1 + 1e-9
        T = scene.locate(ids, uv)
        assert T is not None
        assert np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() < 1e-12


def around(turn: float, way: float, frames: int):
    """Pixels, with noise of 0.5 px, of points all around a camera that turns (rad a
    frame) and moves sideways (m a frame), in each frame."""
    rng = np.random.default_rng(1)
    azimuth, depth = rng.uniform(-np.pi, np.pi, 800), rng.uniform(3, 8, 800)
    across = rng.uniform(-0.45, 0.45, 800)
    points = depth[:, None] * np.column_stack(
        [np.sin(azimuth), across, np.cos(azimuth)]
    )
    for k in range(frames):
        p_C = (points - [way * k, 0, 0]) @ so3.exp(np.array([0.0, turn * k, 0.0]))
        uv = project_points(CAMERA, p_C) + 0.5 * rng.standard_normal((800, 2))
        inside = (p_C[:, 2] > 0.5) & (uv > 0).all(1) & (uv < [640, 480]).all(1)
        yield np.flatnonzero(inside), uv[inside]


def off_by(factor: float) -> LiveMap:
    """A map that is sought with a guessed focal length."""
    params = CAMERA.params * [factor, factor, 1, 1]
    return LiveMap(Intrinsics(params, 640, 480, is_guess=True), 0.2)


@pytest.mark.parametrize("factor", [0.8, 0.9, 1.0, 1.1, 1.2])
def test_a_camera_that_only_turns_begins_no_map(factor):
    """Whatever the error of the guessed focal length: a rotation with another one
    explains the tracks as well as a translation does."""
    for turn in (0.004, 0.012):  # 21 and 62 degrees
        scene = off_by(factor)
        for ids, uv in around(turn, 0.0, 90):
            assert scene.begin(ids, uv) is None
        assert not scene.begun


@pytest.mark.parametrize("factor", [0.8, 1.0, 1.2])
def test_a_camera_that_moves_begins_a_map_within_two_seconds(factor):
    for turn in (0.0, 0.012):
        scene = off_by(factor)
        begun = (scene.begin(*seen) is not None for seen in around(turn, 0.005, 60))
        assert any(begun)


def towards(way: float, frames: int):
    """Pixels, with noise of 0.5 px, of points in front of a camera that moves along its
    view (m a frame): three quarters of them 15 to 60 m away, the others 4 to 8 m."""
    rng = np.random.default_rng(2)
    depth = np.concatenate([rng.uniform(15, 60, 240), rng.uniform(4, 8, 80)])
    rays = rng.uniform([-0.5, -0.4], [0.5, 0.4], (320, 2))
    points = depth[:, None] * np.column_stack([rays, np.ones(320)])
    for k in range(frames):
        p_C = points - [0, 0, way * k]
        uv = project_points(CAMERA, p_C) + 0.5 * rng.standard_normal((320, 2))
        inside = (p_C[:, 2] > 0.5) & (uv > 0).all(1) & (uv < [640, 480]).all(1)
        yield np.flatnonzero(inside), uv[inside]


def test_a_camera_that_moves_along_its_view_is_told_from_one_that_turns():
    """Its points have little parallax however far it goes: a map begins with those that
    have some, once it is known that no other ones come."""
    scene = off_by(0.9)
    views = list(towards(0.02, 110))
    for ids, uv in views[:100]:
        assert scene.begin(ids, uv) is None
    assert scene.moving
    scene.forwards = True
    poses = next(found for v in views[100:] if (found := scene.begin(*v)) is not None)
    way = np.array([pose[:3, 3] for pose in poses if pose is not None])
    assert len(way) > 90
    assert (way[-1] - way[0])[2] > 5 * np.abs((way[-1] - way[0])[:2]).max()


def test_a_rotation_tells_the_focal_length_that_explains_it():
    views = list(around(0.012, 0.0, 40))
    (ids_a, a), (ids_b, b) = views[0], views[-1]
    _, i, j = np.intersect1d(ids_a, ids_b, return_indices=True)
    for factor in (0.8, 1.2):
        xy = ((uv - [319.5, 239.5]) / (525 * factor) for uv in (a[i], b[j]))
        pixel = 1 / (525 * factor)
        found, away = multiview.turn_with_focal(*xy, pixel, 0.2)
        assert found * factor == pytest.approx(1.0, abs=0.02)
        # The length of two errors of 0.5 px has a median of 0.59 px.
        assert np.median(away) / pixel == pytest.approx(0.59, abs=0.1)


def textured(rng: np.random.Generator) -> np.ndarray:
    noise = rng.uniform(0, 255, (60, 80)).astype(np.float32)
    return cv2.resize(noise, (640, 480), interpolation=cv2.INTER_CUBIC)


def test_points_follow_the_image_and_leave_people_out():
    image = np.clip(textured(np.random.default_rng(0)), 0, 255).astype(np.uint8)
    follower = PointFollower(CAMERA, 100)
    mask = np.zeros((480, 640), np.uint8)
    mask[100:300, 200:300] = 255
    ids, before = follower.advance(image, mask)
    assert len(ids) > 60
    assert (mask[tuple(np.rint(before).astype(int)[:, ::-1].T)] == 0).all()
    shifted = cv2.warpAffine(image, np.array([[1, 0, 4.0], [0, 1, -3.0]]), (640, 480))
    later, after = follower.advance(shifted, None)
    _, i, j = np.intersect1d(ids, later, return_indices=True)
    assert len(i) > 50
    assert np.abs(np.median(after[j] - before[i], axis=0) - [4, -3]).max() < 0.1


def test_a_place_is_recognised_and_a_dark_image_has_no_points():
    image = np.clip(textured(np.random.default_rng(2)), 0, 255).astype(np.uint8)
    follower = PointFollower(CAMERA, 200)
    follower.advance(image, None)
    corners, _ = follower.orb.detectAndCompute(image, None)
    follower.ids = np.arange(len(corners))
    follower.uv = np.array([c.pt for c in corners])
    follower.step = np.zeros_like(follower.uv)
    T_WC = np.eye(4)
    T_WC[:3, 3] = 1.0, 2.0, 3.0
    xy = rays(follower.uv, *as_opencv(CAMERA.params))
    p_C = 4.0 * np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    place = follower.describe(dict(enumerate(p_C + T_WC[:3, 3])), T_WC)
    assert place is not None and place.depth == pytest.approx(4.0)
    assert follower.describe({}, T_WC) is None
    follower.advance(np.zeros_like(image), None)
    assert len(follower.ids) == 0
    dark = Place(place.descriptors[:5], place.points[:5])
    found = follower.recognise(image, [dark, place])
    assert found is not None and found[0] is place
    away = project_points(CAMERA, found[1]) - found[2]
    assert np.median(np.linalg.norm(away, axis=1)) < 2.0  # px


# People.


def walker(u: float) -> np.ndarray:
    """Keypoints of somebody 200 px high at a column of the image."""
    rng = np.random.default_rng(5)
    points = np.column_stack(
        [u + rng.uniform(-40, 40, 25), rng.uniform(150, 350, 25), np.full(25, 0.9)]
    )
    return points


def test_people_keep_their_numbers_in_any_order_and_after_a_gap():
    people = LivePeople(fps=30.0)
    numbers: list[tuple[int, int]] = []
    for k in range(60):
        if 30 <= k < 40:
            assert people.given(np.zeros((0, 25, 3)), k / 30) == {}
            continue
        both = [walker(150 + 2 * k), walker(450 - k)]
        order = [0, 1] if k % 2 else [1, 0]
        found = people.given(np.array([both[i] for i in order]), k / 30)
        by_place = {round(x[:, 0].mean()) < 300: n for n, x in found.items()}
        if k > 10 and len(by_place) == 2:
            numbers.append((by_place[True], by_place[False]))
    assert len(numbers) > 30 and set(numbers) == {numbers[0]}


@pytest.mark.slow
def test_the_filter_follows_a_walker_from_frame_to_frame():
    made = simulation.simulate(Simulation(sequence="E1", length=60, noise="low"))
    sequence, truth = simulation.as_sequence(made), simulation.as_truth(made)
    body = bs.load_body_model()
    one = PersonFilter(sequence.intrinsics, body, 30.0)
    keypoints = sequence.keypoints
    away = []
    for k in range(60):
        points = np.column_stack([keypoints.uv[0, k], keypoints.confidence[0, k]])
        found = one.update(k / 30, points, truth.betas[0])
        assert found is not None
        pelvis = truth.joints[0, k, 0] - truth.T_WC[k, :3, 3]
        away.append(found.T_CH[:3, 3] - truth.T_WC[k, :3, :3].T @ pelvis)
    across = np.linalg.norm(np.array(away)[20:, :2], axis=1)
    assert np.median(across) < 0.03  # m; depths err by the focal length over a size
    assert np.median(np.abs(np.array(away)[20:, 2])) < 0.25
