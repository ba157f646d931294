"""Keypoints, bodies and camera that contradict each other: mended, refused or said."""

import dataclasses
import json
import pickle

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import bodyslam_jax as bs
from bodyslam_jax import body as body_
from bodyslam_jax import io
from bodyslam_jax.body import KEYPOINT_NAMES
from bodyslam_jax.config import Config
from bodyslam_jax.diagnostics import reconcile
from bodyslam_jax.types import Bodies, Intrinsics, Keypoints, Sequence

W, H, FOCAL = 640, 480, 525.0
CAMERA = Intrinsics(np.array([FOCAL, FOCAL, (W - 1) / 2, (H - 1) / 2]), W, H)
FRAMES = 60
BODY = body_.load_body_model(body_.DEFAULT)
J_0 = np.asarray(BODY.joint_template[0], float)
_NAMES = KEYPOINT_NAMES["body25"]
_OTHER = {"left": "right", "right": "left"}
SWAPPED = [
    _NAMES.index("_".join([_OTHER.get(word, word) for word in name.split("_")]))
    for name in _NAMES
]


def walker(frames: int = FRAMES, start=(-1.2, 0.1, 4.0), velocity=(1.1, 0.0, 0.5)):
    """Poses and pelvis (m) of somebody who walks before the camera and sees it."""
    seconds = np.arange(frames) / 30
    swing = 0.45 * np.sin(2 * np.pi * 0.9 * seconds)
    poses = np.zeros((frames, 24, 3))
    poses[:, 1, 0], poses[:, 2, 0] = -swing, swing
    poses[:, 4, 0], poses[:, 5, 0] = 0.3 + swing, 0.3 - swing
    poses[:, 16] = np.stack([swing, 0 * swing, 0 * swing - 1.2], -1)
    poses[:, 17] = np.stack([-swing, 0 * swing, 0 * swing + 1.2], -1)
    poses[:, 18, 1] = -0.4
    ahead = Rotation.from_euler("x", np.pi) * Rotation.from_euler("y", -0.7)
    poses[:, 0] = ahead.as_rotvec()
    return poses.reshape(frames, 72), np.array(start) + seconds[:, None] * velocity


def sequence(*people, seed: int = 0, noise: float = 1.0) -> Sequence:
    """People whose keypoints are a detector's, and bodies a regressor's: it errs by
    some degrees in every joint for long, by some more from frame to frame, and by some
    per cent in depth."""
    rng = np.random.default_rng(seed)
    people = people or (walker(),)
    t = len(people[0][0])
    uv, confidence = np.zeros((len(people), t, 25, 2)), np.zeros((len(people), t, 25))
    poses, trans = np.zeros((len(people), t, 72)), np.zeros((len(people), t, 3))
    for h, (pose, pelvis) in enumerate(people):
        points = body_.keypoints(BODY, pose, np.zeros((t, 10)), pelvis - J_0)
        points = np.asarray(points)
        uv[h] = FOCAL * points[..., :2] / points[..., 2:] + CAMERA.params[2:]
        uv[h] += noise * rng.normal(size=(t, 25, 2)) * 2.5
        confidence[h] = rng.uniform(0.6, 1.0, (t, 25))
        slow = rng.normal(size=72) * 0.08 * noise
        poses[h] = pose + slow + noise * rng.normal(size=(t, 72)) * 0.04
        depth = 1 + noise * (0.03 * rng.normal() + 0.02 * rng.normal(size=(t, 1)))
        trans[h] = pelvis * depth - J_0
    return Sequence(
        "clip",
        None,
        np.arange(t) / 30,
        CAMERA,
        Keypoints(uv, confidence),
        Bodies(
            np.ones((len(people), t), bool),
            poses,
            np.zeros((len(people), t, 10)),
            trans,
        ),
    )


