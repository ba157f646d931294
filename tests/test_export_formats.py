"""What is exported for other programs, read back."""

import csv
import dataclasses
import importlib
import json
import struct
import subprocess
import sys
from pathlib import Path
from typing import get_args
from xml.etree import ElementTree

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from evo.tools import file_interface
from export_cases import FPS, NUM_FRAMES, SIZE, make_result, observe, without_people
from scipy.spatial.transform import Rotation

from bodyslam_jax import evaluation, export, io
from bodyslam_jax.body import (
    JOINT_NAMES,
    PARENTS,
    joints,
    load_body_model,
    vertices,
)
from bodyslam_jax.cli.export import Formats
from bodyslam_jax.export import formats
from bodyslam_jax.export.formats import csv as isb
from bodyslam_jax.export.formats.bvh import MIXAMO_NAMES
from bodyslam_jax.io.camera.calibration import read_camera
from bodyslam_jax.io.camera.path import read_camera_path

Y_TO_Z = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@pytest.fixture(scope="module")
def body():
    return load_body_model(dtype=jnp.float64)


@pytest.fixture(scope="module")
def result(body):
    return make_result(body)


def _read_glb(path):
    """The document, and its accessors as arrays."""
    data = path.read_bytes()
    magic, version, length, size = struct.unpack_from("<IIII", data)
    assert (magic, version, length) == (0x46546C67, 2, len(data))
    document = json.loads(data[20 : 20 + size])
    binary = data[28 + size :]
    kinds = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
    widths = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
    arrays = []
    for accessor in document["accessors"]:
        start = document["bufferViews"][accessor["bufferView"]]["byteOffset"]
        kind, width = kinds[accessor["componentType"]], widths[accessor["type"]]
        found = np.frombuffer(binary, kind, accessor["count"] * width, start)
        arrays.append(found.reshape(-1, width))
    return document, arrays


def _animated(document, arrays):
    """Keyframes by name of node and property: times, values."""
    animation = document["animations"][0]
    found = {}
    for channel in animation["channels"]:
        sampler = animation["samplers"][channel["sampler"]]
        name = document["nodes"][channel["target"]["node"]]["name"]
        key = (channel["target"]["node"], name, channel["target"]["path"])
        found[key] = arrays[sampler["input"]][:, 0], arrays[sampler["output"]]
    return found


def _global_transforms(document, tracks, frame):
    """Of every node, from nothing but the file; `frame` is a keyframe's number."""
    nodes = document["nodes"]
    local = []
    for k, node in enumerate(nodes):
        value = {p: node.get(p) for p in ("translation", "rotation", "scale")}
        for (at, _, what), (_, values) in tracks.items():
            if at == k:
                value[what] = values[frame]
        T = np.eye(4)
        if value["rotation"] is not None:
            T[:3, :3] = Rotation.from_quat(value["rotation"]).as_matrix()
        if value["scale"] is not None:
            T[:3, :3] = T[:3, :3] * value["scale"]
        if value["translation"] is not None:
            T[:3, 3] = value["translation"]
        local.append(T)
    found = {}

    def visit(k, above):
        found[k] = above @ local[k]
        for child in nodes[k].get("children", ()):
            visit(child, found[k])

    for root in document["scenes"][0]["nodes"]:
        visit(root, np.eye(4))
    return found


