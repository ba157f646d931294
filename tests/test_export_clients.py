"""Exported files in the programs that they are for; see `clients.py`."""

import dataclasses
import json
import os
import shutil
import subprocess

import jax.numpy as jnp
import numpy as np
import pytest
from clients import run
from export_cases import FPS, NUM_FRAMES, SIZE, make_result, observe
from scipy.spatial.transform import Rotation

from bodyslam_jax import export
from bodyslam_jax.body import JOINT_NAMES, joints, load_body_model, write_npz
from bodyslam_jax.export.formats.bvh import MIXAMO_NAMES
from bodyslam_jax.export.formats.csv import angles

pytestmark = pytest.mark.slow
Y_TO_Z = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
FRAMES = (0, 2, 4, 8, 11)
"""In which everybody is present."""


@pytest.fixture(scope="module")
def body():
    return load_body_model(dtype=jnp.float64)


@pytest.fixture(scope="module")
def result(body):
    return make_result(body)


_BLENDER = """
import bpy, json, sys
import numpy as np
path, fps, frames, names, scale = sys.argv[1:6]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = int(float(fps))
if path.endswith(".bvh"):
    bpy.ops.import_anim.bvh(
        filepath=path, global_scale=float(scale), frame_start=0, use_fps_scale=False
    )
else:
    bpy.ops.import_scene.gltf(filepath=path)
bodies = [o for o in bpy.data.objects if o.type == "ARMATURE"]
bodies.sort(key=lambda o: o.name)
cameras = [o for o in bpy.data.objects if o.type == "CAMERA"]
found = {"names": [o.name for o in bodies], "joints": [], "cameras": []}
for frame in json.loads(frames):
    # The importer puts a BVH's first frame one after `frame_start`.
    bpy.context.scene.frame_set(frame + path.endswith(".bvh"))
    graph = bpy.context.evaluated_depsgraph_get()
    people = []
    for armature in bodies:
        armature = armature.evaluated_get(graph)
        bones = [armature.pose.bones[n] for n in json.loads(names)]
        people.append([list(armature.matrix_world @ b.head) for b in bones])
    found["joints"].append(people)
    for camera in cameras:
        camera = camera.evaluated_get(graph)
        found["cameras"].append([list(row) for row in camera.matrix_world])
        found["angle"] = camera.data.angle_y
print()
print(json.dumps(found))
"""


def test_blender_opens_glb(tmp_path, result, body):
    (path,) = export.export(result, tmp_path / "a.glb", body=body)
    arguments = (path, FPS, json.dumps(FRAMES), json.dumps(JOINT_NAMES), 1)
    found = run("bpy", _BLENDER, *arguments)
    assert found["names"] == ["person_0", "person_1"]
    true = result.joints[:, list(FRAMES)].swapaxes(0, 1) @ Y_TO_Z.T
    np.testing.assert_allclose(found["joints"], true, atol=1e-3)  # m
    for frame, pose in zip(FRAMES, found["cameras"], strict=True):
        T = np.array(result.T_WC[frame])
        true = np.eye(4)
        true[:3] = Y_TO_Z @ T[:3]
        np.testing.assert_allclose(pose, true @ np.diag([1, -1, -1, 1]), atol=1e-5)
    np.testing.assert_allclose(np.tan(found["angle"] / 2), 240 / 510, rtol=1e-5)


def test_blender_opens_bvh(tmp_path, result, body):
    (path,) = export.export(result, tmp_path / "a.bvh", body=body, person=1)
    arguments = (path, FPS, json.dumps(FRAMES), json.dumps(MIXAMO_NAMES), 0.01)
    found = run("bpy", _BLENDER, *arguments)
    true = result.joints[1, list(FRAMES)] @ Y_TO_Z.T
    np.testing.assert_allclose(np.array(found["joints"])[:, 0], true, atol=1e-2)  # m


_VALIDATOR = """
const validator = require("gltf-validator"), fs = require("fs");
const data = new Uint8Array(fs.readFileSync(process.argv[2]));
validator.validateBytes(data).then(found => console.log(JSON.stringify(found.issues)));
"""


