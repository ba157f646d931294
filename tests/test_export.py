"""The run folder: complete and readable by others, or not there at all."""

import dataclasses
import errno
from pathlib import Path

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import trimesh
import yaml
from evo.tools import file_interface

from bodyslam_jax import diagnostics, evaluation, export
from bodyslam_jax.body import joints, load_body_model
from bodyslam_jax.types import Result


@dataclasses.dataclass(frozen=True)
class _Settings:
    iterations: int = 3
    sizes: tuple[int, ...] = (1, 2)


@pytest.fixture(scope="module")
def body():
    return load_body_model(dtype=jnp.float64)


@pytest.fixture(scope="module")
def result(body):
    rng = np.random.default_rng(0)
    num = 12
    t = np.arange(num) / 25.0
    T_WC = np.tile(np.eye(4), (num, 1, 1))
    turns = jaxlie.SO3.exp(jnp.asarray(rng.normal(0, 1, (num, 3))))
    T_WC[:, :3, :3] = turns.as_matrix()
    T_WC[:, :3, 3] = rng.normal(0, 2, (num, 3))
    poses, trans = rng.normal(0, 0.4, (2, num, 72)), rng.normal(0, 1, (2, num, 3))
    betas = rng.normal(0, 1, (2, 10))
    posed = joints(body, *map(jnp.asarray, (poses, betas[:, None], trans)))
    return Result(
        timestamps=t,
        T_WC=T_WC,
        scale=1.25,
        intrinsics=np.array([500.0, 500, 320, 240]),
        landmarks=rng.normal(0, 3, (7, 3)),
        poses=poses,
        trans=trans,
        betas=betas,
        joints=np.asarray(posed),
        present=np.ones((2, num), bool),
        summary={"status": "ok", "cost": np.float64(2.5), "bad": float("nan")},
    )


def test_a_run_comes_back_as_it_was(tmp_path, result):
    export.write_run(tmp_path / "run", result, _Settings())
    names = {"result.npz", "camera.tum", "body_0.npz", "body_1.npz", "landmarks.ply"}
    names |= {"summary.json", "config.yaml"}
    assert {p.name for p in (tmp_path / "run").iterdir()} == names
    found = evaluation.read_result(tmp_path / "run")
    for field in dataclasses.fields(result):
        if field.name != "summary":
            a, b = getattr(found, field.name), getattr(result, field.name)
            np.testing.assert_array_equal(a, b, err_msg=field.name)
    assert found.summary == {"status": "ok", "cost": 2.5, "bad": None}
    settings = yaml.safe_load((tmp_path / "run" / "config.yaml").read_text())
    assert settings == {"iterations": 3, "sizes": [1, 2]}


def test_others_can_read_it(tmp_path, result):
    export.write_run(tmp_path, result)
    evo = file_interface.read_tum_trajectory_file(tmp_path / "camera.tum")
    np.testing.assert_allclose(evo.poses_se3, result.T_WC, atol=1e-8)
    np.testing.assert_allclose(evo.timestamps, result.timestamps, atol=1e-9)
    cloud = trimesh.load(tmp_path / "landmarks.ply")
    np.testing.assert_allclose(cloud.vertices, result.landmarks, atol=1e-6)
    person = np.load(tmp_path / "body_1.npz", allow_pickle=False)
    np.testing.assert_array_equal(person["poses"], result.poses[1])
    np.testing.assert_allclose(person["mocap_framerate"], 25.0)
    assert str(person["gender"]) == "neutral"


def test_only_located_cameras_are_in_the_trajectory(tmp_path, result):
    cut = dataclasses.replace(result, summary={"frames_used": [2, 8]})
    export.write_run(tmp_path, cut)
    evo = file_interface.read_tum_trajectory_file(tmp_path / "camera.tum")
    np.testing.assert_allclose(evo.timestamps, result.timestamps[2:9], atol=1e-9)
    np.testing.assert_allclose(evo.poses_se3, result.T_WC[2:9], atol=1e-8)
    found = evaluation.read_result(tmp_path)
    np.testing.assert_array_equal(found.T_WC, result.T_WC)
    assert found.located.tolist() == [2 <= k <= 8 for k in range(12)]
    whole = diagnostics.camera_statistics(result)
    assert diagnostics.camera_statistics(cut).seconds < whole.seconds


