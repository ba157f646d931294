"""The motion model: what may enter a prediction, and what comes out."""

import dataclasses
import json
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_motion_data import make_clip

from bodyslam_jax import cli, io, simulation
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Config
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3
from bodyslam_jax.motion import (
    MotionModel,
    Prediction,
    check_compatible,
    evaluate_model,
    load_motion_model,
    predict,
    read_motion,
    rollout,
    save_motion_model,
    scale_from_motion,
)
from bodyslam_jax.motion.network import lower_triangle
from bodyslam_jax.motion.paper_network import PaperNetwork
from bodyslam_jax.motion.position_network import (
    MetricNetwork,
    cosine_basis,
    nearest_turn,
)
from bodyslam_jax.motion.prediction import leg_length, straightened
from bodyslam_jax.motion.training.evaluation import Steps, error_correlation
from bodyslam_jax.types import Intrinsics, Keypoints, Sequence

T = 24


@pytest.fixture(scope="module")
def body():
    return load_body_model(dtype=jnp.float64)


@pytest.fixture(scope="module")
def model():
    return load_motion_model()


@pytest.fixture(scope="module")
def walk():
    """A synthetic gait: orientation, body pose, shape, all frames present."""
    clip = make_clip(T)
    poses = jnp.asarray(clip.poses, jnp.float64)
    shape = 0.3 * jnp.ones(10)
    return so3.exp(poses[:, 0]), poses[:, 1:], shape, jnp.ones(T, bool)


@eqx.filter_jit
def run(model, body, *args):
    return predict(model, body, *args)


def test_predictions_are_invariant_to_rotations_of_the_world(model, body, walk, key):
    orientation, *rest = walk
    expected = run(model, body, orientation, *rest)
    for k in jax.random.split(key, 3):
        world = so3.exp(3.0 * jax.random.normal(k, (3,)))
        found = run(model, body, world @ orientation, *rest)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-9)


def test_steady_yaw_does_not_change_displacements(model, body, walk):
    orientation, *rest = walk
    expected = run(model, body, orientation, *rest)
    rate = jnp.full(T, -0.02)
    found = run(model, body, straightened(orientation, rate), *rest)
    np.testing.assert_allclose(found.translation, expected.translation, atol=1e-3)
    turn = lambda seen: so3.log(so3.exp(jnp.array([0, -0.02, 0.0])) @ so3.exp(seen))
    np.testing.assert_allclose(
        turn(found.rotation)[model.past :], expected.rotation[model.past :], atol=2e-3
    )


def test_predictions_are_causal(model, body, walk):
    orientation, body_pose, shape, present = walk
    before = run(model, body, orientation, body_pose, shape, present)
    k = T - 3
    after = run(model, body, orientation, body_pose.at[k:].add(0.2), shape, present)
    # displacement may depend on frame k itself, posture only on what precedes it
    np.testing.assert_array_equal(after.translation[:k], before.translation[:k])
    np.testing.assert_array_equal(after.body_pose[: k + 1], before.body_pose[: k + 1])
    assert not np.array_equal(after.translation[k], before.translation[k])
    assert not np.array_equal(after.body_pose[k + 1], before.body_pose[k + 1])


def test_windows_with_an_absent_frame_are_not_valid(model, body, walk):
    orientation, body_pose, shape, present = walk
    found = run(model, body, orientation, body_pose, shape, present.at[2].set(False))
    full = np.arange(T) >= model.past
    np.testing.assert_array_equal(found.valid, full & (np.arange(T) - model.past > 2))


def test_a_sequence_that_is_too_short_has_no_prediction(model, body, walk):
    orientation, body_pose, shape, present = (
        walk[0][:5],
        walk[1][:5],
        walk[2],
        walk[3][:5],
    )
    found = run(model, body, orientation, body_pose, shape, present)
    assert found.translation.shape == (5, 3)
    assert not found.valid.any()


def test_covariances_are_positive(model, body, walk):
    found = run(model, body, *walk)
    assert (np.linalg.eigvalsh(found.covariance) > 0).all()


def test_single_precision_agrees(model, body, walk):
    single = lambda x: x.astype(jnp.float32) if eqx.is_inexact_array(x) else x
    found = run(model, jax.tree.map(single, body), *map(single, walk))
    assert found.translation.dtype == jnp.float32
    expected = run(model, body, *walk)
    np.testing.assert_allclose(found.translation, expected.translation, atol=2e-5)