def test_glb_holds_joints_skin_and_camera(tmp_path, result, body):
    (path,) = export.export(result, tmp_path / "a.glb", body=body)
    document, arrays = _read_glb(path)
    tracks = _animated(document, arrays)
    names = [node["name"] for node in document["nodes"]]
    assert {"person_0", "person_1", "camera", "map", "ground"} <= set(names)
    camera = document["cameras"][0]["perspective"]
    np.testing.assert_allclose(np.tan(camera["yfov"] / 2), 240 / 510)
    np.testing.assert_allclose(camera["aspectRatio"], 640 / 480 * 510 / 500)
    for frame in (0, 3, 11):
        T = _global_transforms(document, tracks, frame)
        for h, skin in enumerate(document["skins"]):
            found = np.array([T[k][:3, 3] for k in skin["joints"]])
            np.testing.assert_allclose(found, result.joints[h, frame], atol=1e-5)
            mesh = next(n for n in document["nodes"] if n.get("skin") == h)["mesh"]
            part = document["meshes"][mesh]["primitives"][0]["attributes"]
            rest, joint, weight = (
                arrays[part[n]] for n in ("POSITION", "JOINTS_0", "WEIGHTS_0")
            )
            bind = arrays[skin["inverseBindMatrices"]].reshape(24, 4, 4)
            moves = np.array([T[k] for k in skin["joints"]]) @ bind.transpose(0, 2, 1)
            each = np.einsum("vkij,vj->vki", moves[joint][..., :3, :3], rest)
            posed = ((each + moves[joint][..., :3, 3]) * weight[..., None]).sum(1)
            true = vertices(
                body,
                *(
                    jnp.asarray(x)
                    for x in (
                        result.poses[h, frame],
                        result.betas[h],
                        result.trans[h, frame],
                    )
                ),
            )
            # Four joints a vertex in place of six: millimetres, at folded limbs.
            away = np.linalg.norm(posed - true, axis=1)
            assert away.mean() < 1e-4 and away.max() < 0.02
        at = names.index("camera")
        np.testing.assert_allclose(
            T[at], result.T_WC[frame] @ np.diag([1, -1, -1, 1.0]), atol=1e-6
        )
    times = tracks[names.index("camera"), "camera", "translation"][0]
    np.testing.assert_allclose(times, result.timestamps, atol=1e-6)


def test_glb_hides_who_is_absent(tmp_path, result, body):
    (path,) = export.export(result, tmp_path / "a.glb", body=body)
    tracks = _animated(*_read_glb(path))
    scales = {name: v for (_, name, what), (_, v) in tracks.items() if what == "scale"}
    assert list(scales) == ["person_1"]
    np.testing.assert_array_equal(scales["person_1"][:, 0] > 0, result.present[1])


def test_glb_opens_in_trimesh(tmp_path, result, body):
    (path,) = export.export(result, tmp_path / "a.glb", body=body)
    found = trimesh.load(path)
    assert isinstance(found, trimesh.Scene)
    points = found.geometry["map"].vertices
    np.testing.assert_allclose(points, result.landmarks, atol=1e-6)
    ground = found.geometry["ground"].vertices
    np.testing.assert_array_equal(ground[:, 1], 0)


def test_one_person(tmp_path, result, body):
    (path,) = export.export(result, tmp_path / "a.glb", body=body, person=1)
    document, _ = _read_glb(path)
    names = [node["name"] for node in document["nodes"]]
    assert "person_1" in names and "person_0" not in names
    with pytest.raises(ValueError, match="--person 2: not in this run, expected 0, 1"):
        export.export(result, tmp_path / "b.glb", body=body, person=2)
    assert not (tmp_path / "b.glb").exists()


def _read_bvh(text):
    """Positions of all joints (cm) by name, from nothing but the BVH."""
    header, motion = text.split("MOTION")
    parents, names, offsets, stack = [], [], [], []
    for line in header.splitlines():
        words = line.split()
        if words[0] in ("ROOT", "JOINT", "End"):
            names.append(words[1] if words[0] != "End" else None)
            parents.append(stack[-1] if stack else -1)
        elif words[0] == "{":
            stack.append(len(names) - 1)
        elif words[0] == "}":
            stack.pop()
        elif words[0] == "OFFSET":
            offsets.append([float(x) for x in words[1:]])
    rows = [[float(x) for x in line.split()] for line in motion.splitlines()[3:]]
    rows = np.array(rows)
    place, turn, column = {}, {}, 3
    for k, name in enumerate(names):
        if name is None:
            continue
        angles = Rotation.from_euler("ZXY", rows[:, column : column + 3], degrees=True)
        column += 3
        p = parents[k]
        place[k] = rows[:, :3] if p < 0 else place[p] + turn[p].apply(offsets[k])
        turn[k] = angles if p < 0 else turn[p] * angles
    return {names[k]: x for k, x in place.items()}


