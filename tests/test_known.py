"""What a user knows: how it is written, read, and what it is worth."""

import json
import math
import struct
import zipfile

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_frontend_motion import CAMERA, camera_error, scene

from bodyslam_jax import graph, initialisation, io, people, sfm
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Config, Known, Measured, Structure
from bodyslam_jax.diagnostics import stature
from bodyslam_jax.types import CameraPath, Keypoints, Sequence, Tracks


def test_a_height_is_a_number_with_its_deviation_for_one_person_or_for_all():
    assert Known(height=("1.78",)).heights() == {None: Measured(1.78, 0.02)}
    found = Known(height=("0=1.8±0.01", "2=1.65+-0.05")).heights()
    assert found == {0: Measured(1.8, 0.01), 2: Measured(1.65, 0.05)}


def test_focal_length_and_field_of_view_are_one_thing():
    wide = Known(fov="90±2").focal_length(1000)
    assert wide is not None and abs(wide.value - 500) < 1e-9
    # By differences of f = w / (2 tan(θ/2)).
    focal = [500 / math.tan(math.radians(a) / 2) for a in (89.99, 90.01)]
    assert abs(wide.sigma - 2 * (focal[0] - focal[1]) / 0.02) < 1e-3
    assert Known(focal="800").focal_length(7) == Measured(800.0, 16.0)
    assert Known().focal_length(7) is None


@pytest.mark.parametrize(
    "known, text",
    [
        ({"height": ("178",)}, "found 178, expected 0.4 to 2.8 m"),
        ({"height": ("clip.mp4",)}, "'clip.mp4', expected METRES"),
        ({"height": ("a=1.8",)}, "expected PERSON=METRES"),
        ({"height": ("1.8±-1",)}, "no positive standard deviation"),
        ({"height": ("0=1.8", "0=1.7")}, "that person's was given"),
        ({"focal": "800", "fov": "60"}, "both given"),
        ({"fov": "190"}, "expected 1 to 179 degrees"),
        ({"focal": "nan"}, "expected PIXELS"),
        ({"gravity": (0.0, 1.0)}, "a direction of 3 numbers"),
        ({"gravity": (0.0, 0.0, 0.0)}, "a direction of 3 numbers"),
        ({"start": 2.0, "end": 1.0}, "more than start"),
        ({"fps": 0.0}, "fps"),
        ({"person": (-1,)}, "person"),
        ({"camera_path_metric": True}, "expected a camera_path"),
        ({"static_camera": True, "camera_path": "x"}, "expected one of them"),
    ],
)
def test_what_cannot_be_known_is_refused(known, text):
    with pytest.raises(ValueError, match=text):
        Config(**known)


# Files of cameras and of their paths.


def poses(count, seed=0):
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, 0.3, (count, 3))).as_matrix()
    T[:, :3, 3] = rng.normal(0, 2, (count, 3))
    return T


def colmap_rows(T_WC, names):
    """qw qx qy qz tx ty tz of the world seen from each camera."""
    for T, name in zip(np.linalg.inv(T_WC), names, strict=True):
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        yield (w, x, y, z, *T[:3, 3]), name


def write_colmap(folder, T_WC, names, binary):
    params = [500.0, 510.0, 320.5, 240.5]
    if binary:
        data = struct.pack("<QiiQQ4d", 1, 1, 1, 640, 480, *params)
        (folder / "cameras.bin").write_bytes(data)
        data = struct.pack("<Q", len(names))
        for i, (row, name) in enumerate(colmap_rows(T_WC, names)):
            data += struct.pack("<i7di", i + 1, *row, 1) + name.encode() + b"\0"
            data += struct.pack("<Q", 2) + struct.pack("<ddqddq", 1, 2, 3, 4, 5, -1)
        (folder / "images.bin").write_bytes(data)
        return folder / "cameras.bin", folder / "images.bin"
    text = "# Camera list\n1 PINHOLE 640 480 " + " ".join(map(str, params)) + "\n"
    (folder / "cameras.txt").write_text(text)
    lines = ["# Image list"]
    for i, (row, name) in enumerate(colmap_rows(T_WC, names)):
        lines += [f"{i + 1} {' '.join(map(repr, map(float, row)))} 1 {name}"]
        lines += ["1 2 3" if i % 2 else ""]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    return folder / "cameras.txt", folder / "images.txt"