@pytest.mark.slow
def test_derivatives_are_finite_where_rotations_are_singular(model, body, walk):
    orientation, body_pose, shape, present = walk

    @eqx.filter_jit
    def gradient(orientation, body_pose):
        return jax.grad(
            lambda r, p, s: sum(
                (x**2).sum()
                for x in jax.tree.leaves(
                    eqx.filter(
                        predict(model, body, r, p, s, present), eqx.is_inexact_array
                    )
                )
            ),
            (0, 1, 2),
        )(orientation, body_pose, shape)

    still = jnp.zeros_like(body_pose)
    half_turn = jnp.broadcast_to(so3.exp(jnp.array([0.0, jnp.pi, 0.0])), (T, 3, 3))
    for r, p in (
        (orientation, body_pose),
        (jnp.broadcast_to(jnp.eye(3), (T, 3, 3)), still),
        (half_turn, still.at[:, 0, 0].set(jnp.pi)),
    ):
        for g in gradient(r, p):
            assert jnp.isfinite(g).all()


def test_lower_triangle_is_a_cholesky_factor(key):
    entries = jax.random.normal(key, (5, 6))
    factor = lower_triangle(entries)
    np.testing.assert_array_equal(factor, np.tril(factor))
    expected = np.linalg.cholesky(factor @ factor.swapaxes(-1, -2))
    np.testing.assert_allclose(factor, expected, rtol=1e-9)


def test_cosine_basis_is_orthonormal():
    np.testing.assert_allclose(
        cosine_basis(9) @ cosine_basis(9).T, np.eye(9), atol=1e-12
    )


def test_nearest_turn_does_not_jump():
    reference = jnp.array([0.0, 3.3, 0.0])

    @jax.jit
    def turns(reference):
        angles = so3.log(so3.exp(reference))
        slope = jax.jacobian(nearest_turn)(jnp.zeros(3), reference)
        return angles, nearest_turn(angles, reference), slope

    angles, found, slope = turns(reference)
    assert float(angles[1]) == pytest.approx(3.3 - 2 * np.pi)
    np.testing.assert_allclose(found, reference, atol=1e-9)
    assert jnp.isfinite(slope).all()


def test_the_papers_network_has_its_sizes(key):
    network = PaperNetwork.init(key, past=2)
    shapes = [
        [layer.weight.shape for layer in part]
        for part in (network.encoder, network.position, network.posture)
    ]
    assert shapes == [
        [(154, 1024), (1024, 1024), (1024, 1024)],
        [(1024, 1024), (1024, 1024), (1024, 3)],
        [(1024, 1024), (1024, 1024), (1024, 72)],
    ]


@pytest.mark.parametrize("kind", ["paper", "metric"])
def test_weights_survive_a_file(tmp_path, key, kind):
    if kind == "paper":
        network = PaperNetwork.init(key, 2, 8)
    else:
        network = MetricNetwork.init(key, 4, (16, 8), members=2)
    network = jax.tree.map(lambda x: x.astype(jnp.float32), network)
    past = 2 if kind == "paper" else 4
    saved = MotionModel(network, "default", 30.0, past, json.dumps({"data": "none"}))
    save_motion_model(tmp_path / "m.npz", saved)
    found = load_motion_model(tmp_path / "m.npz")
    assert json.loads(found.about) == {"data": "none"}
    assert jax.tree.structure(found.network) == jax.tree.structure(network)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(saved), strict=True):
        np.testing.assert_array_equal(a, b)


def test_weights_in_half_precision_are_as_good(tmp_path, key, model):
    save_motion_model(tmp_path / "whole.npz", model)
    save_motion_model(tmp_path / "half.npz", model, half=True)
    whole, half = (tmp_path / f"{n}.npz" for n in ("whole", "half"))
    assert half.stat().st_size < 0.6 * whole.stat().st_size
    for a, b in zip(
        jax.tree.leaves(model), jax.tree.leaves(load_motion_model(half)), strict=True
    ):
        assert b.dtype == jnp.float32
        np.testing.assert_allclose(b, a, rtol=1e-3, atol=1e-6)


def test_the_papers_network_ships_and_is_what_its_preset_uses(body):
    """It was trained on walks and predicts those of other people."""
    paper = load_motion_model(Config.paper().motion_model)
    assert isinstance(paper.network, PaperNetwork) and paper.past == 2
    assert paper.network.encoder[0].weight.shape == (154, 1024)
    assert Config().motion_model is None
    assert isinstance(load_motion_model().network, MetricNetwork)
    check_compatible(paper, body, 30.0)
    clips = Path(simulation.__file__).parent / "assets" / "walking.npz"
    found = evaluate_model(paper, body, read_motion(clips)[:3])["walk"]
    assert 0.8 < found["slope"] < 1.15
    assert found["ratio"] < 0.4
    # Its constant covariance was measured over exact and noisy postures together.
    assert 0.1 < found["nees"] < 1.5