@pytest.mark.parametrize("up", ["y", "z"])
def test_bvh_holds_the_joints(tmp_path, result, body, up):
    (path,) = export.export(result, tmp_path / "a.bvh", up=up, person=1, body=body)
    found = _read_bvh(path.read_text())
    R = Y_TO_Z if up == "z" else np.eye(3)
    there = result.present[1]
    for k, name in enumerate(MIXAMO_NAMES):
        true = result.joints[1, :, k] @ R.T
        np.testing.assert_allclose(found[name][there] / 100, true[there], atol=1e-5)
        # Absent, somebody stays as seen last.
        np.testing.assert_array_equal(found[name][5:8], found[name][[4, 4, 4]])


def test_bvh_with_other_names(tmp_path, result, body):
    export.write_bvh(tmp_path / "a.bvh", result, body, 0, JOINT_NAMES)
    found = _read_bvh((tmp_path / "a.bvh").read_text())
    for k, name in enumerate(JOINT_NAMES):
        np.testing.assert_allclose(found[name] / 100, result.joints[0, :, k], atol=1e-5)


def test_each_person_has_a_file(tmp_path, result, body):
    found = export.export(result, tmp_path / "walk.bvh", body=body)
    assert [p.name for p in found] == ["walk_0.bvh", "walk_1.bvh"]
    found = export.export(result, tmp_path / "all", to=("bvh", "tum"), body=body)
    names = {p.name for p in (tmp_path / "all").iterdir()}
    assert (
        names
        == {"person_0.bvh", "person_1.bvh", "camera.tum"}
        == {p.name for p in found}
    )


def test_csv_holds_joints_angles_and_speeds(tmp_path, result, body):
    sigma = np.full(result.joints.shape[:3], 0.03)
    sigma[0] = 0.5  # somebody else's
    places = np.ones(result.joints.shape[:2] + (3,)) * [0.1, 0.2, 0.3]
    places[0] = 0.5
    known = dataclasses.replace(result, joint_sigma=sigma, root_sigma=places)
    (path,) = export.export(known, tmp_path / "a.csv", body=body, person=1)
    rows = list(csv.DictReader(path.read_text().splitlines()))
    assert len(rows) == len(result.timestamps)
    k = int(np.flatnonzero(result.present[1])[2])
    row = rows[k]
    found = [float(row[f"left_knee_{axis}_m"]) for axis in "xyz"]
    np.testing.assert_allclose(found, result.joints[1, k, 4], rtol=1e-4, atol=1e-6)
    assert float(row["left_knee_sigma_m"]) == 0.03
    found = [float(row[f"pelvis_place_{axis}_sigma_m"]) for axis in "xyz"]
    assert found == [0.1, 0.2, 0.3]
    (path,) = export.export(known, tmp_path / "z.csv", up="z", body=body, person=1)
    row = list(csv.DictReader(path.read_text().splitlines()))[k]
    found = [float(row[f"pelvis_place_{axis}_sigma_m"]) for axis in "xyz"]
    np.testing.assert_allclose(sorted(found), [0.1, 0.2, 0.3], rtol=1e-4)
    assert found[2] == pytest.approx(0.2)  # the height's
    assert float(row["time_s"]) == pytest.approx(result.timestamps[k], abs=1e-6)
    absent = np.flatnonzero(~result.present[1])
    assert len(absent) and all(rows[k]["pelvis_x_m"] == "" for k in absent)