def test_khronos_validator_finds_nothing(tmp_path, result, body):
    """Node finds `gltf-validator` in `NODE_PATH`."""
    node = shutil.which("node")
    look = [node or "node", "-e", 'require("gltf-validator")']
    if node is None or subprocess.run(look, capture_output=True).returncode:
        pytest.skip("no gltf-validator (npm), or not in NODE_PATH")
    (path,) = export.export(result, tmp_path / "a.glb", body=body)
    script = tmp_path / "validate.js"
    script.write_text(_VALIDATOR)
    done = subprocess.run(
        [node, script, path], capture_output=True, text=True, check=True, env=os.environ
    )
    issues = json.loads(done.stdout)
    assert issues["numErrors"] == issues["numWarnings"] == 0, issues["messages"]


_COLMAP = """
import json, sys
import numpy as np
import pycolmap
found = {}
for kind in ("text", "binary"):
    model = pycolmap.Reconstruction()
    getattr(model, f"read_{kind}")(sys.argv[1])
    stored = model.compute_mean_reprojection_error()
    model.update_point_3d_errors()
    points = model.points3D.values()
    total = sum(point.error * point.track.length() for point in points)
    camera = model.cameras[1]
    images = sorted(model.images.values(), key=lambda image: image.name)
    found[kind] = {
        "model": camera.model_name,
        "params": list(camera.params),
        "size": [camera.width, camera.height],
        "stored": stored,
        "of_observations": total / model.compute_num_observations(),
        "computed": model.compute_mean_reprojection_error(),
        "observations": model.compute_num_observations(),
        "names": [image.name for image in images],
        "centres": [list(image.projection_center()) for image in images],
        "points": [list(model.points3D[k].xyz) for k in sorted(model.points3D)],
    }
print(json.dumps(found))
"""


@pytest.mark.parametrize("distorted", [False, True])
def test_pycolmap_opens_the_model(tmp_path, body, distorted):
    result = make_result(body, distorted)
    seen = observe(result, error=0.7)
    (path,) = export.export(
        result, tmp_path / "a", to="colmap", body=body, observations=seen
    )
    found = run("pycolmap", _COLMAP, path / "sparse" / "0")
    for one in found.values():
        assert one["model"] == ("OPENCV" if distorted else "PINHOLE")
        shift = np.array([0, 0, 0.5, 0.5] + [0] * 4)[: len(result.intrinsics)]
        np.testing.assert_allclose(one["params"], result.intrinsics + shift)
        assert tuple(one["size"]) == SIZE
        assert one["observations"] == len(seen.frame)
        assert one["names"] == [f"frame_{k:06d}.jpg" for k in range(NUM_FRAMES)]
        np.testing.assert_allclose(one["stored"], 0.7, atol=1e-6)
        np.testing.assert_allclose(one["computed"], 0.7, atol=1e-6)
        np.testing.assert_allclose(one["of_observations"], 0.7, atol=1e-6)
        np.testing.assert_allclose(one["centres"], result.T_WC[:, :3, 3], atol=1e-9)
        np.testing.assert_allclose(one["points"], result.landmarks, atol=1e-9)


_C3D = """
import json, sys
import ezc3d
found = ezc3d.c3d(sys.argv[1])
point = found["parameters"]["POINT"]
value = lambda name: point[name]["value"]
residuals = found["data"]["meta_points"]["residuals"][0]
print(json.dumps({
    "labels": value("LABELS"), "units": value("UNITS"), "rate": float(value("RATE")[0]),
    "screen": value("X_SCREEN") + value("Y_SCREEN"),
    "points": found["data"]["points"][:3].transpose(2, 1, 0).tolist(),
    "missing": (residuals < 0).all(axis=0).tolist(),
}))
"""


def test_ezc3d_opens_c3d(tmp_path, result, body):
    (path,) = export.export(result, tmp_path / "a.c3d", body=body, person=1, up="z")
    found = run("ezc3d", _C3D, path)
    assert found["labels"] == list(JOINT_NAMES)
    assert (found["units"], found["rate"], found["screen"]) == (
        ["mm"],
        FPS,
        ["+X", "+Z"],
    )
    there = result.present[1]
    np.testing.assert_array_equal(np.logical_not(found["missing"]), there)
    points = np.array(found["points"], float)[there] / 1000
    np.testing.assert_allclose(points, result.joints[1, there] @ Y_TO_Z.T, atol=1e-6)