def test_run_folder_is_a_ground_truth_for_another(tmp_path, result, body):
    """Its camera.tum and body_<h>.npz alone give the same world, joints included."""
    export.write_run(tmp_path, result)
    for name in ("result.npz", "summary.json"):
        (tmp_path / name).unlink()
    found = evaluation.read_groundtruth(tmp_path, body)
    np.testing.assert_allclose(found.T_WC, result.T_WC, atol=1e-8)
    np.testing.assert_allclose(found.joints, result.joints, atol=1e-12)
    assert found.present.all()


def test_without_people_and_map(tmp_path, result):
    empty = dataclasses.replace(
        result,
        landmarks=result.landmarks[:0],
        poses=result.poses[:0],
        trans=result.trans[:0],
        betas=result.betas[:0],
        joints=result.joints[:0],
        present=result.present[:0],
    )
    export.write_run(tmp_path, empty)
    assert evaluation.read_result(tmp_path).poses.shape == (0, 12, 72)
    assert b"element vertex 0" in (tmp_path / "landmarks.ply").read_bytes()


def test_an_old_run_is_replaced_whole(tmp_path, result):
    """No body of an earlier run with more people stays; cache and notes do."""
    export.write_run(tmp_path, result)
    (tmp_path / ".cache").mkdir()
    (tmp_path / "notes.txt").write_text("mine")
    one = {n: getattr(result, n)[:1] for n in ("poses", "trans", "betas", "joints")}
    one["present"] = result.present[:1]
    export.write_run(tmp_path, dataclasses.replace(result, **one))
    names = {p.name for p in tmp_path.iterdir()}
    assert "body_1.npz" not in names
    assert {".cache", "notes.txt", "body_0.npz", "summary.json"} <= names


def _full_disk(*_args, **_kwargs):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("existed", [False, True])
def test_full_disk_leaves_nothing_half_written(tmp_path, result, monkeypatch, existed):
    folder = tmp_path / "run"
    if existed:
        export.write_run(folder, result)
    before = {p.name: p.read_bytes() for p in folder.glob("*")}
    monkeypatch.setattr(np, "savetxt", _full_disk)
    with pytest.raises(ValueError, match="run: the disk is full"):
        export.write_run(folder, result)
    assert {p.name: p.read_bytes() for p in folder.glob("*")} == before
    assert folder.exists() == existed


def test_interrupted_move_does_not_look_whole(tmp_path, result, monkeypatch):
    export.write_run(tmp_path, result)
    calls = []

    def replace_twice(source, target):
        if Path(target).parent == tmp_path:
            calls.append(target)
        if len(calls) > 2:
            raise KeyboardInterrupt
        Path(source).rename(target)

    monkeypatch.setattr("os.replace", replace_twice)
    with pytest.raises(KeyboardInterrupt):
        export.write_run(tmp_path, result)
    assert not (tmp_path / "summary.json").exists()


@pytest.mark.parametrize("check", [export.check_folder, export.write_run])
def test_not_a_folder(tmp_path, result, check):
    (tmp_path / "file").write_text("in the way")
    for path in (tmp_path / "file", tmp_path / "file" / "run"):
        args = (path,) if check is export.check_folder else (path, result)
        with pytest.raises(ValueError, match="file.*cannot be written"):
            check(*args)
    assert (tmp_path / "file").read_text() == "in the way"


def test_mesh_formats(tmp_path, body):
    vertices = np.asarray(body.template)
    for suffix in ("glb", "obj", "ply"):
        file = tmp_path / f"body.{suffix}"
        export.write_mesh(file, vertices, np.asarray(body.faces))
        found = trimesh.load(file, force="mesh", process=False)
        np.testing.assert_allclose(
            found.bounds, [vertices.min(0), vertices.max(0)], atol=1e-4
        )
    with pytest.raises(ValueError, match="'.fbx'"):
        export.write_mesh(tmp_path / "body.fbx", vertices, np.asarray(body.faces))
