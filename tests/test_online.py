"""The estimate while a video runs: parts that need no window, and all of it (slow)."""

import json
import signal
import threading
import time
import urllib.request
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bodyslam_jax as bs
from bodyslam_jax import evaluation, graph, simulation
from bodyslam_jax.cli import interrupts
from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.graph import CHUNK
from bodyslam_jax.io.camera.calibration import project_points
from bodyslam_jax.io.capture import Capture
from bodyslam_jax.online import maps
from bodyslam_jax.online import prior as priors
from bodyslam_jax.online.online import SMOOTHED
from bodyslam_jax.online.record import smoothed_scales
from bodyslam_jax.online.window import SCALE_WALK, Window
from bodyslam_jax.online.window_content import FRAMES, Measured
from bodyslam_jax.people.filter import PersonFilter
from bodyslam_jax.people.live import LivePeople
from bodyslam_jax.sfm import multiview
from bodyslam_jax.sfm.live_map import LiveMap
from bodyslam_jax.sfm.live_tracks import PointFollower
from bodyslam_jax.types import Intrinsics, Result, Sequence
from bodyslam_jax.view.live_page import LivePage
from bodyslam_jax.view.serve import address_of

CAMERA = Intrinsics(np.array([525.0, 525.0, 319.5, 239.5]), 640, 480)


# The front end.


def passing(frames: int, rng: np.random.Generator):
    """A camera that passes 300 points, 5 cm a frame: poses and pixels."""
    points = rng.uniform([-6, -2, 3], [9, 2, 8], (300, 3))
    for k in range(frames):
        T = np.eye(4)
        T[:3, :3] = so3.exp(np.array([0.0, 0.002 * k, 0.0]))
        T[:3, 3] = [0.05 * k, 0.01 * np.sin(k / 3), 0.0]
        p_C = (points - T[:3, 3]) @ T[:3, :3]
        uv = project_points(CAMERA, p_C)
        seen = (p_C[:, 2] > 0.5) & (uv > 0).all(1) & (uv < [640, 480]).all(1)
        noise = 0.3 * rng.standard_normal(uv.shape)
        yield T, np.flatnonzero(seen), (uv + noise)[seen]


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
    known = {i: np.append(follower.uv[i], 1.0) for i in follower.ids.tolist()}
    follower.remember(known)
    follower.advance(np.zeros_like(image), None)
    assert len(follower.ids) == 0
    found = follower.recognise(image)
    assert found is not None
    points, uv = found
    assert np.median(np.linalg.norm(points[:, :2] - uv, axis=1)) < 2.0  # px


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
            assert people.given(np.zeros((0, 25, 3))) == {}
            continue
        both = [walker(150 + 2 * k), walker(450 - k)]
        order = [0, 1] if k % 2 else [1, 0]
        found = people.given(np.array([both[i] for i in order]))
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


# The prior of a window.


def random_prior(frames: int, people: int, rng: np.random.Generator):
    state = graph.State(
        scale=jnp.asarray(1.5),
        cameras=jnp.asarray(np.tile(np.eye(4), (frames, 1, 1))),
        roots=jnp.asarray(np.tile(np.eye(4), (people, frames, 1, 1))),
        poses=jnp.zeros((people, frames, 23, 3)),
        shapes=jnp.zeros((people, 10)),
        landmarks=jnp.zeros((0, 3)),
        intrinsics=jnp.asarray(CAMERA.params),
    )
    prior = priors.no_prior(state, frames, 2)
    size = len(prior.offset)
    root = jnp.asarray(rng.standard_normal((size, size)))
    offset = jnp.asarray(rng.standard_normal(size))
    return state, graph.MarginalPrior(
        root=root,
        offset=offset,
        estimate=prior.estimate,
        anchor=prior.anchor,
        invariant=prior.invariant,
        reach=2,
    )


def mean_and_covariance(prior: graph.MarginalPrior):
    matrix, slope = priors.information(prior)
    covariance = np.linalg.inv(matrix)
    return -covariance @ slope, covariance


