"""Errors: the properties that define them, and evo as an oracle."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.geometry import umeyama_alignment
from evo.core.trajectory import PoseTrajectory3D

from bodyslam_jax import evaluation
from bodyslam_jax.body import joints, keypoints, load_body_model
from bodyslam_jax.evaluation import Trajectories
from bodyslam_jax.types import Result

NUM = 250
"""Frames: two chunks of 100 and a short one."""

evaluate = jax.jit(evaluation.evaluate)
world_mpjpe = jax.jit(evaluation.world_mpjpe, static_argnums=(3, 4))


def _truth(num_people=1, num_frames=NUM):
    """People walking on curves beside a camera that goes along."""
    rng = np.random.default_rng(0)
    t = np.arange(num_frames) / 30.0
    rest = rng.normal(0, 0.4, (24, 3))
    joints = []
    for i in range(num_people):
        root = np.stack([1.2 * t, 0.05 * np.sin(9 * t), 2 * i + np.sin(t + i)], -1)
        swing = 0.1 * np.sin(6 * t[:, None, None] + np.arange(24)[:, None])
        joints.append(root[:, None] + rest + swing * rest[:, ::-1])
    T_WC = np.tile(np.eye(4), (num_frames, 1, 1))
    wobble = 0.2 * np.stack([np.sin(t), np.cos(2 * t), np.sin(3 * t)], -1)
    T_WC[:, :3, :3] = jaxlie.SO3.exp(jnp.asarray(wobble)).as_matrix()
    T_WC[:, :3, 3] = np.stack([1.1 * t, 1.6 + 0.1 * np.sin(2 * t), -3 + 0 * t], -1)
    return _result(t, T_WC, np.array(joints))


def _result(timestamps, T_WC, joints, present=None, **summary):
    people, frames = joints.shape[:2]
    return Result(
        timestamps=timestamps,
        T_WC=T_WC,
        scale=1.0,
        intrinsics=np.array([500.0, 500, 320, 240]),
        landmarks=np.zeros((0, 3)),
        poses=np.zeros((people, frames, 72)),
        trans=joints[:, :, 0],
        betas=np.zeros((people, 10)),
        joints=joints,
        present=np.ones((people, frames), bool) if present is None else present,
        summary=summary,
    )


def _moved(truth, scale=1.0):
    """The same from another world, `scale` times as large."""
    move = np.asarray(
        jaxlie.SE3.exp(jnp.array([1.0, -2.0, 0.5, 0.4, -0.8, 0.3])).as_matrix()
    )
    T_WC = move @ truth.T_WC
    T_WC[:, :3, 3] *= scale
    joints = scale * (truth.joints @ move[:3, :3].T + move[:3, 3])
    return dataclasses.replace(truth, T_WC=T_WC, joints=joints)


def _pair(result, truth):
    return evaluation.associate(result, truth)


RIGID = ("c_ate_se3", "h_ate_se3", "j_ate_se3", "h_ate_a2", "c_ate_a3", "h_ate_a3")
RIGID += ("c_ate_a4", "h_ate_a4", "j_ate_a4", "rte", "ate_s", "rpe_translation")
SIMILAR = ("c_ate_sim3", "h_ate_sim3", "j_ate_sim3", "w_mpjpe", "wa_mpjpe")
SIMILAR += ("w_mpjpe_tram", "wa_mpjpe_tram", "pa_mpjpe", "rpe_rotation")
BODY = ("mpjpe", "acceleration_error", "scale_error")


def test_truth_against_itself_is_zero():
    found = evaluate(*_pair(_truth(), _truth()))
    for name in RIGID + SIMILAR + BODY:
        assert float(found[name]) < 1e-10, name
        assert float(found.values.get(f"{name}_rmse", 0.0)) < 1e-10, name


@pytest.mark.slow
def test_results_are_compared_by_a_program_that_is_right():
    """Compiled as by the command: XLA rounds differently where it computes a square
    twice, and a distance of exactly 0 was 1 m."""
    found = evaluation.evaluate(_truth(), _truth())
    for name in RIGID + SIMILAR + BODY:
        assert float(found[name]) < 1e-10, name


def test_rigid_motion_of_the_world_is_no_error():
    found = evaluate(*_pair(_moved(_truth()), _truth()))
    for name in RIGID + SIMILAR + BODY:
        assert float(found[name]) < 1e-10, name


def test_wrong_scale_shows_where_scale_is_not_aligned():
    found = evaluate(*_pair(_moved(_truth(), 0.8), _truth()))
    for name in SIMILAR:
        assert float(found[name]) < 1e-10, name
    for name in RIGID + BODY:
        assert float(found[name]) > 1e-3, name
    np.testing.assert_allclose(found["scale"], 1 / 0.8, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("chunking", ["wham", "tram"])
def test_drift_of_a_still_person(chunking):
    """W grows with the chunk; the alignment over all of it halves that at least."""
    drift = 0.001
    still = jnp.broadcast_to(jnp.asarray(_truth().joints[0, 0]), (NUM, 24, 3))
    moved = still.at[:, :, 2].add(drift * jnp.arange(float(NUM))[:, None])
    valid = jnp.ones(NUM, bool)
    w = world_mpjpe(moved, still, valid, "first", chunking)
    wa = world_mpjpe(moved, still, valid, "all", chunking)
    if chunking == "wham":
        # 99.5 frames x d / 2 in a full chunk; half a step less from fitting two frames.
        np.testing.assert_allclose(np.mean(w.value[:100]), drift * 49, rtol=0.02)
    assert float(wa.mean()) <= drift * (25 if chunking == "wham" else 40)
    assert float(wa.mean()) < float(w.mean()) / 1.8


def test_never_a_reflection():
    mirrored = dataclasses.replace(_truth(), joints=_truth().joints * [1.0, 1, -1])
    found = evaluate(*_pair(mirrored, _truth()))
    assert float(found["pa_mpjpe"]) > 0.1 and float(found["wa_mpjpe"]) > 0.1


@pytest.mark.parametrize("num_valid", [1, 2, 100, 101, 200, 201, 250])
def test_chunks_are_those_of_wham_and_tram(num_valid):
    """Against loops as in their scripts; a last chunk of one frame is not NaN."""
    joints = _truth().joints[0]
    noisy = joints + np.random.default_rng(1).normal(0, 0.05, joints.shape)
    first = 7 if num_valid < NUM else 0
    valid = jnp.zeros(NUM, bool).at[first : first + num_valid].set(True)
    y, x = joints[first : first + num_valid], noisy[first : first + num_valid]
    wham = [(s, min(s + 100, num_valid)) for s in range(0, num_valid, 100)]
    tram = []
    for start in range(0, num_valid - 100, 100):
        last = start + 200 > num_valid
        tram.append((start, num_valid - 1 if last else start + 100))
    for chunking, chunks in (("wham", wham), ("tram", tram or [(0, num_valid)])):
        for align_with in ("first", "all"):
            expected = []
            for a, b in chunks:
                fit = slice(a, min(a + 2, b)) if align_with == "first" else slice(a, b)
                turn, move, scale = umeyama_alignment(
                    x[fit].reshape(-1, 3).T, y[fit].reshape(-1, 3).T, True
                )
                error = scale * x[a:b] @ turn.T + move - y[a:b]
                expected.append(np.linalg.norm(error, axis=-1).mean(1))
            found = world_mpjpe(
                *map(jnp.asarray, (noisy, joints)), valid, align_with, chunking
            )
            expected = np.concatenate(expected)
            np.testing.assert_allclose(found.mean(), expected.mean(), atol=1e-12)
            rmse = np.sqrt(np.mean(expected**2))
            np.testing.assert_allclose(found.rmse(), rmse, atol=1e-12)


@pytest.mark.parametrize("path", ["straight", "none"])
def test_root_error_on_degenerate_paths(path):
    line = jnp.linspace(0.0, 3.0, 50)[:, None] * jnp.array([1.0, 0.5, 0.0])
    truth = line if path == "straight" else jnp.zeros((50, 3))
    estimate = truth + jnp.array([0.0, 0.0, 0.01]) * jnp.sin(jnp.arange(50.0))[:, None]
    valid = jnp.ones(50, bool)
    rte = jax.jit(lambda x: evaluation.root_trajectory_error(x, truth, valid).mean())
    assert np.isfinite(rte(estimate)) and float(rte(truth)) < 1e-12
    for x in (truth, estimate):
        assert np.all(np.isfinite(jax.grad(rte)(x)))


def test_root_error_by_hand():
    """A path of 3 m (gaps count), one frame 0.2 m off: errors shrink by the fit."""
    truth = jnp.stack([jnp.arange(4.0), jnp.zeros(4), jnp.zeros(4)], -1)
    estimate = truth + jnp.array([[0.0, 0, 0], [0, 0, 0], [9, 9, 9], [0.3, 0, 0]])
    valid = jnp.array([True, True, False, True])
    found = evaluation.root_trajectory_error(estimate, truth, valid)
    np.testing.assert_allclose(found.value[valid], np.array([0.1, 0.1, 0.2]) / 3)
    np.testing.assert_allclose(found.mean(), 0.4 / 9)


@pytest.fixture(scope="module")
def body():
    return load_body_model(dtype=jnp.float64)


def _evo(T_WC):
    return PoseTrajectory3D(
        timestamps=np.arange(len(T_WC), dtype=float), poses_se3=list(np.asarray(T_WC))
    )


@pytest.fixture(scope="module")
def noisy():
    """An estimate with errors in everything, and its truth."""
    truth = _truth()
    rng = np.random.default_rng(1)
    estimate = _moved(truth, 0.9)
    T_WC = estimate.T_WC.copy()
    T_WC[:, :3, 3] += rng.normal(0, 0.05, (NUM, 3))
    turn = jaxlie.SO3.exp(jnp.asarray(rng.normal(0, 0.02, (NUM, 3)))).as_matrix()
    T_WC[:, :3, :3] = T_WC[:, :3, :3] @ np.asarray(turn)
    joints = estimate.joints + rng.normal(0, 0.05, truth.joints.shape)
    return dataclasses.replace(estimate, T_WC=T_WC, joints=joints), truth


@pytest.mark.parametrize("name, with_scale", [("se3", False), ("sim3", True)])
def test_absolute_errors_equal_evo(noisy, name, with_scale):
    estimate, truth = noisy
    found = evaluate(*_pair(estimate, truth))
    human, true_human = (np.tile(np.eye(4), (NUM, 1, 1)) for _ in range(2))
    human[:, :3, 3], true_human[:, :3, 3] = (
        estimate.joints[0, :, 0],
        truth.joints[0, :, 0],
    )
    for letter, x, y in (
        ("c", estimate.T_WC, truth.T_WC),
        ("h", human, true_human),
    ):
        theirs, reference = _evo(x), _evo(y)
        _, _, scale = theirs.align(reference, correct_scale=with_scale)
        ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
        ape.process_data((reference, theirs))
        stats = ape.get_all_statistics()
        ours = f"{letter}_ate_{name}"
        np.testing.assert_allclose(found[ours], stats["mean"], atol=1e-9)
        np.testing.assert_allclose(found[f"{ours}_rmse"], stats["rmse"], atol=1e-9)
        if with_scale and letter == "c":
            np.testing.assert_allclose(found["scale"], scale, atol=1e-9)


@pytest.mark.parametrize("step", [1, 30])
def test_relative_errors_equal_evo(noisy, step):
    estimate, truth = (jnp.asarray(x.T_WC) for x in noisy)
    ours = evaluation.relative_pose_errors(estimate, truth, jnp.ones(NUM, bool), step)
    relations = evo_metrics.PoseRelation
    for errors, relation in zip(
        ours, (relations.translation_part, relations.rotation_angle_rad), strict=True
    ):
        rpe = evo_metrics.RPE(relation, step, evo_metrics.Unit.frames, all_pairs=True)
        rpe.process_data((_evo(truth), _evo(estimate)))
        stats = rpe.get_all_statistics()
        np.testing.assert_allclose(errors.mean(), stats["mean"], atol=1e-9)
        np.testing.assert_allclose(errors.rmse(), stats["rmse"], atol=1e-9)


def test_joint_errors_by_hand():
    """One frame's hand 7 cm off, by the definition of each error."""
    truth = jnp.asarray(_truth().joints[0, :5])
    estimate = truth.at[2, 22, 0].add(0.07) + 1.0
    valid = jnp.ones(5, bool)
    found = evaluation.mpjpe(estimate, truth, valid)
    np.testing.assert_allclose(found.mean(), 0.07 / 120, rtol=1e-9)
    fps = jnp.array(30.0)
    found = evaluation.acceleration_error(estimate, truth, valid, fps)
    np.testing.assert_allclose(found.mean(), 4 * 0.07 * 900 / (3 * 24), rtol=1e-9)
    found = evaluation.jitter(estimate - truth, valid, fps)
    np.testing.assert_allclose(found.mean(), 6 * 0.07 * 27000 / (2 * 24), rtol=1e-9)