def mapped(s: Sequence, to, swap: bool = False) -> Sequence:
    """Keypoints of another image: `to` maps u and v."""
    uv = np.stack(to(s.keypoints.uv[..., 0], s.keypoints.uv[..., 1]), -1)
    confidence = s.keypoints.confidence
    if swap:
        uv, confidence = uv[:, :, SWAPPED], confidence[:, :, SWAPPED]
    return dataclasses.replace(s, keypoints=Keypoints(uv, confidence))


def moved(s: Sequence, to=lambda p: p, R=np.eye(3)) -> Sequence:
    """Bodies of another frame: `to` maps the pelvis once it is turned by `R`."""
    poses = s.bodies.poses.copy()
    root = Rotation.from_matrix(R) * Rotation.from_rotvec(poses[..., :3].reshape(-1, 3))
    poses[..., :3] = root.as_rotvec().reshape(poses[..., :3].shape)
    trans = to((s.bodies.trans + J_0) @ np.asarray(R).T) - J_0
    bodies = dataclasses.replace(s.bodies, poses=poses, trans=trans)
    return dataclasses.replace(s, bodies=bodies)


def taken(bundle, frames):
    """Frame `frames[k]` in place of frame k; nobody where that is none."""
    frames = np.asarray(frames)
    arrays = {k: v for k, v in vars(bundle).items() if isinstance(v, np.ndarray)}
    fine = (frames >= 0) & (frames < FRAMES)
    new = {}
    for name, array in arrays.items():
        new[name] = np.where(
            fine.reshape(1, -1, *[1] * (array.ndim - 2)),
            array[:, np.where(fine, frames, 0)],
            np.zeros((), array.dtype),
        )
    return dataclasses.replace(bundle, **new)


def retimed(s: Sequence, what: str, frames) -> Sequence:
    return dataclasses.replace(s, **{what: taken(getattr(s, what), frames)})


def numbered(s: Sequence, what: str, *pieces) -> Sequence:
    """The first person's `what` under as many numbers as there are (first, end)."""
    bundle = getattr(s, what)
    arrays = {k: v for k, v in vars(bundle).items() if isinstance(v, np.ndarray)}
    new = {n: np.zeros((len(pieces), *a.shape[1:]), a.dtype) for n, a in arrays.items()}
    for row, (first, end) in enumerate(pieces):
        for name, array in arrays.items():
            new[name][row, first:end] = array[0, first:end]
    return dataclasses.replace(s, **{what: dataclasses.replace(bundle, **new)})


def said(found: Sequence) -> str:
    return " ".join(found.warnings)


def same_people(found: Sequence, wanted: Sequence, atol: float = 1e-6) -> None:
    """Where both have them; `atol` in m."""
    both = (found.keypoints.confidence > 0) & (wanted.keypoints.confidence > 0)
    assert both.any(axis=(1, 2)).all()
    np.testing.assert_allclose(
        found.keypoints.uv[both], wanted.keypoints.uv[both], atol=1e-6
    )
    both = found.bodies.present & wanted.bodies.present
    assert both.any(axis=1).all()
    np.testing.assert_allclose(
        found.bodies.trans[both], wanted.bodies.trans[both], atol=atol
    )
    turned, true = (
        Rotation.from_rotvec(s.bodies.poses[both][:, :3]) for s in (found, wanted)
    )
    assert (turned * true.inv()).magnitude().max() < 1e-6


K = np.arange(FRAMES)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("noise", [0.0, 1.0, 2.0])
def test_what_agrees_is_left_as_it_is(seed, noise):
    two = walker(), walker(start=(0.9, 0.1, 5.0), velocity=(-0.5, 0.0, 0.2))
    for people in ((), two):
        given = sequence(*people, seed=seed, noise=noise)
        assert reconcile(given, BODY) is given


