"""People found by the networks that ship: decoding, rendered walkers, and failures."""

import dataclasses
import socket
from pathlib import Path

import cv2
import numpy as np
import pytest

from bodyslam_jax import io, people, pipeline, sfm, simulation
from bodyslam_jax.config import Config, Detect, Simulation
from bodyslam_jax.people import blazepose, movenet, networks
from bodyslam_jax.people import found as found_
from bodyslam_jax.pipeline import people_stage
from bodyslam_jax.pipeline.progress import Stopwatch
from bodyslam_jax.pipeline.stage_cache import Cache
from bodyslam_jax.sfm.person_mask import person_masks
from bodyslam_jax.types import Bodies, Intrinsics, Sequence

FRAMES = 12


@pytest.fixture(scope="module")
def scene():
    """A walker whom a camera goes along with, without errors, and the images."""
    simulated = simulation.simulate(
        Simulation(sequence="E1", family="follow", length=FRAMES, noise="none", seed=2)
    )
    return simulated, list(simulation.render(simulated))


@pytest.fixture(scope="module")
def found(scene):
    return people.find_people_tracked(scene[1], 30.0)


def sequence(images):
    rows, columns = images[0].shape[:2]
    camera = Intrinsics(np.array([500.0, 500, columns / 2, rows / 2]), columns, rows)
    return Sequence("walk", None, np.arange(len(images)) / 30, camera)


def test_a_rendered_walker_is_found_in_every_frame(scene, found):
    simulated, images = scene
    points, who = found.by_frame(FRAMES)
    assert [p.tolist() for p in who] == [[0]] * FRAMES
    uv, _ = simulated.keypoints
    truth = np.asarray(uv).reshape(FRAMES, 25, 2)
    points = np.concatenate(points)
    height = np.ptp(truth[..., 1], axis=1).mean()
    # Wrists, knees and ankles, of which COCO and SMPL have the same idea.
    joints = [4, 7, 10, 11, 13, 14]
    away = np.linalg.norm(points[:, joints, :2] - truth[:, joints], axis=-1)
    assert np.median(away) < 0.03 * height
    assert (points[:, joints, 2] > 0.3).mean() > 0.8
    feet = points[:, [19, 21, 22, 24]]
    away = np.linalg.norm(feet[..., :2] - truth[:, [19, 21, 22, 24]], axis=-1)
    assert (feet[..., 2] > 0).mean() > 0.7
    assert np.median(away[feet[..., 2] > 0]) < 0.06 * height


def test_the_same_images_give_the_same_people(scene, found):
    again = people.find_people_tracked(scene[1], 30.0)
    for name in ("frame", "points", "person", "silhouettes"):
        np.testing.assert_array_equal(getattr(again, name), getattr(found, name))


def test_no_connection_is_made(scene, monkeypatch):
    def refused(*args, **kwargs):
        raise OSError("a connection")

    monkeypatch.setattr(socket, "socket", refused)
    monkeypatch.setattr(socket, "getaddrinfo", refused)
    assert len(people.find_people_tracked(scene[1][:2], 30.0).frame) == 2


def test_silhouettes_cover_the_body(scene, found):
    """The mask that keeps people out of the map: of the silhouettes by themselves, and
    with the capsules around keypoints."""
    simulated, images = scene
    size = images[0].shape[:2]
    G, x = simulated.person.joints(simulated.walk.poses, simulated.walk.pelvis)
    vertices = simulated.person.vertices(G[3], x[3])
    body = simulated.T_WC[3]
    p = (vertices - body[:3, 3]) @ body[:3, :3]
    fx, fy, cx, cy = simulated.intrinsics[:4]
    uv = np.stack([fx * p[:, 0] / p[:, 2] + cx, fy * p[:, 1] / p[:, 2] + cy], axis=1)
    column, row = np.round(uv).astype(int).T
    inside = (column >= 0) & (row >= 0) & (column < size[1]) & (row < size[0])
    step = sfm.SILHOUETTE_STEP
    small = np.unpackbits(found.silhouettes[3], axis=1)
    assert small[row[inside] // step, column[inside] // step].mean() > 0.85
    whole = with_people(images, found)
    mask = list(person_masks(whole, 0.06))[3]
    assert mask[row[inside], column[inside]].astype(bool).mean() > 0.98
    assert (mask > 0).mean() < 4 * (small > 0).mean()


def with_people(images, found, **changes):
    start = dataclasses.replace(sequence(images), **changes)
    points, person = found.by_frame(len(images))
    return io.with_detections(start, points, person=person, detected=found.detected())


def test_people_become_keypoints_and_everybody_is_seen(scene, found):
    whole = with_people(scene[1], found)
    assert whole.keypoints.uv.shape == (1, FRAMES, 25, 2)
    assert len(whole.detected.frame) == len(found.frame)


def test_who_has_no_body_is_not_estimated_where_bodies_are_given(scene, found):
    """Bodies of somebody who is elsewhere in the image: they stay, the walker goes."""
    trans = np.tile([30.0, 0.0, 4.0], (1, FRAMES, 1))
    bodies = Bodies(
        np.ones((1, FRAMES), bool),
        np.zeros((1, FRAMES, 72)),
        np.zeros((1, FRAMES, 10)),
        trans,
    )
    whole = with_people(scene[1], found, bodies=bodies)
    np.testing.assert_array_equal(whole.bodies.trans, trans)
    assert not whole.keypoints.confidence.any()
    assert "1 more people were found than the 1" in whole.warnings[-1]


def test_who_is_too_small_is_masked_only(scene):
    settings = Detect(min_height=2000.0)
    found = people.find_people_tracked(scene[1][:4], 30.0, settings)
    assert len(found.frame) and (found.person == -1).all()
    whole = with_people(scene[1][:4], found)
    assert whole.keypoints is None and "nobody was found" in whole.warnings[-1]
    assert next(iter(person_masks(whole, 0.06))).any()


def test_a_video_without_people(scene):
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 255, (240, 320, 3), np.uint8) for _ in range(4)]
    found = people.find_people_tracked(images, 30.0)
    assert (found.person == -1).all() and not found.warnings
    assert with_people(images, found).keypoints is None