def test_a_walk_of_the_scale_adds_variance_to_it_alone():
    _, prior = random_prior(12, 1, np.random.default_rng(0))
    mean, covariance = mean_and_covariance(prior)
    walked = priors.with_walk_of_scale(prior, 0.7)
    after, wider = mean_and_covariance(walked)
    covariance[0, 0] += 0.7
    assert np.abs(wider - covariance).max() < 1e-7 * np.abs(covariance).max()
    assert np.abs(after - mean).max() < 1e-6


def test_people_who_go_leave_what_they_told_of_the_rest():
    _, prior = random_prior(12, 2, np.random.default_rng(1))
    mean, covariance = mean_and_covariance(prior)
    rest = priors.without_person(prior, 0)
    matrix, slope = priors.information(rest)
    gone = np.diag(matrix) < 1e-12
    assert gone.sum() == 10 + 2 * 6 + 69
    kept = ~gone
    inverse = np.linalg.inv(matrix[np.ix_(kept, kept)])
    expected = covariance[np.ix_(kept, kept)]
    assert np.abs(inverse - expected).max() < 1e-6 * np.abs(expected).max()
    assert np.abs(-inverse @ slope[kept] - mean[kept]).max() < 1e-6


def test_a_padded_prior_costs_what_it_did():
    rng = np.random.default_rng(2)
    state, prior = random_prior(15, 1, rng)
    longer, _ = random_prior(20, 1, rng)
    wide = priors.padded(prior, longer, 20)
    assert wide.frames == 20
    # Whatever the five frames are that it knows nothing of.
    moved = graph.retract_pose(
        longer.cameras, jnp.asarray(0.1 * rng.standard_normal((20, 6)))
    )
    there = graph.State(**{**vars(longer), "cameras": moved})
    here = graph.State(**{**vars(state), "cameras": moved[:15]})
    costs = [float(p.cost(x)) for p, x in ((wide, there), (prior, here))]
    assert abs(costs[0] - costs[1]) < 1e-9 * costs[1]


def test_scales_of_all_windows_are_those_of_a_dense_smoother():
    rng = np.random.default_rng(0)
    frames, fps = np.arange(0, 100, 10), 10.0
    told, mean, variance = [], 2.0, 0.04
    walks, measured = [], []
    for k in range(len(frames)):
        if k:
            walks.append((SCALE_WALK * mean) ** 2 * 10 / fps)
            variance += walks[-1]
        z = 2.0 + 0.05 * rng.standard_normal()
        gain = variance / (variance + 0.01)
        mean, variance = mean + gain * (z - mean), (1 - gain) * variance
        measured.append(z)
        told.append((int(frames[k]), mean, variance**0.5))
    _, found, sigma = smoothed_scales([(-10, 1.0, float("nan")), *told], fps)
    n = len(frames)
    matrix, right = np.eye(n) / 0.01, np.array(measured) / 0.01
    matrix[0, 0] += 1 / 0.04
    right[0] += 2.0 / 0.04
    for k, walk in enumerate(walks):
        matrix[k : k + 2, k : k + 2] += np.array([[1, -1], [-1, 1]]) / walk
    assert np.abs(found - np.linalg.solve(matrix, right)).max() < 1e-4
    assert sigma == pytest.approx(told[-1][2])


# Source, page, command.


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    path = tmp_path_factory.mktemp("live") / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (64, 48))
    for k in range(24):
        writer.write(np.full((48, 64, 3), 10 * k, np.uint8))
    writer.release()
    return path


def test_a_file_runs_at_its_own_pace_and_the_newest_image_wins(clip):
    capture = Capture(str(clip))
    assert capture.fps == pytest.approx(30) and capture.size == (64, 48)
    begun = time.monotonic()
    capture.start()
    found = []
    while (image := capture.newest(timeout=5.0)) is not None:
        found.append(image)
        time.sleep(0.1)  # slower than the source
    capture.close()
    assert capture.ended
    assert 0.7 < time.monotonic() - begun < 3.0
    indices = [image.index for image in found]
    assert indices == sorted(set(indices))
    assert len(found) + capture.dropped == 24 and capture.dropped > 5
    assert [i.timestamp for i in found] == pytest.approx([k / 30 for k in indices])


