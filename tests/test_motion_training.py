"""Training: the same for a seed, continued after a kill, on any number of devices."""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_motion_data import make_clip

from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import MotionTraining
from bodyslam_jax.motion import _training as training
from bodyslam_jax.motion import draw_history, train
from bodyslam_jax.motion._network import PaperNetwork
from bodyslam_jax.motion._sampling import corpus, draw

draw = eqx.filter_jit(draw)

SMALL = MotionTraining(
    past=4, width=(16, 8), epochs=3, segments=8, steps=4, learning_rate=1e-2
)


@pytest.fixture(scope="module")
def body():
    return load_body_model(dtype=jnp.float32)


@pytest.fixture(scope="module")
def clips():
    return [make_clip(t, seed=t, name=f"a_{t}") for t in (30, 40, 15)]


@pytest.fixture(scope="module")
def trained(body, clips):
    return train(clips, body, SMALL, validation=clips[:1])


def weights(model):
    return [np.asarray(x) for x in jax.tree.leaves(model)]


class Killed(Exception):
    pass


def test_a_killed_training_continues_to_the_same_weights(
    tmp_path, body, clips, trained
):
    file = tmp_path / "training.npz"

    def die(epoch, epochs, measures):
        assert epochs == 3
        assert np.isfinite(list(measures.values())).all()
        if epoch == 2:
            raise Killed

    with pytest.raises(Killed):
        train(clips, body, SMALL, validation=clips[:1], checkpoint=file, report=die)
    left = list(tmp_path.iterdir())
    assert left == [file]  # complete, and nothing half-written beside it
    seen = []
    model, history = train(
        clips,
        body,
        SMALL,
        validation=clips[:1],
        checkpoint=file,
        report=lambda epoch, epochs, measures: seen.append(epoch),
    )
    assert seen == [3]
    assert not file.exists()
    for a, b in zip(weights(model), weights(trained[0]), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(history, trained[1])


def test_training_learns(trained):
    _, history = trained
    assert history[-1, 0] < history[0, 0]


def test_a_checkpoint_of_another_run_is_refused(tmp_path, body, clips):
    file = tmp_path / "training.npz"
    np.savez(file, mark=np.array("something else"))
    with pytest.raises(ValueError, match="other settings or data"):
        train(clips, body, SMALL, checkpoint=file)
    file.write_bytes(b"torn")
    with pytest.raises(ValueError, match="not a training checkpoint"):
        train(clips, body, SMALL, checkpoint=file)


def test_clips_that_are_too_short_are_one_line(body):
    with pytest.raises(ValueError, match=r"no usable sequence among 1: .* 0.07 s"):
        train([make_clip(3)], body, SMALL)


@pytest.mark.parametrize("sliding", [True, False])
def test_windows_of_a_corpus(clips, sliding):
    settings = dataclasses.replace(SMALL, sliding=sliding, strides=(4,))
    found = corpus(clips, settings)
    assert len(found.poses) == sum((len(c.poses) - 1) * 4 + 1 for c in clips)
    # a window of 1 + past frames at 30 Hz starts at any of four phases
    ends = np.asarray(found.start) + 4 * settings.past
    assert (ends <= np.asarray(found.last)).all()
    expected = sum((len(c.poses) - 1) * 4 + 1 - 16 for c in clips)
    assert (
        found.num_windows == expected if sliding else found.num_windows < expected / 4
    )


def test_a_batch_is_consistent_with_its_labels(body, clips, key):
    """Noise-free, at real speed: joints that stand still tell the displacement."""
    settings = dataclasses.replace(
        SMALL, drift_deg=0.0, white_deg=0.0, strides=(4,), segments=64
    )
    batch = draw(key, corpus(clips, settings), body, settings)
    assert batch.window.joints.shape == (64, 4, 5, 24, 3)
    assert batch.move.shape == (64, 4, 3)
    # the made-up walker moves 4 cm a frame, in legs of 0.8 m
    size = np.linalg.norm(batch.move, axis=-1)[np.asarray(batch.weight) > 0]
    assert np.median(size) == pytest.approx(0.05, rel=0.25)
    np.testing.assert_allclose(batch.window.joints[..., 0, :], 0.0, atol=1e-6)
    spin = batch.window.rotation[:, :, settings.past - 1]
    np.testing.assert_allclose(spin, np.broadcast_to(np.eye(3), spin.shape), atol=1e-5)


def test_noise_disturbs_the_share_that_is_not_clean(body, clips, key):
    clean = dataclasses.replace(SMALL, drift_deg=0.0, white_deg=0.0, segments=64)
    noisy = dataclasses.replace(clean, drift_deg=8.0, white_deg=0.5)
    data = corpus(clips, clean)
    first, second = draw(key, data, body, clean), draw(key, data, body, noisy)
    gap = np.abs(first.window.joints - second.window.joints).max((1, 2, 3, 4))
    assert 0.1 < (gap < 1e-5).mean() < 0.35
    np.testing.assert_array_equal(first.move, second.move)


def test_the_papers_loss_is_its_equation(body, clips, key):
    settings = dataclasses.replace(MotionTraining.paper(), segments=8)
    batch = draw(key, corpus(clips, settings), body, settings)
    network = PaperNetwork.init(key, 2, 16)
    out = network.normalised(network.features(batch.window))
    move = batch.move * batch.window.leg[..., None]
    pose = batch.pose.reshape(8, 1, 72)
    c_p = ((out[..., :3] - move) ** 2).sum(-1)
    c_theta = ((out[..., 3:] - pose) ** 2).sum(-1)
    weight = batch.weight
    expected = ((c_p + c_theta / 24) * weight).sum() / weight.sum()
    found = training.loss(network, batch, settings)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_the_history_is_drawn(tmp_path, trained):
    draw_history(trained[1], tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 5000


@pytest.mark.slow
def test_two_devices_agree_with_one(tmp_path):
    script = """
import sys
import jax, numpy as np
from test_motion_data import make_clip
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import MotionTraining
from bodyslam_jax.motion import train
small = MotionTraining(past=4, width=(16, 8), epochs=1, segments=8, steps=4)
model, history = train([make_clip(40)], load_body_model(), small)
np.savez(sys.argv[1], count=jax.local_device_count(), history=history,
         **{f"w{i}": x for i, x in enumerate(jax.tree.leaves(model))})
"""
    found = []
    for count in (1, 2):
        file = tmp_path / f"{count}.npz"
        flags = f"--xla_force_host_platform_device_count={count}"
        subprocess.run(
            [sys.executable, "-c", script, str(file)],
            check=True,
            cwd=Path(__file__).parent,
            env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        )
        found.append(np.load(file))
    one, two = found
    assert (int(one["count"]), int(two["count"])) == (1, 2)
    for name in set(one.files) - {"count"}:
        np.testing.assert_allclose(one[name], two[name], rtol=1e-3, atol=2e-4)
