"""Errors of the cameras before the joint estimate, beside those of the result."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodyslam_jax.body import load_body_model
from bodyslam_jax.evaluation import before_after
from bodyslam_jax.types import Result, SfmResult, Tracks

BODY = load_body_model()
T = 30
WOBBLE, SMALLER = 0.02, 0.005  # m, of the cameras before and after


def _path(wobble: float) -> np.ndarray:
    """A camera that flies an arc, up and down by `wobble` from frame to frame."""
    angle = np.linspace(0, 2, T)
    T_WC = np.tile(np.eye(4), (T, 1, 1))
    T_WC[:, 0, 3], T_WC[:, 2, 3] = np.cos(angle), np.sin(angle)
    T_WC[:, 1, 3] = wobble * (-1.0) ** np.arange(T)
    return T_WC


def _result(T_WC: np.ndarray) -> Result:
    joints = np.random.default_rng(0).normal(0, 0.3, (24, 3))
    walked = np.zeros((T, 1, 3))
    walked[:, 0, 2] = np.linspace(4, 6, T)
    return Result(
        timestamps=np.arange(T) / 30,
        T_WC=T_WC,
        scale=0.3,
        intrinsics=np.array([500.0, 500.0, 320.0, 240.0]),
        landmarks=np.zeros((0, 3)),
        poses=np.zeros((1, T, 72)),
        trans=walked[None, :, 0],
        betas=np.zeros((1, 10)),
        joints=(joints + walked)[None],
        present=np.ones((1, T), bool),
    )


def _cameras(kind: str = "moving") -> SfmResult:
    """The wobbling path in a world of its own: turned, moved, three times as small."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    T_WC = turn @ _path(WOBBLE)
    T_WC[:, :3, 3] = T_WC[:, :3, 3] / 3 + [1.0, 2.0, 3.0]
    none = np.zeros(0, np.int64)
    return SfmResult(
        kind=kind,
        T_WC=T_WC,
        registered=np.ones(T, bool),
        landmarks=np.zeros((0, 3)),
        tracks=Tracks(none, none, np.zeros((0, 2))),
        keep=none.astype(bool),
        prior_information=np.zeros((0, 3, 3)),
        prior_mean=np.zeros((0, 3)),
        pixel_sigma=1.0,
        intrinsics=np.ones(4),
        focal_sigma=float("nan"),
        costs=(0.0, 0.0),
        warnings=(),
    )


@pytest.mark.slow
def test_cameras_alone_are_judged_without_their_scale_and_nothing_else_is():
    result, truth = _result(_path(SMALLER)), _result(_path(0.0))
    found = before_after.errors(result, _cameras(), truth, BODY)
    assert list(found) == [before_after.CAMERAS_ALONE, before_after.JOINT_ESTIMATE]
    alone, joint = found.values()
    # In metres though the cameras are not: the truth's size is lent to them.
    assert alone["c_ate_sim3"] == pytest.approx(WOBBLE, rel=0.02)
    assert joint["c_ate_sim3"] == pytest.approx(SMALLER, rel=0.02)
    assert alone["rpe_rotation"] == pytest.approx(0, abs=1e-6)  # turned as a whole
    assert alone.keys() == joint.keys()
    told = {key for key, value in alone.items() if not isinstance(value, str)}
    known = {"c_ate_sim3", "rpe_rotation"}
    assert told == known | {f"{name}_rmse" for name in known}
    for key in ("c_ate_se3", "scale", "scale_error", "rpe_translation", "ate_s"):
        assert alone[key] == "no scale"
    for key in ("h_ate_sim3", "w_mpjpe", "pa_mpjpe", "rte"):
        assert alone[key] == "no people"
    first, second = before_after.headline(found)
    assert "arbitrary scale: C-ATE, Sim(3) 19.9" in first and ";" not in first
    assert "in metres: C-ATE, SE(3) 4.9" in second and "H-ATE" in second


@pytest.mark.slow
def test_a_run_without_people_has_no_metres_to_be_judged():
    result, truth = _result(_path(SMALLER)), _result(_path(0.0))
    nobody = dataclasses.replace(result, present=np.zeros_like(result.present))
    assert list(before_after.errors(nobody, _cameras(), truth, BODY)) == [
        before_after.CAMERAS_ALONE
    ]


@pytest.mark.parametrize("kind", ["static", "rotation"])
def test_a_camera_without_a_path_is_not_judged_alone(kind):
    truth = _result(_path(0.0))
    assert list(before_after.errors(truth, _cameras(kind), truth, BODY)) == [
        before_after.JOINT_ESTIMATE
    ]


def test_a_truth_without_cameras_judges_people_only():
    result = _result(_path(0.0))
    truth = dataclasses.replace(result, summary={"has_camera": False})
    found = before_after.errors(result, _cameras(), truth, BODY)
    assert list(found) == [before_after.JOINT_ESTIMATE]
    (line,) = before_after.headline(found)
    assert "C-ATE" not in line and "H-ATE" in line


@pytest.mark.parametrize("has_camera", [True, False])
def test_the_truth_lies_beside_the_estimate(has_camera):
    """In another world, whose people are as tall as the body model makes them."""
    result = _result(_path(0.0))
    turn = Rotation.from_euler("xyz", [0.3, -1.0, 0.2]).as_matrix()
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn, [3.0, -2.0, 5.0]
    truth = dataclasses.replace(
        result,
        T_WC=T @ result.T_WC,
        joints=result.joints @ turn.T + T[:3, 3],
        summary={"has_camera": has_camera},
    )
    found = before_after.beside(result, truth, BODY)
    if has_camera:
        np.testing.assert_allclose(found.cameras, result.T_WC[:, :3, 3], atol=1e-6)
    pelvis = np.where(result.present[..., None], result.joints[:, :, 0], np.nan)
    np.testing.assert_allclose(found.pelvises, pelvis, atol=1e-6)


def test_the_height_alone_says_how_long_a_metre_is():
    """Somebody who is taken to be shorter by 10 %, as everything is."""
    beside = before_after.TruthBeside(
        np.zeros((0, 3)), np.zeros((0, 0, 3)), {0: (2.0, 1.8)}
    )
    errors = {before_after.JOINT_ESTIMATE: {"scale": 1 / 0.9, "h_ate_se3": 0.1}}
    _, tall, lengths = before_after.headline(errors, beside)
    assert tall == "person 0: 180 cm, in truth 200 cm"
    assert "off by -10.0 %" in lengths and lengths.endswith("by +0.0 %")