def test_feet_slide_only_where_the_truth_stands():
    truth = jnp.zeros((4, 2, 3)).at[:, 1, 0].set(jnp.arange(4.0))
    estimate = truth + 0.02 * jnp.arange(4.0)[:, None, None] * jnp.array([0, 0, 1.0])
    valid = jnp.array([True, True, True, False])
    found = evaluation.foot_sliding(estimate, truth, valid)
    assert int(jnp.sum(found.valid)) == 2
    np.testing.assert_allclose(found.mean(), 0.02)


@pytest.mark.slow
def test_feet_are_toes_and_heels_of_the_body_that_both_have(body):
    """And else the joints of ankles and feet, of which the table tells."""
    rng = np.random.default_rng(0)
    truth = _truth(num_frames=8)
    poses, trans = 0.2 * rng.normal(size=(1, 8, 72)), rng.normal(size=(1, 8, 3))
    betas = rng.normal(size=(1, 10))
    args = (body, jnp.asarray(poses), jnp.asarray(betas[:, None]), jnp.asarray(trans))
    own = dataclasses.replace(
        truth, poses=poses, betas=betas, trans=trans, joints=np.array(joints(*args))
    )
    estimate, _ = evaluation.associate(own, own, body)
    points = keypoints(*args, layout="body25")
    expected = np.asarray(points)[:, :, [19, 21, 22, 24]]
    np.testing.assert_allclose(estimate.feet, expected, atol=1e-12)
    assert "of toes and heels" in _feet_row(evaluation.evaluate(own, own, body))
    # The other side's joints are not this body's.
    others = dataclasses.replace(own, joints=own.joints + 0.02)
    estimate, _ = evaluation.associate(own, others, body)
    np.testing.assert_allclose(estimate.feet, own.joints[:, :, [7, 10, 8, 11]])
    assert "of ankle and foot joints" in _feet_row(
        evaluation.evaluate(own, others, body)
    )