_OPENSIM = """
import json, sys
import numpy as np
import opensim
table = opensim.TimeSeriesTableVec3(sys.argv[1])
rows = [table.getRowAtIndex(k) for k in range(table.getNumRows())]
print()
print(json.dumps({
    "labels": list(table.getColumnLabels()),
    "times": list(table.getIndependentColumn()),
    "units": table.getTableMetaDataAsString("Units"),
    "points": [[[r[j][i] for i in range(3)] for j in range(24)] for r in rows],
}))
"""


def test_opensim_opens_trc(tmp_path, result, body):
    (path,) = export.export(result, tmp_path / "a.trc", body=body, person=1)
    found = run("opensim", _OPENSIM, path)
    assert found["labels"] == list(JOINT_NAMES)
    assert found["units"] == "mm"
    np.testing.assert_allclose(found["times"], result.timestamps, atol=1e-4)
    there = result.present[1]
    points = np.array(found["points"], float)
    np.testing.assert_allclose(points[there] / 1000, result.joints[1, there], atol=1e-5)
    assert np.isnan(points[~there]).all()


_INVERSE_KINEMATICS = """
import json, os, sys
import opensim
opensim.Logger.setLevelString("Off")
os.chdir(sys.argv[1])
assert opensim.InverseKinematicsTool("inverse_kinematics.xml").run()
table = opensim.TimeSeriesTable("angles.mot")
errors = opensim.TimeSeriesTable("bodyslam_ik_marker_errors.sto")
column = lambda table, name: list(table.getDependentColumn(name).to_numpy())
print()
print(json.dumps({
    "times": list(table.getIndependentColumn()),
    "angles": {name: column(table, name) for name in table.getColumnLabels()},
    "rms": column(errors, "marker_error_RMS"),
}))
"""


def test_opensim_finds_the_angles_by_inverse_kinematics(tmp_path, result, body):
    """Of somebody who bends hips, knees, ankles and shoulders, and faces across the
    world's axes. The oracle is `csv`, which takes angles from rotations."""
    rng = np.random.default_rng(3)
    poses = np.zeros((1, NUM_FRAMES, 24, 3))
    poses[:, :, 0] = [0.0, 2.0, 0.0]
    swing = np.linspace(-1, 1, NUM_FRAMES)[:, None]
    for joint in (1, 2, 16, 17):
        poses[0, :, joint] = 0.3 * rng.standard_normal(3) * swing
    for joint, bend in ((4, 0.5), (5, 0.4), (7, -0.2), (8, 0.1)):
        poses[0, :, joint, 0] = bend + 0.3 * swing[:, 0]
    betas, trans = result.betas[:1], result.trans[:1]
    flat = poses.reshape(1, NUM_FRAMES, 72)
    posed = joints(body, *map(jnp.asarray, (flat, betas[:, None], trans)))
    walker = dataclasses.replace(
        result,
        poses=flat,
        betas=betas,
        trans=trans,
        joints=np.asarray(posed),
        present=result.present[:1],
    )
    (path,) = export.export(walker, tmp_path / "a", to="opensim", body=body)
    found = run("opensim", _INVERSE_KINEMATICS, path)
    assert max(found["rms"]) < 0.01  # m
    turns = Rotation.from_rotvec(poses[0].reshape(-1, 3)).as_matrix()
    true = angles(
        turns.reshape(NUM_FRAMES, 24, 3, 3), walker.joints[0], np.array([0.0, 1.0, 0.0])
    )
    names = {"hip_flexion": "hip_flexion_deg", "hip_adduction": "hip_adduction_deg"}
    names |= {"hip_rotation": "hip_internal_rotation_deg"}
    names |= {"knee_angle": "knee_flexion_deg", "ankle_angle": "ankle_dorsiflexion_deg"}
    for side in ("left", "right"):
        for theirs, ours in names.items():
            x = np.array(found["angles"][f"{theirs}_{side[0]}"])
            np.testing.assert_allclose(x, true[f"{side}_{ours}"], atol=1.0)  # degrees
    np.testing.assert_allclose(
        np.stack([found["angles"][f"pelvis_t{axis}"] for axis in "xyz"], axis=1),
        walker.joints[0, :, 0],
        atol=0.01,
    )