def test_a_file_waits_for_who_wants_every_frame_of_it(clip):
    capture = Capture(str(clip), every=True)
    assert capture.length == 24
    capture.start()
    found = []
    while (image := capture.newest(timeout=5.0)) is not None:
        found.append(image)
        time.sleep(0.05)  # slower than the source
    capture.close()
    assert capture.dropped == 0
    assert [image.index for image in found] == list(range(24))
    assert [i.timestamp for i in found] == pytest.approx([k / 30 for k in range(24)])
    with pytest.raises(InputError, match="--every-frame: 0 is no file"):
        Capture("0", every=True)


def test_a_file_that_waits_can_be_closed_before_its_end(clip):
    capture = Capture(str(clip), every=True)
    capture.start()
    assert capture.newest(timeout=5.0) is not None
    capture.close()  # the thread waits to be relieved of the second image
    assert capture.ended


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("nowhere.mp4", "nowhere.mp4: no such file"),
        ("97", "97: this camera cannot be opened"),
    ],
)
def test_a_source_that_is_none_is_told_in_one_line(source, words):
    with pytest.raises(InputError, match=words) as error:
        Capture(source)
    assert "\n" not in str(error.value)


def test_the_page_shows_the_newest_state_to_this_machine_only():
    page = LivePage()
    try:
        joints = np.random.default_rng(0).standard_normal((24, 3))
        image = np.zeros((48, 64, 3), np.uint8)
        people = [(0, np.full((24, 2), 20.0), joints)]
        for k in range(3):
            T_WC = np.eye(4)
            T_WC[0, 3] = k
            figures = {"figures": {"status": "tracking"}, "notes": ["<b>a note"]}
            page.show(image, np.zeros((2, 2)), people, T_WC, figures)
        address = address_of(page.server)
        assert address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(address + "state.json") as answer:
            state = json.load(answer)
        assert [p[0] for p in state["paths"]["camera"]] == [0, 1, 2]
        assert state["figures"] == {"status": "tracking"}
        with urllib.request.urlopen(address + "picture.jpg") as answer:
            found = np.frombuffer(answer.read(), np.uint8)
        assert cv2.imdecode(found, cv2.IMREAD_COLOR).shape == image.shape
        with urllib.request.urlopen(address) as answer:
            assert b"textContent" in answer.read()  # notes are text, never markup
        foreign = urllib.request.Request(address, headers={"Host": "evil.example"})
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(foreign)
        assert refused.value.code == 421
        refused.value.close()
    finally:
        page.close()


def test_paths_on_the_page_stay_short():
    page = LivePage()
    try:
        for k in range(3000):
            page.paths.setdefault("camera", type_of_path()).add(np.full(3, float(k)))
        points = page.paths["camera"].points
        assert len(points) <= 600 and points[0][0] == 0 and points[-1][0] > 2900
    finally:
        page.close()


def type_of_path():
    from bodyslam_jax.view import live_page

    return live_page.Path()


def test_the_first_interrupt_ends_the_source_and_the_second_the_command():

    if threading.current_thread() is not threading.main_thread():
        pytest.skip("signals come to the main thread")
    # A worker of the tests ignores it.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        _interrupted_twice()
    finally:
        signal.signal(signal.SIGINT, before)


def _interrupted_twice():

    with pytest.raises(KeyboardInterrupt), interrupts.as_event() as stop:
        assert not stop.is_set()
        signal.raise_signal(signal.SIGINT)
        assert stop.is_set()
        signal.raise_signal(signal.SIGINT)
    with interrupts.as_event() as stop:
        pass
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_what_update_and_finish_refuse():
    with pytest.raises(InputError, match="fps"):
        bs.Online(fps=0.0)
    with pytest.raises(InputError, match="places"):
        bs.Online(places=0)
    online = bs.Online(threads=False)
    with pytest.raises(InputError, match="intrinsics"):
        online.update(None, 0.0)
    with pytest.raises(InputError, match="0 frames"):
        online.finish()