def _feet_row(found):
    """Feet that never stand slide by no figure: the row is there all the same."""
    found = dataclasses.replace(found, values={"foot_sliding": jnp.array(0.0)})
    return evaluation.to_table(found)


def test_masked_frames_do_not_count(noisy):
    estimate, truth = _pair(*noisy)
    mask = jnp.ones(NUM, bool).at[40:60].set(False)
    masked = lambda x, off: dataclasses.replace(
        x,
        T_WC=x.T_WC.at[40:60, :3, 3].add(off),
        joints=x.joints.at[:, 40:60].add(off),
        camera_valid=x.camera_valid & mask,
        present=x.present & mask,
    )
    near, far, none = (
        evaluate(masked(estimate, off), truth) for off in (0.0, 50.0, np.nan)
    )
    for name, value in near.items():
        np.testing.assert_allclose(value, far[name], atol=1e-12, err_msg=name)
        np.testing.assert_allclose(value, none[name], atol=1e-12, err_msg=name)


def test_an_estimate_that_is_not_a_number_is_not_perfect(noisy):
    """A single frame that counts spoils every error of camera or person."""
    estimate, truth = _pair(*noisy)
    broken = dataclasses.replace(
        estimate,
        T_WC=estimate.T_WC.at[7].set(jnp.nan),
        joints=estimate.joints.at[:, 7].set(jnp.nan),
        feet=estimate.feet.at[:, 7].set(jnp.nan),
    )
    found = evaluate(broken, truth)
    assert "jitter_of_truth" in found
    for name, value in found.items():
        if "of_truth" not in name and not name.startswith("foot_sliding"):
            assert np.isnan(value), name