_SMPLX = """
import json, sys
import numpy as np
import torch
from smplx import SMPL
from smplx.utils import Struct
model, motion = np.load(sys.argv[1]), np.load(sys.argv[2])
names = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights")
names += ("kintree_table", "f")
num = len(motion["poses"])
body = SMPL(
    "", data_struct=Struct(**{n: model[n] for n in names}), batch_size=num,
    create_transl=False, dtype=torch.float64,
)
as_tensor = lambda x: torch.tensor(np.asarray(x, np.float64))
poses = as_tensor(np.pad(motion["poses"][:, :66], ((0, 0), (0, 6))))
found = body(
    betas=as_tensor(motion["betas"][None, :10]).expand(num, -1),
    global_orient=poses[:, :3], body_pose=poses[:, 3:],
    transl=as_tensor(motion["trans"]),
)
print(json.dumps(found.joints[:, :24].tolist()))
"""


def test_smplx_opens_amass(tmp_path, result, body):
    """With the body that ships, in SMPL's layout."""
    (path,) = export.export(result, tmp_path / "a.npz", body=body, person=0, up="z")
    write_npz(body, tmp_path / "smpl.npz")
    found = run("smplx", _SMPLX, tmp_path / "smpl.npz", path)
    np.testing.assert_allclose(found, result.joints[0] @ Y_TO_Z.T, atol=1e-5)


def test_usd_is_read_back(tmp_path, result, body):
    pytest.importorskip("pxr")
    from pxr import Gf, Usd, UsdGeom, UsdSkel

    (path,) = export.export(result, tmp_path / "a.usda", body=body, up="z")
    stage = Usd.Stage.Open(str(path))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetTimeCodesPerSecond() == FPS
    cache = UsdSkel.Cache()
    for h in range(2):
        prim = stage.GetPrimAtPath(f"/World/person_{h}")
        cache.Populate(UsdSkel.Root(prim), Usd.TraverseInstanceProxies())
        skeleton = UsdSkel.Skeleton(stage.GetPrimAtPath(f"{prim.GetPath()}/skeleton"))
        query = cache.GetSkelQuery(skeleton)
        for frame in FRAMES:
            at = query.ComputeJointSkelTransforms(float(frame))
            found = [list(T.ExtractTranslation()) for T in at]
            true = result.joints[h, frame] @ Y_TO_Z.T
            np.testing.assert_allclose(found, true, atol=1e-5)
    visible = UsdGeom.Imageable(stage.GetPrimAtPath("/World/person_1"))
    shown = [
        visible.ComputeVisibility(float(k)) == "inherited" for k in range(NUM_FRAMES)
    ]
    np.testing.assert_array_equal(shown, result.present[1])
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/World/camera")).GetCamera(3.0)
    frustum: Gf.Frustum = camera.frustum
    matrix = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
    T = result.T_WC[3]
    p_C = (result.landmarks - T[:3, 3]) @ T[:3, :3]
    fx, fy, cx, cy = result.intrinsics
    uv = p_C[:, :2] / p_C[:, 2:] * [fx, fy] + [cx + 0.5, cy + 0.5]
    for point, pixel in zip(result.landmarks @ Y_TO_Z.T, uv, strict=True):
        x, y, _ = matrix.Transform(Gf.Vec3d(*point.tolist()))
        found = [(x + 1) / 2 * SIZE[0], (1 - y) / 2 * SIZE[1]]
        np.testing.assert_allclose(found, pixel, atol=1e-2)


def test_rerun_reads_its_recording(tmp_path, result, body):
    pytest.importorskip("rerun")
    chunk = pytest.importorskip("rerun.chunk")
    (path,) = export.export(result, tmp_path / "a.rrd", body=body)
    rows, joints = {}, {}
    for piece in chunk.RrdReader(path).stream():
        batch = piece.to_record_batch()
        name = piece.entity_path
        if name.startswith("/world/person") and "time" not in batch.schema.names:
            continue  # what does not change
        rows[name] = rows.get(name, 0) + batch.num_rows
        if name == "/world/person_1/joints":
            columns = [c for c in batch.schema.names if c.endswith("positions")]
            places = batch.column(columns[0]).to_pylist()
            times = [t.total_seconds() for t in batch.column("time").to_pylist()]
            joints |= {round(t * FPS): p for t, p in zip(times, places, strict=True)}
    assert rows["/world/camera"] == NUM_FRAMES
    assert {"/world/map", "/world/ground", "/world/person_0/body"} <= set(rows)
    shown = {k: p for k, p in joints.items() if p}
    assert set(shown) == set(np.flatnonzero(result.present[1]))
    for k, places in shown.items():
        np.testing.assert_allclose(places, result.joints[1, k], atol=1e-5)