def test_gross_errors_and_swapped_sides_in_some_frames_are_no_contradiction():
    given, rng = sequence(seed=1), np.random.default_rng(1)
    uv = given.keypoints.uv.copy()
    wild = rng.random(uv.shape[:3]) < 0.15
    uv[wild] += rng.normal(size=(int(wild.sum()), 2)) * 60
    swapped = rng.random(FRAMES) < 0.15
    right = uv.copy()
    uv[0, swapped] = uv[0, swapped][:, SWAPPED]
    given = dataclasses.replace(
        given, keypoints=Keypoints(uv, given.keypoints.confidence)
    )
    found = reconcile(given, BODY)
    assert found.warnings == () and found.bodies is given.bodies
    # The sides of limbs are put back, and all that follows has them so.
    limbs = [3, 4, 6, 7, 10, 11, 13, 14]
    put_back = (found.keypoints.uv == right)[0, :, limbs].all(axis=-1)
    assert put_back[:, swapped].mean() > 0.9 and put_back.mean() > 0.9


def test_half_a_person_in_the_image_is_no_contradiction():
    given = sequence()
    confidence = given.keypoints.confidence.copy()
    confidence[:, :, [10, 11, 13, 14, 19, 20, 21, 22, 23, 24]] = 0.0
    keypoints = Keypoints(given.keypoints.uv, confidence)
    given = dataclasses.replace(given, keypoints=keypoints)
    assert reconcile(given, BODY) is given


@pytest.mark.parametrize("focal", [np.hypot(W, H), 5000 / 256 * W])
def test_bodies_of_a_usual_focal_length_are_refocused(focal):
    true = sequence()
    found = reconcile(moved(true, lambda p: p * [1, 1, focal / FOCAL]), BODY)
    same_people(found, true)
    assert f"{focal:.0f} px" in said(found)


@pytest.mark.parametrize("focal", [340.0, 950.0])
def test_any_focal_length_is_measured(focal):
    true = sequence()
    found = reconcile(moved(true, lambda p: p * [1, 1, focal / FOCAL]), BODY)
    depth = (found.bodies.trans + J_0)[..., 2] / (true.bodies.trans + J_0)[..., 2]
    assert abs(np.log(depth)).max() < 0.1
    assert "focal length" in said(found)


def test_a_principal_point_in_the_middle_is_taken_for_what_it_is():
    """Bodies of a tool that knows no other, and a camera that has another."""
    true = sequence()
    camera = dataclasses.replace(
        CAMERA, params=CAMERA.params + np.array([0.0, 0.0, 90.0, -30.0])
    )
    there = moved(true, lambda p: p - p[..., 2:] * [90 / FOCAL, -30 / FOCAL, 0])
    found = reconcile(dataclasses.replace(true, intrinsics=camera), BODY)
    same_people(found, there)
    assert "principal point" in said(found)