def write_nerfstudio(folder, T_WC, names):
    matrices = T_WC * [1.0, -1.0, -1.0, 1.0]
    frames = [
        {"file_path": f"images/{n}", "transform_matrix": m.tolist()}
        for n, m in zip(names, matrices, strict=True)
    ]
    data = {"fl_x": 500.0, "fl_y": 510.0, "cx": 320.5, "cy": 240.5, "w": 640, "h": 480}
    path = folder / "transforms.json"
    path.write_text(json.dumps({**data, "frames": frames}))
    return path, path


@pytest.fixture
def footage(tmp_path):
    """Eight images whose names count from 1."""
    folder = tmp_path / "clip"
    folder.mkdir()
    for k in range(8):
        image = np.full((480, 640), 20 * k, np.uint8)
        cv2.imwrite(str(folder / f"frame_{k + 1:04}.png"), image)
    return folder


@pytest.mark.parametrize("kind", ["text", "binary", "nerfstudio"])
def test_cameras_and_paths_of_other_programs_are_read(tmp_path, footage, kind):
    T_WC = poses(8)
    names = [f"frame_{k + 1:04}.png" for k in range(8)]
    shuffled = np.random.default_rng(1).permutation(8)[:6]
    arguments = (tmp_path, T_WC[shuffled], [names[k] for k in shuffled])
    if kind == "nerfstudio":
        camera, path = write_nerfstudio(*arguments)
    else:
        camera, path = write_colmap(*arguments, kind == "binary")
    known = Known(camera_path=str(path), camera_path_metric=True, fps=30.0)
    sequence = io.read_sequence(footage, camera=camera, known=known)
    # COLMAP's pixels begin at a corner.
    expected = [500.0, 510.0, 320.0, 240.0]
    np.testing.assert_allclose(sequence.intrinsics.params[:4], expected)
    found = sequence.camera_path
    assert found is not None and found.metric
    np.testing.assert_array_equal(np.flatnonzero(found.known), np.sort(shuffled))
    np.testing.assert_allclose(found.T_WC[found.known], T_WC[found.known], atol=1e-12)
    assert any("6 of 8 frames" in text for text in sequence.warnings)


def test_a_trajectory_is_taken_at_the_times_of_frames(tmp_path, footage):
    times = np.arange(0, 0.31, 0.01)
    lines = [f"{t:.3f} {t} 0 {2 * t} 0 0 0 1" for t in times]
    path = tmp_path / "path.txt"
    path.write_text("\n".join(lines))
    known = Known(camera_path=str(path), fps=25.0)
    found = io.read_sequence(footage, known=known).camera_path
    assert found is not None and found.known.all() and not found.metric
    np.testing.assert_allclose(found.T_WC[:, 0, 3], np.arange(8) / 25, atol=1e-9)
    np.testing.assert_allclose(found.T_WC[:, 2, 3], np.arange(8) / 12.5, atol=1e-9)


def write_stray(folder, T_WC):
    folder.mkdir(exist_ok=True)
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for k, T in enumerate(T_WC):
        row = [7000 + k / 30, k, *T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
        lines.append(", ".join(repr(float(value)) for value in row))
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    K = "500.0, 0.0, 320.0\n0.0, 510.0, 240.0\n0.0, 0.0, 1.0\n"
    (folder / "camera_matrix.csv").write_text(K)
    return folder


def write_record3d(folder, T_WC, packed):
    arkit = T_WC * [1.0, -1.0, -1.0, 1.0]
    xyzw = Rotation.from_matrix(arkit[:, :3, :3]).as_quat()
    data = {
        "w": 640,
        "h": 480,
        "fps": 30,
        "K": [500.0, 0.0, 0.0, 0.0, 510.0, 0.0, 320.0, 240.0, 1.0],
        "poses": np.concatenate([xyzw, arkit[:, :3, 3]], axis=1).tolist(),
    }
    if not packed:
        folder.mkdir(exist_ok=True)
        (folder / "metadata.json").write_text(json.dumps(data))
        return folder
    with zipfile.ZipFile(folder.with_suffix(".r3d"), "w") as archive:
        archive.writestr("metadata", json.dumps(data))
    return folder.with_suffix(".r3d")


@pytest.mark.parametrize("kind", ["stray", "record3d", "r3d"])
def test_recorders_of_arkit_are_read_and_are_metric(tmp_path, footage, kind):
    T_WC, folder = poses(8), tmp_path / "recording"
    if kind == "stray":
        path = write_stray(folder, T_WC)
    else:
        path = write_record3d(folder, T_WC, kind == "r3d")
    known = Known(camera_path=str(path), fps=30.0)
    sequence = io.read_sequence(footage, camera=path, known=known)
    expected = [500.0, 510.0, 320.0, 240.0]
    np.testing.assert_allclose(sequence.intrinsics.params[:4], expected)
    found = sequence.camera_path
    assert found is not None and found.metric and found.known.all()
    np.testing.assert_allclose(found.T_WC, T_WC, atol=1e-9)


@pytest.mark.parametrize(
    "name, content, text",
    [
        ("odometry.csv", b"time, x\n0, 1\n", "columns time, x"),
        ("odometry.csv", b"timestamp, frame\n0, word\n", "not Stray Scanner's"),
        ("metadata.json", b'{"poses": [[0, 0, 0, 1]], "fps": 30}', "qx qy qz qw"),
        ("metadata.json", b'{"poses": [[2, 0, 0, 0, 0, 0, 0]], "fps": 3}', "no rot"),
        ("a.r3d", b"PK", "not Record3D's archive"),
    ],
)
def test_a_recording_that_is_none_is_named(tmp_path, footage, name, content, text):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ValueError, match=text) as raised:
        io.read_sequence(footage, known=Known(camera_path=str(path)))
    assert str(path) in str(raised.value)