# All of it.


def play(online: bs.Online, sequence: Sequence, frames, twice=()):
    tracks, keypoints = sequence.tracks, sequence.keypoints
    for k in frames:
        at = tracks.frame == k
        points = tracks.landmark[at], tracks.uv[at]
        found = np.concatenate(
            [keypoints.uv[:, k], keypoints.confidence[:, k, :, None]], axis=-1
        )
        given = float(sequence.timestamps[k]), found
        yield online.update(None, *given, points=points)
        if k in twice:
            yield online.update(None, *given, points=points)


@pytest.fixture(scope="module")
def walk() -> tuple[Sequence, Result]:
    made = simulation.simulate(Simulation(sequence="M2", family="follow", length=150))
    return simulation.as_sequence(made), simulation.as_truth(made)


@pytest.mark.slow
def test_the_estimate_of_a_simulated_walk(walk):
    sequence, truth = walk
    given = {"intrinsics": sequence.intrinsics, "fps": 30.0}
    online = bs.Online(**given, threads=False, smooth=True)
    estimates = list(play(online, sequence, range(150), twice=(100,)))
    assert len(estimates) == 151
    late = [e for e in estimates if e.status == "late"]
    assert [e.timestamp for e in late] == [pytest.approx(100 / 30)]
    assert estimates[0].status == "starting" and estimates[-1].status == "tracking"
    assert np.isnan(estimates[0].scale_sigma)
    assert any("scale unknown" in note for note in estimates[0].notes)
    last = estimates[-1]
    assert last.scale_sigma < 0.1 * last.scale
    assert len(last.people) == 1 and abs(last.people[0].joints[[7, 8], 1].min()) < 0.25
    # What is in the window and what waits for it does not grow with time.
    assert len(online.slots.front) <= FRAMES and len(online.slots.waiting) < 10
    result = online.finish()
    found = evaluation.evaluate(result, truth, online.body)
    assert float(found["c_ate_se3"]) < 0.05
    assert float(found["h_ate_se3"]) < 0.08
    assert abs(float(found["scale"]) - 1) < 0.05
    assert result.present[0].mean() > 0.9
    assert len(result.timestamps) == 150
    assert "1 frames came late" in " ".join(result.summary["warnings"])
    with pytest.raises(InputError, match="finished"):
        online.update(None, 99.0)
    smooth = online.smooth()
    assert any(SMOOTHED in line for line in smooth.summary["warnings"])
    assert len(smooth.timestamps) == 150
    last = evaluation.evaluate(smooth, truth, online.body)
    assert float(last["c_ate_se3"]) < 0.03
    assert float(last["j_ate_se3"]) < float(found["j_ate_se3"])


@pytest.mark.slow
def test_a_lost_camera_is_told_and_a_new_map_begins(walk):
    sequence, _ = walk
    online = bs.Online(intrinsics=sequence.intrinsics, fps=30.0, threads=False)
    states = [e.status for e in play(online, sequence, range(60))]
    assert states[-1] == "tracking"
    nothing = np.zeros(0, int), np.zeros((0, 2))
    for k in range(60, 75):
        now = online.update(None, k / 30, np.zeros((0, 25, 3)), points=nothing)
        assert now.status == "lost" and not now.located
        assert np.isfinite(now.T_WC).all()
    result = online.finish()
    assert np.isfinite(result.T_WC).all() and np.isfinite(result.joints).all()
    assert "lost 1 times" in " ".join(result.summary["warnings"])