def turned(s: Sequence) -> Sequence:
    """Bodies of a world with another place and orientation than the camera's."""
    R = Rotation.from_euler("xyz", [0.3, 0.9, 0.2]).as_matrix()
    return moved(s, lambda p: p + [2.0, -1.0, 3.0], R)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda s: mapped(s, lambda u, v: (u / 2, v / 2)), r"0\.(49|50)\d times the"),
        (
            lambda s: mapped(s, lambda u, v: (u * 1.5, v * 1.5)),
            r"1\.(4[89]|5[01])\d times",
        ),
        (lambda s: mapped(s, lambda u, v: (u * 0.61, v * 0.61)), r"0\.6[012]\d times"),
        (lambda s: mapped(s, lambda u, v: (H - 1 - v, u)), "degrees clockwise"),
        (lambda s: mapped(s, lambda u, v: (v, W - 1 - u)), "degrees anticlockwise"),
        (lambda s: mapped(s, lambda u, v: (W - 1 - u, H - 1 - v)), "180 degrees"),
        (lambda s: mapped(s, lambda u, v: ((H - 1 - v) / 2, u / 2)), "degrees clockw"),
        (lambda s: mapped(s, lambda u, v: (u, H - 1 - v)), "from the lower edge"),
        (lambda s: mapped(s, lambda u, v: (v, u)), "x and y exchanged"),
        (lambda s: mapped(s, lambda u, v: (W - 1 - u, v), True), "mirrored"),
        (lambda s: mapped(s, lambda u, v: (W - 1 - u, v)), "mirrored"),
        (lambda s: mapped(s, lambda u, v: (u - 90, v - 40)), r"moved by \(-9\d, -[34]"),
        (lambda s: mapped(s, lambda u, v: (u * 0.65, v * 0.65 + 52)), "of this video"),
        (lambda s: moved(s, lambda p: p * 1000), "times as large"),
        (lambda s: moved(s, lambda p: p * 10), r"(9|1[01])\.\d\d times as large"),
        (lambda s: moved(s, lambda p: p * 1.9), r"(1\.[6-9]|2\.[01])\d times as large"),
        (lambda s: moved(s, R=np.diag([1.0, -1.0, -1.0])), "in the frame of"),
        (lambda s: moved(s, R=np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])), "frame"),
        (turned, "in the frame of"),
        (lambda s: retimed(s, "keypoints", 2 * K), "keypoints .* one frame in 2"),
        (lambda s: retimed(s, "bodies", 3 * K), "bodies .* one frame in 3"),
        (lambda s: retimed(s, "bodies", (K + 25) % FRAMES), "frames of this video"),
    ],
)
def test_contradictions_are_refused_in_one_line(change, text):
    with pytest.raises(ValueError, match=text) as refusal:
        reconcile(change(sequence()), BODY)
    assert str(refusal.value).startswith("clip: ")
    assert "\n" not in str(refusal.value)


def test_sides_that_contradict_are_said():
    exchanged = mapped(sequence(), lambda u, v: (u, v), swap=True)
    assert "left and right" in said(reconcile(exchanged, BODY))
    true = sequence()
    behind = Rotation.from_rotvec(true.bodies.poses[0, :, :3])
    poses = true.bodies.poses.copy()
    poses[0, :, :3] = (behind * Rotation.from_euler("y", np.pi)).as_rotvec()
    bodies = dataclasses.replace(true.bodies, poses=poses)
    turned = dataclasses.replace(true, bodies=bodies)
    assert "left and right" in said(reconcile(turned, BODY))


def test_people_of_another_size_than_their_keypoints_are_said():
    found = reconcile(moved(sequence(noise=0.5), lambda p: p * 1.25), BODY)
    assert "times too far away" in said(found) or "focal length" in said(found)


def test_numbers_of_one_person_become_one_person():
    true = sequence()
    pieces = (0, 20), (20, 41), (43, FRAMES)
    found = reconcile(numbered(true, "bodies", *pieces), BODY)
    same_people(found, true)
    assert found.bodies.present.sum() == FRAMES - 2
    assert "bodies of 3 numbers are of one person: frames 0-19, 20-40, 43-59" in said(
        found
    )
    brief = reconcile(numbered(true, "bodies", (0, 30), (30, 31), (31, FRAMES)), BODY)
    same_people(brief, true)
    found = reconcile(numbered(true, "keypoints", *pieces), BODY)
    same_people(found, true)
    assert "keypoints of 3 numbers" in said(found)
    both = numbered(numbered(true, "bodies", *pieces), "keypoints", (0, 30), (30, 60))
    same_people(reconcile(both, BODY), true)
    alone = dataclasses.replace(numbered(true, "bodies", *pieces), keypoints=None)
    assert len(reconcile(alone, BODY).bodies.present) == 1


def test_bodies_of_frames_without_keypoints_go_with_their_neighbours():
    true = numbered(sequence(), "bodies", (0, 20), (20, 32), (32, FRAMES))
    hidden = retimed(true, "keypoints", np.where((K > 18) & (K < 33), -1, K))
    found = reconcile(hidden, BODY)
    assert found.bodies.present.all() and len(found.bodies.present) == 1