def test_weights_of_something_else_are_refused(tmp_path, model, body):
    with pytest.raises(InputError, match="no such motion model"):
        load_motion_model(tmp_path / "none.npz")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    with pytest.raises(ValueError, match="not a motion model"):
        load_motion_model(tmp_path / "other.npz")
    save_motion_model(tmp_path / "m.npz", model)
    (tmp_path / "torn.npz").write_bytes((tmp_path / "m.npz").read_bytes()[:5000])
    with pytest.raises(ValueError, match="not a motion model"):
        load_motion_model(tmp_path / "torn.npz")
    with np.load(tmp_path / "m.npz") as archive:
        arrays = dict(archive)
    np.savez(tmp_path / "cut.npz", **(arrays | {"array_0": np.zeros((3, 3))}))
    with pytest.raises(ValueError, match="do not fit"):
        load_motion_model(tmp_path / "cut.npz")
    nan = np.full_like(arrays["array_0"], np.nan)
    np.savez(tmp_path / "nan.npz", **(arrays | {"array_0": nan}))
    with pytest.raises(ValueError, match="NaN"):
        load_motion_model(tmp_path / "nan.npz")
    header = json.loads(str(arrays["header"]))
    for changes, told in (
        ({"fps": 0}, "`header.fps` is 0, expected 1"),
        ({"sizes": {"past": 16}}, "no `members` in header.sizes"),
        ({"format": "bodyslam-motion-9"}, "format 'bodyslam-motion-9'"),
    ):
        changed = np.array(json.dumps(header | changes))
        np.savez(tmp_path / "header.npz", **(arrays | {"header": changed}))
        with pytest.raises(ValueError, match=told):
            load_motion_model(tmp_path / "header.npz")
    with pytest.raises(ValueError, match="25"):
        check_compatible(model, body, 25.0)
    with pytest.raises(ValueError, match="trained on body 'smpl', not 'default'"):
        check_compatible(dataclasses.replace(model, body="smpl"), body, 30.0)


def test_weights_for_another_body_are_refused_before_a_run(
    monkeypatch, capsys, tmp_path, model
):
    save_motion_model(tmp_path / "m.npz", dataclasses.replace(model, body="smpl"))
    sequence = Sequence(
        name="video",
        frames=None,
        timestamps=np.arange(30) / 30,
        intrinsics=Intrinsics(np.array([500.0, 500.0, 320.0, 240.0]), 640, 480),
        keypoints=Keypoints(np.zeros((1, 30, 25, 2)), np.zeros((1, 30, 25))),
    )
    monkeypatch.setattr(io, "read_sequence", lambda *_, **__: sequence)
    monkeypatch.setattr("bodyslam_jax.cli.jax_setup.prepare", lambda device: None)
    argv = ["bodyslam", "run", "video", "--out", str(tmp_path / "run")]
    argv += ["--motion-model", str(tmp_path / "m.npz")]
    monkeypatch.setattr(sys, "argv", argv)
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    told = str(stopped.value.code)  # text: exit code 1
    assert "trained on body 'smpl', not 'default'" in told
    assert len(told.splitlines()) == 1


def test_the_shipped_weights_describe_themselves(model):
    about = json.loads(model.about)
    assert "CMU" in about["data"]
    assert about["licence"]
    folder = Path(__file__).parents[1] / "bodyslam_jax" / "motion" / "assets"
    assert sum(f.stat().st_size for f in folder.glob("*.npz")) < 15e6


def made_up_track(prediction, orientation, scale, rng, outliers=0.0):
    """A camera that circles while the person moves exactly as predicted."""
    t = len(orientation)
    before = np.concatenate([orientation[:1], orientation[:-1]])
    step = np.einsum("tab,tb->ta", before, prediction.translation)
    step[~prediction.valid] = 0
    phase = np.linspace(0, 4, t)
    camera = np.stack([np.cos(phase), 0.1 * phase, np.sin(phase)], -1)
    offset = np.cumsum(step, 0) - scale * camera
    wrong = rng.random(t) < outliers
    return camera, offset + np.where(wrong[:, None], rng.normal(0, 1, (t, 3)), 0.0)


def made_up_walk(seed, t, outliers):
    """Prediction, orientation, camera and offset, where the scale is 2.5."""
    rng = np.random.default_rng(seed)
    orientation = np.asarray(so3.exp(jnp.asarray(rng.normal(0, 1, (t, 3)))))
    prediction = Prediction(
        translation=jnp.asarray(rng.normal(0.02, 0.01, (t, 3))),
        covariance=jnp.broadcast_to(jnp.eye(3), (t, 3, 3)),
        body_pose=jnp.zeros((t, 23, 3)),
        rotation=jnp.zeros((t, 3)),
        valid=jnp.arange(t) > 7,
    )
    track = made_up_track(prediction, orientation, 2.5, rng, outliers)
    return prediction, orientation, *track