def test_opensim_has_the_same_markers_in_model_data_and_tasks(tmp_path, result, body):
    """The model has this person's bones; `test_export_clients.py` runs the program."""
    (path,) = export.export(result, tmp_path / "a", "opensim", body=body, person=1)
    model = ElementTree.parse(path / "model.osim")
    found = {
        point.get("name"): np.array(point.findtext("location", "").split(), float)
        for point in model.iter("Marker")
    }
    tasks = ElementTree.parse(path / "inverse_kinematics.xml")
    assert [task.get("name") for task in tasks.iter("IKMarkerTask")] == list(found)
    rows = [r.split("\t") for r in (path / "markers.trc").read_text().splitlines()]
    assert [name for name in rows[3][2:] if name] == list(found)
    values = np.array([r[2 : 2 + 3 * len(found)] for r in rows[6:]])
    there = result.present[1]
    assert (values[~there] == "").all()
    points = values[there].astype(float).reshape(there.sum(), -1, 3) / 1000
    at = {name: points[:, k] for k, name in enumerate(found)}
    for joint, name in ((4, "left_knee"), (8, "right_ankle"), (20, "left_wrist")):
        np.testing.assert_allclose(at[name], result.joints[1, there, joint], atol=1e-6)
        bone = result.joints[1, there, joint] - result.joints[1, there, PARENTS[joint]]
        length = np.linalg.norm(bone, axis=-1)
        np.testing.assert_allclose(np.linalg.norm(found[name]), length, rtol=1e-5)
    # A positive coordinate swings the limb forwards (x), or the shin backwards.
    axes = {axis.findtext("coordinates"): axis for axis in model.iter("TransformAxis")}
    for name, marker, ahead in (
        ("hip_flexion_r", "right_knee", 1),
        ("knee_angle_l", "left_ankle", -1),
        ("arm_flex_l", "left_elbow", 1),
    ):
        about = np.array(axes[name].findtext("axis", "").split(), float)
        assert np.cross(about, found[marker])[0] * ahead > 0.1, name
    # What the model has between markers of a segment, the data have in every frame.
    for a, b in (("left_ankle", "tibia_l_front"), ("humerus_r_right", "right_elbow")):
        between = np.linalg.norm(at[a] - at[b], axis=-1)
        expected = np.linalg.norm(found[a] - found[b])
        np.testing.assert_allclose(between, expected, rtol=1e-4)


def test_angles_of_joints_have_the_signs_of_the_field():
    """A leg swings forward, outwards and turns in; knees, ankles and elbows bend."""

    def turned(joint, about, degrees):
        turns = np.tile(np.eye(3), (1, 24, 1, 1))
        turns[0, joint] = Rotation.from_euler(about, degrees, True).as_matrix()
        return turns

    straight = np.zeros((1, 24, 3))
    straight[0, 12] = [0, 1, 0]  # the neck over the pelvis
    straight[0, [18, 20], 0] = [0.3, 0.55]  # the left arm, stretched to its side
    up = np.array([0.0, 1, 0])
    angle = lambda turns, name: float(isb.angles(turns, straight, up)[name][0])
    # SMPL's axes: x left, y up, z forward. About -x the leg below the hip goes forward.
    assert angle(turned(1, "x", -30), "left_hip_flexion_deg") == pytest.approx(30)
    assert angle(turned(2, "x", -30), "right_hip_flexion_deg") == pytest.approx(30)
    assert angle(turned(5, "x", 40), "right_knee_flexion_deg") == pytest.approx(40)
    assert angle(turned(7, "x", -10), "left_ankle_dorsiflexion_deg") == pytest.approx(
        10
    )
    for side, joint, sign in (("left", 1, 1), ("right", 2, -1)):
        # About z a left leg (on the side of +x) goes outwards.
        out, inwards = turned(joint, "z", sign * 20), turned(joint, "y", -sign * 15)
        assert angle(out, f"{side}_hip_adduction_deg") == pytest.approx(-20)
        assert angle(inwards, f"{side}_hip_internal_rotation_deg") == pytest.approx(15)
    none = np.tile(np.eye(3), (1, 24, 1, 1))
    assert angle(none, "left_shoulder_elevation_deg") == pytest.approx(90)
    assert angle(none, "left_elbow_flexion_deg") == pytest.approx(0)
    assert angle(none, "trunk_lean_deg") == pytest.approx(0)


def test_speeds_are_those_of_a_line():
    times = np.arange(5) / 25
    joints = np.zeros((5, 24, 3))
    joints[..., 0], joints[:, 0, 1] = 1.5 * times[:, None], 7 * times
    present = np.array([True, True, True, True, False])
    found = isb.speeds(joints, present, times, np.array([0.0, 1, 0]))
    np.testing.assert_allclose(found["pelvis_speed_m_s"][1:3], 1.5)
    assert np.isnan(found["left_wrist_speed_m_s"][[0, 3, 4]]).all()