def test_a_still_video_without_people_ends_well(tmp_path):
    """Nothing to estimate from, which is a result, and said."""
    rng = np.random.default_rng(0)
    coarse = rng.integers(0, 255, (30, 40, 3), np.uint8)
    image = cv2.resize(coarse, (320, 240), interpolation=cv2.INTER_CUBIC)
    for k in range(8):
        cv2.imwrite(str(tmp_path / f"{k}.png"), image)
    config = Config(overlay=False, uncertainty=False)
    result = pipeline.run(io.read_sequence(tmp_path), config)
    assert result.poses.shape == (0, 8, 72)
    assert any("nobody was found" in text for text in result.summary["warnings"])
    assert result.summary["status"] != "ok"


@pytest.mark.parametrize("detect", ["auto", "none"])
def test_given_keypoints_come_first(scene, detect, monkeypatch):
    """The networks are not even opened, nor where nobody is to be looked for."""
    monkeypatch.setattr(people, "find_people_tracked", lambda *a: pytest.fail("looked"))
    given = simulation.as_sequence(scene[0])
    if detect == "none":
        given = dataclasses.replace(given, keypoints=None)
    given = dataclasses.replace(given, frames=Path("video.mp4"))
    config = Config(detect=detect)
    found = people_stage.detect(given, config, Cache(None), Stopwatch())
    assert found is given


@pytest.mark.parametrize("harm", ["missing", "damaged"])
def test_a_network_that_is_missing_or_damaged_is_one_line(harm, tmp_path, monkeypatch):
    monkeypatch.setattr(networks, "_FOLDER", tmp_path)
    if harm == "damaged":
        (tmp_path / "movenet_multipose.onnx").write_bytes(b"half a network")
    with pytest.raises(ValueError, match="install bodyslam-jax again") as caught:
        people.find_people_tracked([], 30.0)
    assert "movenet_multipose.onnx" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert [name for name, _ in people.network_status()] == [
        "movenet_multipose.onnx",
        "blazepose_full.onnx",
        "blazepose_heavy.onnx",
    ]


def test_movenets_output_is_y_x_score_relative_to_the_input():
    raw = np.zeros((6, 56), np.float32)
    raw[0, :3], raw[0, 55] = (0.25, 0.5, 0.75), 0.625
    points, score = movenet.decode(raw, (64, 96))
    np.testing.assert_allclose(points[0, 0], [47.75, 15.75, 0.75])
    assert score[0] == 0.625


@pytest.mark.parametrize("region", [(0, 0, 300, 200), (-40, 20, 120, 180)])
@pytest.mark.parametrize("longer", [96, 320, 640])
def test_a_letterbox_knows_where_its_pixels_are(region, longer):
    """A bright square's centre of mass, found again through the canvas."""
    image = np.zeros((200, 300, 3), np.uint8)
    image[80:101, 60:91] = 255  # about (75, 90)
    canvas, scale = movenet.letterbox(image, region, longer)
    assert canvas.shape[0] % 32 == canvas.shape[1] % 32 == 0
    weight = canvas[..., 0].astype(float)
    rows, columns = np.mgrid[: canvas.shape[0], : canvas.shape[1]]
    at = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
    # Sides are whole pixels, so that scales of x and y may differ by a part of one.
    np.testing.assert_allclose(
        movenet.to_image(at, region, scale), [75, 90], atol=1 / scale * 0.6
    )


