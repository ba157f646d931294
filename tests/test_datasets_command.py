"""From a data set's own files to a table of errors, by the command line alone."""

import dataclasses
import json
import types

import jaxlie
import numpy as np
import pytest
from dataset_cases import (
    RICH,
    emdb_data,
    make_3dpw,
    make_emdb,
    make_pair,
    make_rich,
    make_world,
    threedpw_data,
)
from test_cli import _run

from bodyslam_jax import evaluation, export
from bodyslam_jax.evaluation.datasets import read_truth


@pytest.fixture
def command(monkeypatch, capsys, no_body_models):
    return lambda *argv: _run(monkeypatch, capsys, *argv)


def _write_run(folder, truth):
    """The truth seen from another world frame, and people's joints 2 cm further up."""
    T = np.asarray(
        jaxlie.SE3.exp(np.array([1.0, -2.0, 0.5, 0.3, -0.2, 0.4])).as_matrix()
    )
    up = T[:3, :3] @ [0, 0, 0.02]
    joints = truth.joints @ T[:3, :3].T + T[:3, 3] + up
    moved = dataclasses.replace(truth, T_WC=T @ truth.T_WC, joints=joints)
    export.write_run(folder, moved)
    return folder


@pytest.mark.slow
def test_evaluate_works_on_every_data_set(tmp_path, bodies, command):
    """One size of sequence, so that the errors are compiled once."""
    world = make_world()
    emdb = make_emdb(tmp_path / "P0", world)
    file = make_3dpw(tmp_path / "3dpw", threedpw_data(world, num_people=1))
    rich = make_rich(tmp_path / "rich", world)
    of_rich = ("--split", "val", "--sequence", RICH, "--camera", 3)
    for name, *argv in (
        ("emdb", emdb, "--body-model", bodies),
        ("3dpw", file),
        ("rich", rich, *of_rich, "--body-model", bodies / "smplx"),
    ):
        out = tmp_path / name / "sequence"
        code, said, err = command("convert-dataset", name, argv[0], out, *argv[1:])
        assert code == 0 and str(out) in said, err
        run = _write_run(tmp_path / name / "run", read_truth(out))
        code, said, err = command("evaluate", run, out, "--json")
        assert code == 0, err
        found = json.loads(said)
        assert found["c_ate_se3"] < 1e-6  # m; files keep nine digits
        # The first camera takes all along to where people are 2 cm apart.
        assert found["h_ate_a4"] == pytest.approx(0.02, abs=1e-6)
        assert found["j_ate_a4"] == pytest.approx(0.02, abs=1e-6)
        assert found["mpjpe"] == pytest.approx(0.0, abs=1e-6)


def test_evaluate_poses_a_truth_without_joints(
    tmp_path, bodies, command, caplog, monkeypatch
):
    """By `--body-model`, which has its gender, and says so where it has not."""
    world, out, seen = make_world(), tmp_path / "sequence", []
    command("convert-dataset", "tum-amass", *make_pair(tmp_path, world), out)
    run = _write_run(tmp_path / "run", read_truth(out, bodies))
    found = types.SimpleNamespace(scope=None)
    monkeypatch.setattr(
        evaluation, "evaluate", lambda _, truth, *__: seen.append(truth) or found
    )
    monkeypatch.setattr(evaluation, "to_table", lambda _: "a table")
    evaluate = lambda model: command("evaluate", run, out, "--body-model", model)
    expected = read_truth(out, bodies / "SMPL_FEMALE.npz").joints
    for model, is_right in ((bodies, True), (bodies / "SMPL_MALE.npz", False)):
        assert not caplog.records
        assert evaluate(model)[:2] == (0, "a table\n")
        assert np.allclose(seen[-1].joints, expected) == is_right
    assert "parameters are of SMPL, female, but posed with SMPL_MALE" in caplog.text
    code, _, err = evaluate(tmp_path / "none")
    assert code == 1 and "none: no such body model" in err


def test_what_is_wrong_is_one_line_and_writes_nothing(tmp_path, bodies, command):
    world, out = make_world(), tmp_path / "out"
    emdb = make_emdb(tmp_path / "P0", world, camera={})
    listed = make_emdb(tmp_path / "P1", world, smpl=[emdb_data(world)["smpl"]])
    good = make_emdb(tmp_path / "P2", world)
    short = threedpw_data(world)
    file = make_3dpw(tmp_path, short | {"trans": short["trans"][:1]})
    trajectory, motion = make_pair(tmp_path, world)
    motion.write_text("text")
    for argv, message in (
        (("emdb", emdb), "_data.pkl: no camera.intrinsics"),
        (("emdb", listed), "_data.pkl: smpl is a list, not a dictionary"),
        (("emdb", good), "_data.pkl: its joints need SMPL, female, not the free body"),
        (("3dpw", file), "walk_00.pkl: trans: 1 entries, not of 2 people"),
        (("tum-amass", trajectory, motion), "walk_poses.npz: not a true body"),
    ):
        code, _, err = command("convert-dataset", *argv, out)
        assert code == 1 and message in err
        assert len(err.strip().splitlines()) == 1
    assert not out.exists() and not [*tmp_path.glob(".conversion-*")]