@pytest.mark.slow
def test_one_broken_person_spoils_the_mean_of_all():
    """Whether it is the estimate or the truth that is not a number."""
    estimate, truth = _pair(_truth(2), _truth(2))
    spoilt = lambda x: dataclasses.replace(x, joints=x.joints.at[1, 7].set(jnp.nan))
    for pair in ((spoilt(estimate), truth), (estimate, spoilt(truth))):
        found = evaluate(*pair)
        assert float(found.people["h_ate_se3"][0]) < 1e-9
        assert np.isnan(found["h_ate_se3"]) and float(found["c_ate_se3"]) < 1e-9


def test_a_camera_that_stands_still_has_no_scale(noisy):
    """Two millimetres of noise are no path; what needs none is as it was."""
    estimate, truth = _pair(*noisy)
    jitter = 0.002 * np.random.default_rng(0).normal(size=(NUM, 3))
    on_a_tripod = lambda x, off: dataclasses.replace(
        x, T_WC=x.T_WC.at[:, :3, 3].set(jnp.array([3.0, 1, 1]) + off)
    )
    found = evaluate(on_a_tripod(estimate, jitter), on_a_tripod(truth, 0.0))
    for name in ("scale", "scale_error", "c_ate_sim3", "h_ate_a2", "j_ate_a2_rmse"):
        assert np.isnan(found[name]), name
    assert 0 < float(found["c_ate_se3"]) < 0.005
    assert np.isfinite(found["h_ate_se3"]) and np.isfinite(found["h_ate_a3"])