def test_one_person_twice_at_once_becomes_one_person():
    true = sequence()
    twice = numbered(true, "bodies", (0, FRAMES), (4, 50))
    twice.bodies.trans[1] += [0.02, 0.0, 0.1]
    found = reconcile(twice, BODY)
    same_people(found, true, atol=0.11)
    assert found.bodies.present.sum() == FRAMES
    assert "in 46 frames twice" in said(found)
    found = reconcile(numbered(true, "keypoints", (0, FRAMES), (0, FRAMES)), BODY)
    same_people(found, true)


def test_people_keep_to_themselves():
    """Two who cross, in other orders, and one whom the detector did not find."""
    true = sequence(walker(), walker(start=(1.2, 0.1, 5.5), velocity=(-1.1, 0, 0)))
    rows = lambda x, order: dataclasses.replace(
        x, **{k: v[order] for k, v in vars(x).items() if isinstance(v, np.ndarray)}
    )
    other = dataclasses.replace(true, bodies=rows(true.bodies, [1, 0]))
    found = reconcile(other, BODY)
    same_people(found, true)
    assert not found.warnings
    alone = dataclasses.replace(true, keypoints=rows(true.keypoints, [0]))
    found = reconcile(alone, BODY)
    assert found.bodies.present.sum(1).tolist() == [FRAMES, FRAMES]
    assert "have no keypoints" in said(found)
    beyond = moved(alone)
    beyond.bodies.trans[1] += [30.0, 0.0, 0.0]
    found = reconcile(beyond, BODY)
    assert len(found.bodies.present) == 1
    assert "outside the image" in said(found)


@pytest.mark.parametrize("what", ["bodies", "keypoints"])
def test_exchanged_numbers_are_doubted(what):
    true = sequence(walker(), walker(start=(0.5, 0.1, 5.5), velocity=(0.2, 0, 0)))
    bundle, exchanged = getattr(true, what), {}
    for name, value in vars(bundle).items():
        if isinstance(value, np.ndarray):
            exchanged[name] = value.copy()
            exchanged[name][:, 35:] = value[::-1, 35:]
    given = dataclasses.replace(
        true, **{what: dataclasses.replace(bundle, **exchanged)}
    )
    found = reconcile(given, BODY)
    assert not found.warnings
    for h, text in enumerate(found.contradictions):
        assert text.startswith(f"person {h}: in 42 % of the frames, between 35 and 59")


def test_who_is_not_there_is_left_out():
    given = numbered(sequence(), "bodies", (0, FRAMES), (0, 0))
    given = numbered(given, "keypoints", (0, FRAMES), (0, 0))
    found = reconcile(given, BODY)
    assert len(found.bodies.present) == len(found.keypoints.uv) == 1
    assert "neither keypoints nor bodies" in said(found)


@pytest.mark.parametrize(
    ("to", "text"),
    [
        (lambda u, v: (H - 1 - v, u), "heads to the right"),
        (lambda u, v: (v, W - 1 - u), "heads to the left"),
        (lambda u, v: (u, H - 1 - v), "heads are below feet"),
        (lambda u, v: (u / 2, v / 2), "upper left quarter"),
    ],
)
def test_keypoints_alone_tell_by_peoples_shape(to, text):
    given = dataclasses.replace(mapped(sequence(), to), bodies=None)
    found = reconcile(given, BODY)
    np.testing.assert_array_equal(found.keypoints.uv, given.keypoints.uv)
    assert text in said(found)


def test_who_lies_or_stands_on_the_hands_for_a_while_is_not_spoken_of():
    s = dataclasses.replace(sequence(), bodies=None)
    uv = s.keypoints.uv.copy()
    uv[0, :35] = mapped(s, lambda u, v: (u, H - 1 - v)).keypoints.uv[0, :35]
    given = dataclasses.replace(s, keypoints=Keypoints(uv, s.keypoints.confidence))
    assert reconcile(given, BODY) is given