def test_trc_holds_the_joints(tmp_path, result, body):
    found = export.export(result, tmp_path / "a.trc", body=body)
    rows = found[1].read_text().splitlines()
    first = np.array(rows[6].split("\t")[2:], float).reshape(24, 3)
    np.testing.assert_allclose(first / 1000, result.joints[1, 0], atol=1e-6)
    assert not any(rows[6 + 5].split("\t")[2:])


def test_c3d_holds_the_joints(tmp_path, result, body):
    found = export.export(result, tmp_path / "a.c3d", body=body, up="z")
    data = found[1].read_bytes()
    count, _, first, last = struct.unpack_from("<HHHH", data, 2)
    (start,) = struct.unpack_from("<H", data, 16)
    (rate,) = struct.unpack_from("<f", data, 20)
    assert (count, first, last, rate) == (24, 1, NUM_FRAMES, FPS)
    points = np.frombuffer(data, "<f4", NUM_FRAMES * 96, (start - 1) * 512)
    points = points.reshape(NUM_FRAMES, 24, 4)
    there = result.present[1]
    residuals = np.where(there, 0, -1)[:, None].repeat(24, axis=1)
    np.testing.assert_array_equal(points[..., 3], residuals)
    true = result.joints[1, there] @ Y_TO_Z.T
    np.testing.assert_allclose(points[there, :, :3] / 1000, true, atol=1e-6)


def test_amass_is_read_as_ground_truth(tmp_path, result, body):
    found = export.export(result, tmp_path / "a.npz", body=body)
    with np.load(found[1], allow_pickle=False) as data:
        assert data["mocap_framerate"] == data["mocap_frame_rate"] == FPS
        assert data["poses"].shape == (NUM_FRAMES, 156)
    truth = evaluation.read_groundtruth(found[1], body)
    np.testing.assert_array_equal(truth.present[0], result.present[1])
    there = result.present[1]
    # SMPL's hands are no joints of SMPL-H, but turn none of the others.
    np.testing.assert_allclose(
        truth.joints[0, there], result.joints[1, there], atol=1e-9
    )


def test_amass_with_z_up_is_the_same_body_turned(tmp_path, result, body):
    found = export.export(result, tmp_path / "a.npz", body=body, up="z")
    truth = evaluation.read_groundtruth(found[0], body)
    np.testing.assert_allclose(truth.joints[0], result.joints[0] @ Y_TO_Z.T, atol=1e-9)


@pytest.mark.parametrize("up", ["y", "z"])
def test_tum_and_kitti_are_read_by_evo(tmp_path, result, body, up):
    cut = dataclasses.replace(result, summary={"frames_used": [2, 8]})
    found = export.export(cut, tmp_path, to=("tum", "kitti"), body=body, up=up)
    true = result.T_WC[2:9].copy()
    if up == "z":
        true[:, :3] = Y_TO_Z @ true[:, :3]
    tum = file_interface.read_tum_trajectory_file(found[0])
    np.testing.assert_allclose(tum.poses_se3, true, atol=1e-8)
    np.testing.assert_allclose(tum.timestamps, result.timestamps[2:9], atol=1e-9)
    kitti = file_interface.read_kitti_poses_file(found[1])
    np.testing.assert_allclose(kitti.poses_se3, true, atol=1e-8)


@pytest.mark.parametrize("form", ["colmap", "nerfstudio"])
@pytest.mark.parametrize("distorted", [False, True])
@pytest.mark.parametrize("up", ["y", "z"])
def test_cameras_come_back(tmp_path, body, form, distorted, up):
    result = make_result(body, distorted)
    summary = {**result.summary, "frames_used": [0, 8]}
    result = dataclasses.replace(result, summary=summary)
    seen = observe(result)
    (path,) = export.export(
        result, tmp_path / "out", to=form, up=up, body=body, observations=seen
    )
    true = result.T_WC[:9].copy()
    if up == "z":
        true[:, :3] = Y_TO_Z @ true[:, :3]
    files = {
        "colmap": ["sparse/0/cameras.txt", "sparse/0/cameras.bin"],
        "nerfstudio": ["transforms.json"],
    }[form]
    for name in files:
        intrinsics, _ = read_camera(path / name, SIZE)
        np.testing.assert_allclose(intrinsics.params, result.intrinsics, atol=1e-9)
        assert (intrinsics.width, intrinsics.height) == SIZE
        found = read_camera_path(
            path / name.replace("cameras", "images"),
            timestamps=result.timestamps,
            metric=True,
            warn=lambda _: None,
        )
        np.testing.assert_array_equal(found.known, np.arange(NUM_FRAMES) < 9)
        np.testing.assert_allclose(found.T_WC[:9], true, atol=1e-9)