@pytest.mark.slow
def test_padding_changes_nothing(noisy):
    estimate, truth = _pair(*noisy)
    short = [jax.tree.map(_first_frames, x) for x in (estimate, truth)]
    padded = (evaluation.pad_frames(x, NUM) for x in short)
    found, expected = evaluate(*padded), evaluate(*short)
    for name, value in expected.items():
        np.testing.assert_allclose(found[name], value, atol=1e-12, err_msg=name)


def _first_frames(x):
    if x.ndim == 0:
        return x
    return x[:20] if len(x) == NUM else x[:, :20]


@pytest.mark.slow
def test_a_batch_is_one_call(noisy):
    estimate, truth = _pair(*noisy)
    moved = _pair(_truth(), noisy[1])[0]
    stack = lambda *xs: jax.tree.map(lambda *x: jnp.stack(x), *xs)
    found = jax.jit(jax.vmap(evaluation.evaluate))(
        stack(estimate, moved), stack(truth, truth)
    )
    for i, single in enumerate((estimate, moved)):
        for name, value in evaluate(single, truth).items():
            np.testing.assert_allclose(found[name][i], value, atol=1e-9, err_msg=name)


@pytest.mark.slow
def test_gradients_of_all_errors_are_finite(noisy):
    """At an ordinary estimate, and where every error is zero."""

    def total(estimate, truth):
        found = evaluation.evaluate(estimate, truth)
        return sum(jnp.nan_to_num(found[name]) for name in found)

    gradient = jax.jit(jax.grad(total, allow_int=True))
    for estimate, truth in (_pair(*noisy), _pair(noisy[1], noisy[1])):
        found = gradient(estimate, truth)
        assert np.all(np.isfinite(found.joints)) and np.all(np.isfinite(found.T_WC))


def test_truth_at_another_rate():
    """Of 120 Hz truth, the frames at our times are taken as they are."""
    t = np.arange(4 * NUM) / 120.0
    fine = _truth(num_frames=NUM)
    coarse = lambda x: np.array(
        [np.interp(t, fine.timestamps, c) for c in x.reshape(NUM, -1).T]
    ).T.reshape(4 * NUM, *x.shape[1:])
    T_WC = coarse(fine.T_WC)
    T_WC[::4] = fine.T_WC
    joints = coarse(fine.joints[0])[None]
    found = evaluate(*_pair(fine, _result(t, T_WC, joints)))
    assert float(found["c_ate_se3"]) < 1e-9 and float(found["rpe_rotation"]) < 1e-9
    assert float(found["j_ate_se3"]) < 1e-9


def test_truth_between_our_frames_is_interpolated():
    truth = _truth()
    keep = lambda x: x[:, 5:200]
    later = _result(
        truth.timestamps[5:200] + 0.4 / 30, truth.T_WC[5:200], keep(truth.joints)
    )
    estimate, true = evaluation.associate(truth, later)
    late = estimate.T_WC[5:-5, 0, 3] - true.T_WC[5:-5, 0, 3]
    # At 1.1 m/s, and not hidden by taking the nearest frame.
    np.testing.assert_allclose(late, 0.4 * 1.1 / 30, rtol=1e-9)
    pair = evaluation.associate(truth, later, offset=0.4 / 30)
    np.testing.assert_allclose(pair[0].T_WC, pair[1].T_WC, atol=1e-9)