@pytest.mark.parametrize(
    "name, content, text",
    [
        ("cameras.txt", b"1 PINHOLE 640\n", "not COLMAP's cameras"),
        ("cameras.bin", b"\x01\0\0", "not COLMAP's cameras"),
        ("cameras.txt", b"# nothing\n", "no camera in it"),
        ("cameras.txt", b"1 FOV 640 480 500 500 320 240 0.9\n", "undistort"),
        ("transforms.json", b'{"frames": []}', "no `fl_x`"),
    ],
)
def test_a_camera_file_that_is_none_is_named(tmp_path, footage, name, content, text):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(ValueError, match=text) as error:
        io.read_sequence(footage, camera=path)
    assert str(path) in str(error.value)


def test_a_path_of_another_video_is_refused(tmp_path, footage):
    names = [f"other_{k:04}.png" for k in range(100, 112)]
    _, path = write_colmap(tmp_path, poses(12), names, False)
    (tmp_path / "one.txt").write_text("5.0 0 0 0 0 0 0 1\n")
    for file in (path, tmp_path / "one.txt", tmp_path / "nothing.txt"):
        with pytest.raises(ValueError, match=str(file)):
            io.read_sequence(footage, known=Known(camera_path=str(file)))


def test_only_what_lies_between_start_and_end_is_read(footage):
    known = Known(fps=10.0, start=0.2, end=0.5)
    sequence = io.read_sequence(footage, known=known)
    np.testing.assert_allclose(sequence.timestamps, [0.2, 0.3, 0.4, 0.5])
    shown = [int(image[0, 0, 0]) for image in io.frames(sequence)]
    assert shown == [40, 60, 80, 100]
    with pytest.raises(ValueError, match="no frame between 3 and inf s"):
        io.read_sequence(footage, known=Known(fps=10.0, start=3.0))


def test_a_given_focal_length_is_no_guess(footage):
    sequence = io.read_sequence(footage, known=Known(focal="700±10", fps=30.0))
    camera = sequence.intrinsics
    assert camera.params[0] == camera.params[1] == 700.0
    assert camera.focal_sigma == 10.0 and not camera.is_guess and camera.is_refined
    assert not any("guess" in text for text in sequence.warnings)


# What they are worth.


def test_points_seen_along_a_known_path_make_a_metric_map():
    tracks, truth = scene("sideways", num=40)
    path = CameraPath(truth, np.arange(40) % 5 != 3, True)
    found = sfm.reconstruct(tracks, CAMERA, 40, path=path)
    assert found.kind == "moving" and found.registered.all()
    assert camera_error(found.T_WC, truth) < 0.01
    travelled = np.linalg.norm(truth[-1, :3, 3] - truth[0, :3, 3])
    mapped = np.linalg.norm(found.T_WC[-1, :3, 3] - found.T_WC[0, :3, 3])
    np.testing.assert_allclose(found.unit * mapped, travelled, rtol=1e-3)
    turned_round = CameraPath(np.linalg.inv(truth), path.known, True)
    with pytest.raises(ValueError, match="% of the points in the images fit it"):
        sfm.reconstruct(tracks, CAMERA, 40, path=turned_round)