def test_text_and_binary_are_the_same_model(tmp_path, result, body):
    seen = observe(result)
    (path,) = export.export(
        result, tmp_path / "out", to="colmap", body=body, observations=seen
    )
    folder = path / "sparse" / "0"
    rows = (folder / "images.txt").read_text().splitlines()[2:]
    data, at = (folder / "images.bin").read_bytes(), 8
    lines = (folder / "points3D.txt").read_text().splitlines()[1:]
    for k in range(NUM_FRAMES):
        at += struct.calcsize("<i7di")
        at = data.index(b"\0", at) + 1
        (count,) = struct.unpack_from("<Q", data, at)
        kind = [("uv", "<f8", 2), ("point", "<i8")]
        binary = np.frombuffer(data, kind, count, at + 8)
        at += 8 + binary.nbytes
        text = np.array(rows[2 * k + 1].split(), float).reshape(-1, 3)
        np.testing.assert_allclose(binary["uv"], text[:, :2], atol=1e-6)
        np.testing.assert_array_equal(binary["point"], text[:, 2])
    assert at == len(data)
    errors = [float(line.split()[7]) for line in lines]
    np.testing.assert_allclose(errors, 0.5, atol=1e-9)
    # A point's track leads back to it.
    words = lines[3].split()
    image, index = int(words[8]), int(words[9])
    found = np.array(rows[2 * image - 1].split(), float).reshape(-1, 3)[index, 2]
    assert found == int(words[0])


def test_without_observations_points_are_alone(tmp_path, result, body):
    (path,) = export.export(result, tmp_path / "out", to="colmap", body=body)
    rows = (path / "sparse/0/points3D.txt").read_text().splitlines()[1:]
    assert len(rows) == len(result.landmarks)
    assert all(len(row.split()) == 8 for row in rows)


def test_a_zooming_camera_has_one_lens_an_image(tmp_path, result, body):
    factor = np.linspace(1, 1.5, NUM_FRAMES)
    seen = dataclasses.replace(observe(result), zoom=factor)
    found = export.export(
        result, tmp_path, to=("colmap", "nerfstudio"), body=body, observations=seen
    )
    rows = (found[0] / "sparse/0/cameras.txt").read_text().splitlines()[1:]
    focal = [float(row.split()[4]) for row in rows]
    np.testing.assert_allclose(focal, 500 * factor)
    frames = json.loads((found[1] / "transforms.json").read_text())["frames"]
    np.testing.assert_allclose([row["fl_x"] for row in frames], 500 * factor)


def test_images_are_written_beside_the_cameras(tmp_path, result, body):
    import cv2

    source = tmp_path / "images"
    source.mkdir()
    for k in range(NUM_FRAMES):
        gray = np.full((SIZE[1], SIZE[0]), 10 * k, np.uint8)
        cv2.imwrite(str(source / f"shot{k + 7}.png"), gray)
    found = export.export(
        result, tmp_path / "a", to=("colmap", "nerfstudio"), body=body, video=source
    )
    names = [f"shot{k + 7}.png" for k in range(NUM_FRAMES)]
    rows = (found[0] / "sparse/0/images.txt").read_text().splitlines()[2::2]
    assert [row.split()[-1] for row in rows] == names
    assert {p.name for p in (found[0] / "images").iterdir()} == set(names)
    for row in json.loads((found[1] / "transforms.json").read_text())["frames"]:
        assert (found[1] / row["file_path"]).exists()
    short = dataclasses.replace(result, timestamps=result.timestamps * 3)
    (source / "shot18.png").unlink()
    with pytest.raises(ValueError, match="another video"):
        export.export(short, tmp_path / "b", to="colmap", body=body, video=source)
    assert not (tmp_path / "b").exists()