def test_nothing_in_common_is_said():
    truth = _truth(num_frames=20)
    prior_information = dataclasses.replace(truth, timestamps=truth.timestamps + 1e3)
    with pytest.raises(ValueError, match="0.000 to 0.633 s.*1000.000 to 1000.633 s"):
        evaluation.evaluate(truth, prior_information)


def test_people_are_told_apart():
    """Two people side by side in another order, and a third whom the truth lacks."""
    truth = _truth(num_people=2)
    extra = np.concatenate([truth.joints[::-1], truth.joints[:1] + 30.0])
    extra[2, ::2] += 0.5
    estimate = _moved(_result(truth.timestamps, truth.T_WC, extra))
    found, true = _pair(estimate, truth)
    # Moved by one and the same rigid motion, they are the same two people.
    fit = evaluation.umeyama(
        true.joints.reshape(-1, 3), found.joints.reshape(-1, 3)
    ).apply(found.joints)
    assert fit.shape[0] == 2
    np.testing.assert_allclose(fit, true.joints, atol=1e-9)


@pytest.mark.slow
def test_what_the_truth_lacks_is_nan_and_not_in_the_table():
    truth = _truth(num_frames=20)
    blind = dataclasses.replace(truth, summary={"has_camera": False})
    found = evaluate(*_pair(truth, blind))
    assert np.isnan(found["c_ate_se3"]) and np.isnan(found["h_ate_a2"])
    assert float(found["h_ate_se3"]) < 1e-9
    table = evaluation.to_table(found)
    assert "H-ATE, SE(3)" in table and "C-ATE" not in table and "nan" not in table
    assert json.loads(evaluation.to_json(found))["c_ate_se3"] is None
    alone = _result(truth.timestamps, truth.T_WC, truth.joints[:0])
    assert "h_ate_se3" not in evaluation.evaluate(truth, alone)


@pytest.mark.slow
def test_single_precision_throughout(noisy):
    single = lambda x: jax.tree.map(
        lambda a: a.astype(jnp.float32) if a.dtype == jnp.float64 else a, x
    )
    estimate, truth = _pair(*noisy)
    found, expected = (
        evaluate(single(estimate), single(truth)),
        evaluate(estimate, truth),
    )
    for name, value in expected.items():
        assert found[name].dtype == jnp.float32
        np.testing.assert_allclose(found[name], value, rtol=2e-2, err_msg=name)


def test_trajectories_and_results_do_not_mix():
    truth = _truth(num_frames=5)
    pair = _pair(truth, truth)
    assert isinstance(pair[0], Trajectories)
    with pytest.raises(ValueError, match="two"):
        evaluation.evaluate(pair[0], truth)


@pytest.mark.slow
def test_a_piece_of_a_track_does_not_beat_the_whole():
    truth = _truth()
    rng = np.random.default_rng(1)
    whole = truth.joints + rng.normal(0, 0.05, truth.joints.shape)
    both = np.concatenate([truth.joints, whole])
    present = np.ones((2, NUM), bool)
    present[0, 6:] = False
    found = _result(truth.timestamps, truth.T_WC, both, present)
    result = evaluation.evaluate(found, truth)
    scope = result.scope
    assert scope is not None and scope.others == 1
    assert scope.people == (evaluation.Pair(0, 1, NUM, NUM),)
    assert float(result["h_ate_se3"]) > 0.01


