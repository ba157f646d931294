"""The whole flow on simulated measurements, and what it leaves on disk."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodyslam_jax import evaluation, export, pipeline, simulation, view
from bodyslam_jax.body import DEFAULT, load_body_model, write_npz
from bodyslam_jax.body.skeleton import PELVIS
from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.evaluation import before_after
from bodyslam_jax.experiments import calibration
from bodyslam_jax.ground.gravity import upright
from bodyslam_jax.pipeline.run import with_compatible_body

CONTRACT = {
    "timestamps": (60,),
    "T_WC": (60, 4, 4),
    "scale": (),
    "intrinsics": (4,),
    "poses": (1, 60, 72),
    "trans": (1, 60, 3),
    "betas": (1, 10),
    "joints": (1, 60, 24, 3),
    "present": (1, 60),
}


@pytest.mark.slow
def test_from_measurements_to_a_run_folder(tmp_path, caplog):
    simulated = simulation.simulate(
        Simulation(sequence="M1", family="follow", length=60, noise="low")
    )
    camera = tmp_path / "camera.txt"
    export.write_tum(camera, simulated.timestamps, simulated.T_WC)
    sequence = dataclasses.replace(
        simulation.as_sequence(simulated), groundtruth=camera
    )
    out = tmp_path / "run"
    result = pipeline.run_to_folder(sequence, out, Config())

    found = evaluation.evaluate(result, simulation.as_truth(simulated))
    # The simulated errors are centimetres; so must be what is made of them.
    assert float(found["c_ate_sim3"]) < 0.02
    assert float(found["scale_error"]) < 0.1
    assert float(found["h_ate_se3"]) < 0.15
    assert result.summary["status"] == "ok"
    assert result.T_WC[0, 0, 0] < -0.95  # x points left of the first camera
    true, eye = calibration.in_world(simulation.as_truth(simulated), simulated.room)
    error = result.joints[:, :, PELVIS] - true[:, :, PELVIS]
    assert result.root_sigma is not None and (result.root_sigma > 0).all()
    assert (np.abs(error) < 4 * result.root_sigma).all()
    assert (np.abs(error).max(axis=1) > 0.1 * result.root_sigma.mean(axis=1)).any()
    height = result.summary["camera_height"]
    assert height["value_m"] == pytest.approx(eye, abs=4 * height["sigma_m"])

    with np.load(out / "result.npz", allow_pickle=False) as archive:
        for name, shape in CONTRACT.items():
            assert archive[name].shape == shape, name
            assert np.isfinite(archive[name]).all(), name
    for name in ("camera.tum", "body_0.npz", "landmarks.ply", "config.yaml"):
        assert (out / name).stat().st_size > 0
    assert "<html" in (out / "report.html").read_text().lower()
    assert len(view.read_runs(out / "scene.html")) == 1
    summary = json.loads((out / "summary.json").read_text())
    assert summary["status"] == "ok"
    alone, joint = (
        summary["errors"][n]
        for n in (before_after.CAMERAS_ALONE, before_after.JOINT_ESTIMATE)
    )
    assert alone["c_ate_sim3"] < 0.02 and alone["scale"] == "no scale"
    assert alone["c_ate_sim3"] != joint["c_ate_sim3"]
    assert joint["c_ate_se3"] == pytest.approx(float(found["c_ate_se3"]), abs=1e-6)

    # The same command again takes every stage from the folder, to the same result.
    caplog.set_level("INFO")
    again = pipeline.run_to_folder(sequence, out, Config())
    assert caplog.text.count("taken from an earlier run") == 4
    np.testing.assert_array_equal(again.joints, result.joints)

    # A still camera: nothing but the bodies to go by, and the report says so.
    still = dataclasses.replace(
        sequence,
        tracks=dataclasses.replace(
            sequence.tracks,
            uv=sequence.tracks.uv[
                np.unique(sequence.tracks.landmark, return_index=True)[1]
            ][np.unique(sequence.tracks.landmark, return_inverse=True)[1]],
        ),
    )
    result = pipeline.run(still, Config(uncertainty=False))
    assert result.summary["camera_motion"] == "static"
    assert np.ptp(result.T_WC[:, :3, 3], axis=0).max() == 0
    assert any("body alone" in text for text in result.summary["warnings"])


def test_nothing_to_estimate_from_is_an_error():
    simulated = simulation.simulate(
        Simulation(sequence="E1", length=30, noise="none", seed=1)
    )
    sequence = simulation.as_sequence(simulated)
    tracks = sequence.tracks
    few = tracks.landmark < 3
    bare = dataclasses.replace(
        sequence,
        keypoints=None,
        bodies=None,
        tracks=type(tracks)(tracks.frame[few], tracks.landmark[few], tracks.uv[few]),
    )
    with pytest.raises(ValueError, match="no landmarks and no people"):
        pipeline.run(bare)


def test_upright_turns_a_direction_up_and_keeps_distances():
    rng = np.random.default_rng(0)
    T_WC = np.tile(np.eye(4), (5, 1, 1))
    T_WC[:, :3, 3] = rng.normal(size=(5, 3))
    turn = upright(T_WC, np.array([0.6, 0.0, 0.8]))
    np.testing.assert_allclose(turn[:3, :3] @ [0.6, 0.0, 0.8], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(turn[:3, :3] @ turn[:3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(turn[:3, :3]), 1)
    np.testing.assert_allclose((turn @ T_WC[0])[:3, 3], 0, atol=1e-12)


def test_x_points_left_of_the_first_camera_as_the_conventions_say():
    page = (Path(__file__).parent.parent / "docs" / "conventions.md").read_text()
    assert "x **left** of, y up, z ahead of the first camera" in page
    T_WC = np.tile(np.eye(4), (3, 1, 1))
    T_WC[:, :3, :3] = Rotation.from_euler("y", 30, degrees=True).as_matrix()
    T_WC[:, :3, 3] = np.random.default_rng(0).normal(size=(3, 3))
    first = (upright(T_WC, -T_WC[0, :3, 1]) @ T_WC)[0, :3, :3]
    # The camera's right, down and forward in the world.
    np.testing.assert_allclose(first, np.diag([-1.0, -1.0, 1.0]), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(first), 1)


def test_a_body_that_was_found_does_not_stop_who_did_not_ask_for_it(
    tmp_path, monkeypatch
):
    found = tmp_path / "SMPL_NEUTRAL.npz"
    write_npz(load_body_model(DEFAULT), found)
    monkeypatch.setenv("BODYSLAM_BODY_MODEL", str(found))
    config, warnings = with_compatible_body(Config())
    assert config.body_model == str(DEFAULT)
    (line,) = warnings
    assert line.startswith(f"{found} is not used") and "--motion-model" in line
    # Whoever names it is told that the two do not fit, and cameras need no body.
    for asked in (Config(body_model=str(found)), Config(people=False)):
        assert with_compatible_body(asked) == (asked, ())
    monkeypatch.setenv("BODYSLAM_BODY_MODEL", str(DEFAULT))
    assert with_compatible_body(Config()) == (Config(), ())


def test_the_body_is_of_the_gender_of_given_bodies(tmp_path, no_body_models):
    for gender in ("NEUTRAL", "FEMALE"):
        write_npz(load_body_model(DEFAULT), tmp_path / f"SMPL_{gender}.npz")
    folder = Config(body_model=str(tmp_path))
    config, warnings = with_compatible_body(folder, "female")
    assert config.body_model == str(tmp_path / "SMPL_FEMALE.npz") and not warnings
    # Without a model of that gender, or with another named, one line says so.
    for asked, gender in (
        (folder, "male"),
        (Config(), "female"),
        (Config(body_model=str(tmp_path / "SMPL_FEMALE.npz")), "male"),
        (Config(body_model=str(tmp_path / "SMPL_FEMALE.npz")), "neutral"),
    ):
        config, (line,) = with_compatible_body(asked, gender)
        assert config == asked and f"belong to the {gender} model" in line
    for asked, gender in ((Config(), None), (Config(), "neutral"), (folder, None)):
        assert with_compatible_body(asked, gender) == (asked, ())
    assert with_compatible_body(Config(people=False), "male")[1] == ()