def test_frames_of_a_video_are_extracted(tmp_path, result, body):
    import cv2

    video = tmp_path / "a.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), FPS, SIZE)
    for k in range(NUM_FRAMES + 4):
        writer.write(np.full((SIZE[1], SIZE[0], 3), 10 * k, np.uint8))
    writer.release()
    later = dataclasses.replace(result, timestamps=result.timestamps + 3 / FPS)
    (path,) = export.export(
        later, tmp_path / "out", to="nerfstudio", body=body, video=video
    )
    image = cv2.imread(str(path / "images" / "frame_000002.jpg"))
    assert image is not None and abs(float(image.mean()) - 50) < 2


def test_an_uneven_video_is_resampled_for_formats_with_a_rate(tmp_path, result, body):
    gap = result.timestamps + np.where(np.arange(NUM_FRAMES) > 5, 4 / FPS, 0)
    uneven = dataclasses.replace(result, timestamps=gap)
    (path,) = export.export(uneven, tmp_path / "a.bvh", body=body, person=0)
    found = _read_bvh(path.read_text())["Hips"]
    assert len(found) == NUM_FRAMES + 4
    np.testing.assert_allclose(found[:6] / 100, result.joints[0, :6, 0], atol=1e-5)
    np.testing.assert_allclose(found[10:] / 100, result.joints[0, 6:, 0], atol=1e-5)


def test_nobody_and_no_map(tmp_path, result, body):
    empty = dataclasses.replace(without_people(result), landmarks=result.landmarks[:0])
    wanted = ("glb", "colmap", "nerfstudio", "tum", "kitti")
    export.export(empty, tmp_path / "a", to=wanted, body=body)
    document, _ = _read_glb(tmp_path / "a" / "scene.glb")
    assert [n["name"] for n in document["nodes"]] == ["camera"]
    with pytest.raises(ValueError, match="nobody is in this run"):
        export.export(empty, tmp_path / "b.bvh", body=body)


def test_another_body_model_is_refused(tmp_path, result, body):
    other = dataclasses.replace(body, joint_template=1.1 * body.joint_template)
    with pytest.raises(ValueError, match="cm off the run's.*--body-model"):
        export.export(result, tmp_path / "a.glb", body=other)


def test_unknown_formats_and_missing_extras(tmp_path, result, body, monkeypatch):
    with pytest.raises(ValueError, match="suffix '.fbx' names no format, expected"):
        export.export(result, tmp_path / "a.fbx", body=body)
    with pytest.raises(ValueError, match="--to fbx: unknown"):
        export.export(result, tmp_path / "a", to="fbx", body=body)
    for name in ("usd", "rerun"):
        module = importlib.import_module(formats.FORMATS[name].module)
        monkeypatch.setattr(module, "is_installed", lambda: False)
        with pytest.raises(ValueError, match=rf"pip install 'bodyslam-jax\[{name}\]'"):
            export.export(result, tmp_path / "a", to=name, body=body)
    assert not list(tmp_path.iterdir())


def test_an_old_export_is_replaced_whole(tmp_path, result, body):
    (path,) = export.export(result, tmp_path / "out", to="colmap", body=body)
    (path / "sparse" / "0" / "rigs.bin").write_bytes(b"old")
    (path / "notes.txt").write_text("mine")
    export.export(result, tmp_path / "out", to="colmap", body=body)
    assert not (path / "sparse" / "0" / "rigs.bin").exists()
    assert (path / "notes.txt").read_text() == "mine"
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


def test_folders_of_others_are_left_alone(tmp_path, result, body):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="mine: has files.*another one"):
        export.export(result, tmp_path / "mine", to="nerfstudio", body=body)
    (path,) = export.export(result, tmp_path / "mine", to="tum", body=body)
    assert path == tmp_path / "mine" / "camera.tum"
    with pytest.raises(ValueError, match="a.glb: a file, expected a folder"):
        export.export(result, tmp_path / "a.glb", to=("glb", "tum"), body=body)
    assert (tmp_path / "mine" / "notes.txt").read_text() == "mine"


def test_a_result_exports_itself(tmp_path, result, body):
    (path,) = result.export(tmp_path / "a.tum", body=body)
    assert len(io.read_tum(path)[0]) == NUM_FRAMES