def test_bodies_alone_have_to_be_in_the_image():
    true = dataclasses.replace(sequence(), keypoints=None)
    assert reconcile(true, BODY) is true
    with pytest.raises(ValueError, match="outside the image of 640x480 px in 100 %"):
        reconcile(moved(true, lambda p: p + [9.0, 0.0, 0.0]), BODY)
    found = reconcile(moved(true, R=np.diag([-1.0, -1.0, 1.0])), BODY)
    assert "y points up" in said(found)


def test_nothing_to_compare_is_nothing_to_say():
    none = Sequence("clip", None, np.arange(5) / 30, CAMERA)
    assert reconcile(none, BODY) is none
    apart = retimed(sequence(), "keypoints", np.where(K < 20, K, -1))
    apart = retimed(apart, "bodies", np.where(K >= 25, K, -1))
    assert reconcile(apart, BODY) is apart


def test_every_source_passes():
    """A sequence made by hand, too, and before anything is computed."""
    given = moved(sequence(), lambda p: p + [0.0, 0.0, -50.0])
    with pytest.raises(ValueError, match="clip: bodies and keypoints do not agree"):
        bs.run(given, Config())


def folder(tmp_path, uv, confidence, size=(W, H)):
    """A sequence folder of `FRAMES` frames with one person's keypoints."""
    camera = {"model": "PINHOLE", "width": size[0], "height": size[1], "fps": 30.0}
    camera["params"] = [FOCAL, FOCAL, size[0] / 2, size[1] / 2]
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    np.savez(
        tmp_path / "tracks.npz", frame=K, landmark=K % 2, uv=np.full((FRAMES, 2), 50.0)
    )
    (tmp_path / "keypoints").mkdir()
    for k, points in enumerate(np.concatenate([uv, confidence[..., None]], -1)):
        person = {"pose_keypoints_2d": points.ravel().tolist()}
        file = tmp_path / "keypoints" / f"{k:06d}_keypoints.json"
        file.write_text(json.dumps({"people": [person]}))
    return tmp_path


def test_fewer_files_than_frames_are_said(tmp_path):
    keypoints = sequence().keypoints
    path = folder(tmp_path, keypoints.uv[0, :25], keypoints.confidence[0, :25])
    found = io.read_sequence(path)
    assert (
        "numbered 0 to 24 for 60 frames: taken as counted from 0, the first 25"
        in said(found)
    )


@pytest.mark.parametrize("clockwise", [True, False])
def test_keypoints_of_a_phones_video_as_it_is_stored(tmp_path, clockwise):
    """Shown as 480x640, stored as 640x480: people lie, some beyond the right edge."""
    start = (-0.2, -0.8 if clockwise else 0.0, 3.0)
    keypoints = sequence(walker(start=start, velocity=(0, 0, 0))).keypoints
    shown = keypoints.uv[0] + [-(W - H) / 2, (W - H) / 2]
    u, v = shown[..., 0], shown[..., 1]
    stored = np.stack([W - 1 - v, u] if clockwise else [v, H - 1 - u], -1)
    path = folder(tmp_path, stored, keypoints.confidence[0], (H, W))
    found = io.read_sequence(path)
    np.testing.assert_allclose(found.keypoints.uv[0], shown, atol=1e-9)
    assert "before the video's rotation" in said(found)


def test_a_tools_own_focal_length_is_taken(tmp_path):
    """WHAM's file does not say that its camera has the image's diagonal."""
    s = sequence()
    poses, trans = s.bodies.poses[0], s.bodies.trans[0]
    path = folder(tmp_path, s.keypoints.uv[0], s.keypoints.confidence[0])
    one = {"pose": poses, "betas": np.zeros((FRAMES, 10)), "frame_ids": K}
    far = (trans + J_0) * [1, 1, 800 / FOCAL] - J_0
    file = path / "wham_output.pkl"
    file.write_bytes(pickle.dumps({0: {**one, "trans": far, "pose_world": poses}}))
    found = io.read_sequence(path, bodies=file)
    np.testing.assert_allclose(found.bodies.trans[0], trans, atol=0.02)
    assert "its default of 800 px" in said(found) and "525 px" in said(found)