@pytest.mark.slow
def test_what_is_compared_is_said():
    truth = _truth(num_people=2)
    present = np.ones((1, NUM), bool)
    present[0, 25:] = False
    found = _result(truth.timestamps, truth.T_WC, truth.joints[1:], present)
    whole = evaluation.evaluate(found, truth)
    scope = whole.scope
    assert scope == evaluation.Scope(
        NUM,
        NUM,
        (evaluation.Pair(0, evaluation.NOBODY, 0, NUM), evaluation.Pair(1, 0, 25, NUM)),
        0,
        (False, True),
    )
    straight, first, second = evaluation.gaps(scope)
    assert "person 1 goes along a line, to 10 cm" in straight
    assert "person 0 of the ground truth is not found" in first
    assert "person 1 is compared in 25 of 250 frames" in second
    # Evaluations of pairs with as many people stack.
    other = dataclasses.replace(found, present=~present)
    both = evaluation.evaluate(found, truth), evaluation.evaluate(other, truth)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *both)
    assert stacked.scope.people[1].frames.tolist() == [25, NUM - 25]
    assert "person 1 (here 0) in 25 of 250 frames" in evaluation.to_table(whole)
    said = json.loads(evaluation.to_json(whole))["compared"]["people"]
    assert [person["estimate"] for person in said] == [None, 0]
    # Half of the time, at half of the rate, of somebody without a camera.
    half = _result(
        truth.timestamps[:125:2], truth.T_WC[:125:2], truth.joints[:, :125:2]
    )
    blind = dataclasses.replace(truth, summary={"has_camera": False})
    scope = evaluation.evaluate(half, blind).scope
    assert (scope.cameras, scope.of_cameras) == (0, 0)
    assert [(p.frames, p.of_frames) for p in scope.people] == [(63, 125)] * 2
    assert len(evaluation.gaps(scope)) == 2
    lost = dataclasses.replace(truth, joints=np.full_like(truth.joints, np.nan))
    said = evaluation.gaps(evaluation.evaluate(half, lost).scope)
    assert not any("line" in x for x in said)
    # Alignment brings two poses together whatever they are.
    brief = _result(truth.timestamps[:2], truth.T_WC[:2], truth.joints[:, :2])
    said = evaluation.gaps(evaluation.evaluate(brief, truth).scope)
    assert any("in 2 frames only, which alignment brings together" in x for x in said)


@pytest.mark.slow
def test_poses_beyond_a_cut_are_not_compared():
    truth = _truth()
    T_WC = truth.T_WC.copy()
    T_WC[200:] = T_WC[199]
    filled = dataclasses.replace(truth, T_WC=T_WC)
    cut = dataclasses.replace(filled, summary={"frames_used": [0, 199]})
    assert float(evaluation.evaluate(filled, truth)["c_ate_se3"]) > 0.01
    found = evaluation.evaluate(cut, truth)
    assert float(found["c_ate_se3"]) < 1e-9
    assert found.scope.cameras == 200 and found.scope.of_cameras == NUM
    for other in (None, 3, [1], "0-9"):
        odd = dataclasses.replace(truth, summary={"frames_used": other})
        assert odd.located.all()


@pytest.mark.slow
def test_nothing_is_a_difference_across_missing_frames():
    truth = _truth()
    keep = np.r_[0:100, 140:NUM]
    cut = _result(truth.timestamps[keep], truth.T_WC[keep], truth.joints[:, keep])
    whole, found = evaluation.evaluate(truth, truth), evaluation.evaluate(cut, truth)
    expected = float(whole["jitter"])
    for name in ("jitter", "jitter_of_truth"):
        assert float(found[name]) == pytest.approx(expected, rel=0.1), name
    assert float(found["rpe_translation"]) < 1e-9
    both = evaluation.evaluate(cut, cut)
    assert float(both["jitter"]) == pytest.approx(expected, rel=0.1)
    # A clock that jumps by years is no reason to make frames of them.
    late = dataclasses.replace(
        truth, timestamps=truth.timestamps + 1e8 * (np.arange(NUM) > 99)
    )
    assert float(evaluation.evaluate(late, late)["jitter"]) < 1.1 * expected


@pytest.mark.slow
@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (0.1, 0.7, 1 / 3), (9.0, -70, 3)])
@pytest.mark.parametrize(
    "dtype", ["float64", pytest.param("float32", marks=pytest.mark.slow)]
)
def test_an_estimate_that_does_not_move_has_no_scale(place, dtype):
    truth = _truth()
    T_WC = truth.T_WC.copy()
    T_WC[:, :3, 3] = place
    cast = lambda x: jax.tree.map(
        lambda y: y.astype(dtype) if jnp.issubdtype(y.dtype, jnp.floating) else y, x
    )
    pair = _pair(dataclasses.replace(truth, T_WC=T_WC), truth)
    found = evaluate(*map(cast, pair))
    assert np.isnan(found["scale"]) and np.isnan(found["c_ate_sim3"])
    assert float(found["c_ate_se3"]) > 0.1
    fit = evaluation.umeyama(
        jnp.asarray(truth.T_WC[:, :3, 3], dtype),
        jnp.broadcast_to(jnp.asarray(place, dtype), (NUM, 3)),
        with_scale=True,
    )
    assert float(fit.scale) == 1