def test_a_camera_on_a_tripod_is_not_looked_for():
    tracks, _ = scene("sideways", num=20)
    found = sfm.reconstruct(tracks, CAMERA, 20, Structure(), static=True)
    assert found.kind == "static"
    np.testing.assert_array_equal(found.T_WC, np.tile(np.eye(4), (20, 1, 1)))


def test_before_a_bare_wall_a_tripod_or_a_path_will_do():
    rows = np.zeros(0, int)
    nothing = Tracks(rows, rows, np.zeros((0, 2)))
    found = sfm.reconstruct(nothing, CAMERA, 5, static=True)
    assert found.kind == "static" and found.registered.all()
    path = CameraPath(poses(5), np.ones(5, bool), True)
    found = sfm.reconstruct(nothing, CAMERA, 5, path=path)
    assert found.kind == "moving" and found.registered.all() and found.unit == 1.0
    expected = np.linalg.inv(path.T_WC[0]) @ path.T_WC
    np.testing.assert_allclose(found.T_WC, expected, atol=1e-12)
    assert "was not compared with the images" in found.warnings[0]


def a_person(frames=4):
    T_CH = np.tile(np.eye(4), (1, frames, 1, 1))
    T_CH[0, :, :3, 3] = [0.5, 0.1, 4.0]
    present = np.ones((1, frames), bool)
    return people.PersonState(
        present, T_CH, np.zeros((1, frames, 23, 3)), np.full((1, 10), 0.3)
    )


def test_a_known_stature_makes_the_person_as_tall_and_keeps_the_image():
    body, roots = load_body_model(dtype=jnp.float64), a_person()
    statures = people.statures_of({None: Measured(1.9, 0.005)}, [0])
    found = people.with_statures(roots, statures, body, np.array([1.0]))
    before, after = (stature(body, r.shape[0]) for r in (roots, found))
    assert abs(after - 1.9) < 0.004 < abs(before - 1.9)
    ratio = found.T_CH[0, :, :3, 3] / roots.T_CH[0, :, :3, 3]
    np.testing.assert_allclose(ratio, after / before, rtol=2e-3)
    # Hardly known, it says hardly anything.
    vague = people.with_statures(roots, {0: Measured(1.9, 1.0)}, body, np.array([1.0]))
    assert abs(stature(body, vague.shape[0]) - before) < 0.01
    with pytest.raises(ValueError, match="height: given for person 3"):
        people.statures_of({3: Measured(1.8, 0.02)}, [0, 1])


def test_stature_and_scale_are_measurements_of_the_graph():
    body, roots = load_body_model(dtype=jnp.float64), a_person(6)
    state = initialisation.first_state(
        np.tile(np.eye(4), (6, 1, 1)), np.zeros((0, 3)), roots, np.ones(4)
    )
    state = graph.State(**{**vars(state), "scale": jnp.asarray(2.0)})
    factor = initialisation.stature_factor(
        {0: Measured(1.8, 0.02)}, roots.present, body
    )
    error = (stature(body, roots.shape[0]) - 1.8) / 0.02
    # The highest and the lowest vertex change with the shape, by less than 5 mm.
    np.testing.assert_allclose(float(factor.cost(state)), error**2 / 2, rtol=0.2)
    slope = jax.grad(lambda b: factor.cost(graph.State(**{**vars(state), "shapes": b})))
    expected = error / 0.02 * np.asarray(factor.slope)
    np.testing.assert_allclose(slope(state.shapes)[0], expected, rtol=0.1)
    pose = np.tile(np.eye(4), (6, 1, 1))
    _, scale = initialisation.path_factors(pose, np.ones(6, bool), 1.9)
    np.testing.assert_allclose(float(scale.cost(state)), (0.1 / 0.019) ** 2 / 2)
    assert initialisation.path_factors(None, None) == []


def test_people_are_chosen_by_number():
    uv = np.arange(3 * 4 * 25 * 2, dtype=float).reshape(3, 4, 25, 2)
    sequence = Sequence(
        "three",
        None,
        np.arange(4) / 30,
        CAMERA,
        keypoints=Keypoints(uv, np.ones((3, 4, 25))),
    )
    found = people.select_people(sequence, (2, 0))
    assert found.keypoints is not None
    np.testing.assert_array_equal(found.keypoints.uv, uv[[2, 0]])
    assert "2 of 3 people" in found.warnings[-1]
    assert people.select_people(sequence, ()) is sequence
    with pytest.raises(ValueError, match="found 3, but three has people 0 to 2"):
        people.select_people(sequence, (3,))