class LatePool:
    """A second thread whose first window is there after `delay` s of the video."""

    def __init__(self, delay: float) -> None:
        self.delay, self.now, self.due = delay, 0.0, 0.0
        self.taken: list[int] = []

    def submit(self, function, frames):
        self.found, self.due = function(frames), self.now + self.delay
        self.taken.append(len(frames))
        self.delay = 0.0
        return self

    def done(self) -> bool:
        return self.now >= self.due

    def result(self):
        return self.found

    def shutdown(self) -> None:
        pass


@pytest.fixture(scope="module")
def long_walk() -> tuple[Sequence, Result]:
    made = simulation.simulate(Simulation(sequence="M2", family="follow", length=240))
    return simulation.as_sequence(made), simulation.as_truth(made)


def late(sequence: Sequence, delay: float) -> tuple[bs.Online, LatePool]:
    online = bs.Online(intrinsics=sequence.intrinsics, fps=30.0, threads=False)
    online.prepare()
    pool: Any = LatePool(delay)
    online.pool = pool
    return online, pool


def play_late(online: bs.Online, pool: LatePool, sequence: Sequence) -> None:
    updates = play(online, sequence, range(sequence.num_frames))
    for timestamp, _ in zip(sequence.timestamps[1:], updates, strict=False):
        pool.now = float(timestamp)


@pytest.mark.slow
def test_a_window_mends_what_came_while_it_was_busy():
    """The front end's unit grows by 5 % after the first ten frames."""
    window = Window(CAMERA, bs.load_body_model(), Config(), 10.0, 1)
    frames, truth = [], []
    for k, (T, ids, uv) in enumerate(passing(70, np.random.default_rng(3))):
        drifted = T.copy()
        drifted[0, 3] += 0.05 * max(T[0, 3] - 0.05 * (CHUNK - 1), 0.0)
        frames.append(Measured(k / 10, drifted, True, ids, uv, {}))
        truth.append(T[:3, 3])
    found = {}
    for part in (frames[:CHUNK], frames[CHUNK:]):
        for solved in window.advance(part):
            centres = solved.T_WC[CHUNK:, :3, 3]
            found |= dict(enumerate(centres, start=solved.first + CHUNK))
    assert sorted(found) == list(range(70))
    step = lambda x: np.linalg.norm(x[5:] - x[:-5], axis=1)
    ratio = step(np.array([found[k] for k in range(70)])) / step(np.array(truth))
    # Where a map is cut, the path jumps: by 20 % here.
    assert ratio.max() < 1.08 * ratio.min()


@pytest.mark.slow
def test_a_late_window_takes_all_in_and_compiles_nothing(long_walk):
    sequence, truth = long_walk
    online, pool = late(sequence, 7.0)
    compiled: list[str] = []

    def listen(event, seconds, **about):
        if event.endswith("backend_compile_duration"):
            compiled.append(str(about.get("fun_name")))

    jax.monitoring.register_event_duration_secs_listener(listen)
    play_late(online, pool, sequence)
    jax.monitoring.unregister_event_duration_listener(listen)
    assert max(pool.taken) > FRAMES - CHUNK  # some of them came and went meanwhile
    assert compiled == []
    result = online.finish()
    found = evaluation.evaluate(result, truth, online.body)
    assert float(found["c_ate_sim3"]) < 0.03  # m
    assert abs(float(found["scale"]) - 1) < 0.05


@pytest.mark.slow
def test_a_window_that_is_too_late_goes_on_at_the_newest_frames(walk, monkeypatch):
    sequence, truth = walk
    monkeypatch.setattr(maps, "_MAX_WAITING_FRAMES", 2 * CHUNK)
    online, pool = late(sequence, 3.0)
    play_late(online, pool, sequence)
    assert max(pool.taken) <= 2 * CHUNK
    result = online.finish()
    assert "were not in the graph" in " ".join(result.summary["warnings"])
    assert online.counts.skipped >= 10
    # The path between is that of the map alone; its unit is kept, and s with it.
    found = evaluation.evaluate(result, truth, online.body)
    assert float(found["c_ate_sim3"]) < 0.1  # m
    assert abs(float(found["scale"]) - 1) < 0.1