def test_detections_that_share_three_keypoints_are_one():
    rng = np.random.default_rng(0)
    person = np.column_stack([rng.uniform(0, 200, (17, 2)), np.full(17, 0.8)])
    ghost = person.copy()
    ghost[8:, :2] += 60.0
    other = person + [150.0, 0, 0]
    kept = movenet.distinct(np.array([ghost, person, other]), np.array([0.3, 0.6, 0.4]))
    assert kept.tolist() == [1, 2]


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 2, -2.0])
def test_blazeposes_square_is_upright_and_its_points_come_back(angle):
    """Somebody who leans by `angle`: shoulders above hips in the square, the same
    places in the image."""
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    points = np.zeros((17, 3))
    points[[5, 6, 11, 12], :2] = [(10, -50), (-10, -50), (8, 0), (-8, 0)]
    points[[15, 16], :2] = [(8, 90), (-8, 90)]
    points[[5, 6, 11, 12, 15, 16], 2] = 0.9
    points[:, :2] = points[:, :2] @ turn.T + [300, 200]
    square = blazepose.turned_square(points, 0.15)
    assert square.side > 2 * 90
    to_crop = square.from_image()
    inside = points[:, :2] @ to_crop[:, :2].T + to_crop[:, 2]
    np.testing.assert_allclose(inside[[11, 12]].mean(0), [127.5, 127.5])
    np.testing.assert_allclose(inside[[5, 6]].mean(0)[0], 127.5)
    assert inside[5, 1] < inside[11, 1] < inside[15, 1]
    raw = np.zeros((33, 5), np.float32)
    raw[blazepose.COCO_OF_LANDMARKS, :2] = inside + 0.5
    pose = blazepose.decode(raw, 1.0, np.zeros((256, 256)), square)
    sure = points[:, 2] > 0
    away = blazepose.disagreement(pose, points)
    np.testing.assert_allclose(away[sure], 0, atol=1e-4)


def test_a_doubtful_wrist_that_blazepose_sees_is_blazeposes():
    points = np.column_stack([np.zeros((17, 2)), np.full(17, 0.9)])
    points[[9, 10], 2] = 0.3  # a confidence of 0.5
    square = blazepose.Square(np.zeros(2), 250.0, np.array([0.0, -1.0]))
    landmarks = np.ones((33, 3))
    landmarks[[15, 16], 2] = 0.9, 0.2  # the right wrist is a guess
    mask = np.zeros((256, 256), np.uint8)
    pose = blazepose.Pose(landmarks, 1.0, mask, square)
    body = found_.as_body25(points, None, found_.find_wrists(pose, points))
    np.testing.assert_allclose(body[7], [1, 1, found_.SURE_WRIST])
    np.testing.assert_allclose(body[4], [0, 0, 0.5**3])
    points[9, 2] = 0.9
    body = found_.as_body25(points, None, found_.find_wrists(pose, points))
    np.testing.assert_allclose(body[7], [0, 0, 1])


def test_the_best_networks_change_doubtful_wrists_alone(scene, found):
    best = people.find_people_tracked(scene[1], 30.0, Detect(networks="best"))
    changed = (best.points != found.points).any(axis=-1)
    assert changed[:, [4, 7]].any()
    assert not np.delete(changed, [4, 7], axis=1).any()
    np.testing.assert_allclose(best.points[changed][:, 2], found_.SURE_WRIST)
    doubtful = found.points[changed][:, 2] ** (1 / 3)
    assert (doubtful < found_.SURE_WRIST).all()


def test_feet_of_somebody_else_are_left_out():
    points = np.column_stack([np.zeros((17, 2)), np.full(17, 0.9)])
    square = blazepose.Square(np.zeros(2), 250.0, np.array([0.0, -1.0]))
    landmarks = np.column_stack([np.ones((33, 2)), np.full(33, 1.0)])
    mask = np.zeros((256, 256), np.uint8)
    pose = blazepose.Pose(landmarks, 1.0, mask, square)
    apart = np.zeros(17)
    apart[16] = 0.5  # the right ankle is elsewhere
    feet = found_.find_feet(pose, points, apart)
    assert (feet[:2, 2] > 0.3).all() and (feet[2:, 2] == 0).all()
    body = found_.as_body25(points, feet)
    assert body[21, 2] > 0 and body[19, 2] > 0 and not body[[22, 24], 2].any()


def test_confidence_rises_with_the_score():
    share = found_.confidence(np.linspace(0, 1, 50))
    assert (np.diff(share) >= 0).all() and share[0] == 0 and share[-1] == 1
    likely, doubtful = found_.confidence(np.array([0.35, 0.2]))
    assert likely > 0.3 > doubtful