@pytest.mark.parametrize(("outliers", "tolerance"), [(0.0, 1e-6), (0.1, 0.05)])
def test_scale_is_found_by_regression(outliers, tolerance):
    prediction, orientation, camera, offset = made_up_walk(0, 200, outliers)
    found = scale_from_motion(prediction, orientation, camera, offset)
    assert found.value == pytest.approx(2.5, rel=tolerance)
    assert found.standard_error < 0.2
    still = scale_from_motion(prediction, orientation, 0 * camera, offset)
    assert np.isnan(still.value) and np.isinf(still.standard_error)


def test_the_scale_of_a_few_seconds_has_a_standard_error():
    """It has too few windows of two seconds, but enough shorter ones."""
    found = [scale_from_motion(*made_up_walk(seed, 100, 0.1)) for seed in range(8)]
    assert all(0 < scale.standard_error < 0.2 for scale in found)


def test_a_rollout_stays_a_motion(model, body, walk):
    orientation, body_pose, shape, _ = walk
    found = rollout(model, body, orientation[:2], body_pose[:2], shape, 150)
    assert found.trans.shape == (152, 3)
    assert jnp.isfinite(found.body_pose).all()
    assert float(jnp.abs(found.body_pose).max()) < 3.5
    speed = jnp.linalg.norm(jnp.diff(found.trans, axis=0), axis=-1) * 30
    assert float(speed.max()) < 8.0  # m/s
    np.testing.assert_array_equal(found.body_pose[:2], body_pose[:2])
    world = so3.exp(jnp.array([0.3, 1.0, -2.0]))
    turned = rollout(model, body, world @ orientation[:2], body_pose[:2], shape, 150)
    np.testing.assert_allclose(turned.trans, found.trans @ world.T, atol=1e-6)


@pytest.mark.slow
def test_evaluation_of_a_perfect_and_a_shrunken_model(body, model):
    clips = [make_clip(60), make_clip(60, seed=1, motion="run")]
    found = evaluate_model(model, body, clips, 0.0)
    assert set(found) == {"all", "walk", "run", "constant velocity"}
    assert found["all"]["steps"] == 2 * (60 - model.past)
    assert found["constant velocity"]["slope"] == pytest.approx(1, abs=0.1)
    assert -1 <= found["all"]["corr_30"] <= found["all"]["corr_1"] <= 1
    halved = eqx.tree_at(
        lambda m: m.network.gain, model, jnp.asarray(0.5 * model.network.gain)
    )
    half = evaluate_model(halved, body, clips, 0.0)
    assert half["all"]["slope"] == pytest.approx(0.5 * found["all"]["slope"], rel=1e-5)
    with pytest.raises(ValueError, match="no usable sequence among 1"):
        evaluate_model(model, body, [make_clip(5)], 0.0)


def test_correlation_of_errors_is_that_of_their_process():
    """Errors of an AR(1) process, with gaps whose neighbours do not count."""
    rng, rho, (c, t) = np.random.default_rng(0), 0.8, (60, 200)
    error = rng.normal(0, 1, (c, t, 3))
    for k in range(1, t):
        error[:, k] = rho * error[:, k - 1] + 0.6 * error[:, k]
    valid = rng.random((c, t)) < 0.8
    none = np.zeros((c, t))
    found = error_correlation(
        Steps(
            predicted=np.where(valid[..., None], error, 1e3),
            true=np.zeros((c, t, 3)),
            previous=np.zeros((c, t, 3)),
            covariance=np.broadcast_to(np.eye(3), (c, t, 3, 3)),
            frame=np.broadcast_to(np.eye(3), (c, t, 3, 3)),
            angle=none,
            root_angle=none,
            place=none,
            valid=valid,
        )
    )
    # three standard errors of 60 sequences are about 0.02
    for lag in (1, 2, 4, 8):
        assert found[f"corr_{lag}"] == pytest.approx(rho**lag, abs=0.02)


@pytest.fixture(scope="module")
def shared():
    folder = Path(__file__).parents[2] / "shared" / "data"
    if not folder.exists():
        pytest.skip("no shared data here")
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("drift_deg", "ratio"), [(0.0, 0.12), (5.0, 0.16), (9.0, 0.22)]
)
def test_the_shipped_model_on_held_out_subjects(model, shared, drift_deg, ratio):
    clips = [c for c in read_motion(shared / "cmu_locomotion.npz") if c.split == "val"]
    found = evaluate_model(model, load_body_model(), clips, drift_deg, seeds=2)["all"]
    assert found["ratio"] < ratio
    assert abs(found["slope"] - 1) < 0.04
    assert found["spread"] < 0.09


def test_leg_length_follows_shape(body):
    legs = leg_length(body, jnp.stack([jnp.zeros(10), jnp.ones(10)]))
    assert 0.7 < float(legs[0]) < 0.95
    assert legs[0] != legs[1]