def test_observations_of_a_run(tmp_path, result):
    seen = observe(result)
    cache = tmp_path / ".cache"
    cache.mkdir()
    keep = np.arange(len(seen.frame)) % 3 > 0
    arrays = {
        ".tracks.frame": seen.frame,
        ".tracks.landmark": seen.landmark,
        ".tracks.uv": seen.uv,
        ".keep": keep,
        ".landmarks": result.landmarks,
    }
    np.savez(cache / "cameras-0123.npz", **arrays)
    found = formats.read_observations(tmp_path, result)
    assert found is not None and found.zoom is None
    np.testing.assert_array_equal(found.uv, seen.uv[keep])
    few = dataclasses.replace(result, landmarks=result.landmarks[1:])
    assert formats.read_observations(tmp_path, few) is None
    (cache / "cameras-0123.npz").write_bytes(b"damaged")
    assert formats.read_observations(tmp_path, result) is None


def test_the_observations_are_where_the_pipeline_keeps_them(tmp_path, result):
    """The stage cache names its arrays by the fields of `SfmResult`."""
    from bodyslam_jax.pipeline import stage_cache
    from bodyslam_jax.types import SfmResult, Tracks

    seen = observe(result)
    n, m = len(result.landmarks), len(seen.frame)
    zoom = np.linspace(0, 0.2, NUM_FRAMES)
    cameras = SfmResult(
        kind="moving",
        T_WC=result.T_WC,
        registered=np.ones(NUM_FRAMES, bool),
        landmarks=result.landmarks,
        tracks=Tracks(seen.frame, seen.landmark, seen.uv),
        keep=np.ones(m, bool),
        prior_information=np.zeros((n, 3, 3)),
        prior_mean=np.zeros((n, 3)),
        pixel_sigma=1.0,
        intrinsics=result.intrinsics,
        focal_sigma=1.0,
        costs=(0.0, 0.0),
        warnings=(),
        zoom=zoom,
    )
    cache = stage_cache.Cache(tmp_path / ".cache")
    cache.stage("cameras", "0123", SfmResult, lambda: cameras)
    found = formats.read_observations(tmp_path, result)
    assert found is not None
    np.testing.assert_allclose(found.zoom, np.exp(zoom))
    centre = result.intrinsics[2:4]
    undone = centre + (found.uv - centre) / found.zoom[found.frame][:, None]
    np.testing.assert_allclose(undone, seen.uv)


def test_command_line_knows_every_format():
    assert set(get_args(Formats)) == set(formats.FORMATS)


def test_the_table_of_the_documentation_is_that_of_the_code():
    page = Path(__file__).parents[1] / "docs" / "export.md"
    assert formats.table() in page.read_text()


@pytest.mark.slow
def test_command(tmp_path, result):
    """Through a process of its own; bodies are the default's, in single precision."""
    body = load_body_model(dtype=jnp.float64)
    posed = joints(
        body,
        *map(jnp.asarray, (result.poses, result.betas[:, None], result.trans)),
    )
    result = dataclasses.replace(result, joints=np.asarray(posed))
    export.write_run(tmp_path / "run", result)
    command = [sys.executable, "-m", "bodyslam_jax", "export", str(tmp_path / "run")]
    done = subprocess.run(
        [*command, "--to", "glb", "bvh", "--person", "0", "--up", "z"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    files = [Path(line) for line in done.stdout.splitlines()]
    assert [f.name for f in files] == ["scene.glb", "person_0.bvh"]
    assert all(f.parent == tmp_path / "run" / "export" for f in files)
    assert "y is up in it by its specification" in done.stderr
    done = subprocess.run(
        [*command, "--out", str(tmp_path / "a.fbx")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1 and done.stderr.count("\n") == 1


def test_files_name_themselves_and_no_temporary_file(tmp_path, result, body):
    names = tuple(n for n, f in formats.FORMATS.items() if f.extra is None)
    export.export(result, tmp_path, names, body=body)
    files = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert not [path for path in files if b".partial" in path.read_bytes()]
    for path in tmp_path.glob("*.trc"):
        first = path.read_text().splitlines()[0]
        assert first.split("\t")[-1] == path.name
