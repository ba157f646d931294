"""Training: the same for a seed, continued after a kill, on any number of devices."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from test_motion_data import make_clip, write_amass, write_cmu

from bodyslam_jax import cli
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import MotionTraining
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.motion import (
    Guess,
    MotionNetwork,
    load_motion_model,
    read_motion,
    split,
    train,
)
from bodyslam_jax.motion.capture.clips import FPS, place, resample
from bodyslam_jax.motion.paper_network import PaperNetwork
from bodyslam_jax.motion.training.evaluation import calibrated, widened
from bodyslam_jax.motion.training.sampling import corpus, draw
from bodyslam_jax.motion.training.train import loss

NOISY = MotionTraining(
    past=4,
    width=(16, 8),
    epochs=3,
    segments=64,
    steps=4,
    learning_rate=1e-2,
    drift_deg=8.0,
    white_deg=0.5,
    strides=(4,),
)
CLEAN = dataclasses.replace(NOISY, drift_deg=0.0, white_deg=0.0)
"""With these two, most of this module compiles nothing of its own."""

OPTIONS = (
    "--past 4 --width 16 8 --epochs 3 --segments 64 --steps 4 --learning-rate 0.01 "
    "--drift-deg 8 --white-deg 0.5 --strides 4"
).split()
"""`NOISY` for the command line."""


@pytest.fixture(scope="module")
def body():
    return load_body_model(dtype=jnp.float32)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """An archive of a subject to train on and one to validate with."""
    path = tmp_path_factory.mktemp("data") / "cmu.npz"
    clips = [make_clip(t, seed=t, name=f"a_{t}") for t in (30, 40, 15)]
    write_cmu(path, [*clips, make_clip(30, name="b_01", subject="b", split="val")])
    return path


@pytest.fixture(scope="module")
def clips(data):
    return list(split(read_motion(data))[0])


@pytest.fixture(scope="module")
def validation(data):
    return split(read_motion(data))[1]


@pytest.fixture(scope="module")
def trained(body, clips, validation):
    return train(clips, body, NOISY, validation=validation)


@pytest.fixture(scope="module")
def clean_batch(body, clips):
    return draw(jax.random.key(1), corpus(clips, CLEAN), body, CLEAN)


def weights(model):
    return [np.asarray(x) for x in jax.tree.leaves(model)]


def command(monkeypatch, capsys, *argv):
    """`bodyslam train-motion` in this process: exit code, output, error."""
    monkeypatch.setattr(sys, "argv", ["bodyslam", "train-motion", *map(str, argv)])
    monkeypatch.setattr("bodyslam_jax.cli.jax_setup.prepare", lambda device: None)
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    out = capsys.readouterr()
    code = stopped.value.code
    return (1, out.out, code) if isinstance(code, str) else (code, out.out, out.err)


class Killed(Exception):
    pass


@pytest.mark.slow
def test_a_killed_training_continues_to_the_same_weights(
    tmp_path, body, clips, validation, trained
):
    file = tmp_path / "training.npz"

    def die(epoch, epochs, measures):
        assert epochs == 3
        assert np.isfinite(list(measures.values())).all()
        if epoch == 2:
            raise Killed

    with pytest.raises(Killed):
        train(clips, body, NOISY, validation=validation, checkpoint=file, report=die)
    left = list(tmp_path.iterdir())
    assert left == [file]  # complete, and nothing half-written beside it
    seen = []
    model, history = train(
        clips,
        body,
        NOISY,
        validation=validation,
        checkpoint=file,
        report=lambda epoch, epochs, measures: seen.append(epoch),
    )
    assert seen == [3]
    for a, b in zip(weights(model), weights(trained[0]), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(history, trained[1])
    # the checkpoint stays until whoever asked for it has the weights on disk
    model, _ = train(clips, body, NOISY, validation=validation, checkpoint=file)
    for a, b in zip(weights(model), weights(trained[0]), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_the_command_trains_the_same_for_the_same_seed(
    monkeypatch, capsys, tmp_path, data, trained
):
    out = tmp_path / "m.npz"
    code, told, _ = command(monkeypatch, capsys, data, "--out", out, *OPTIONS)
    assert code == 0 and told.strip() == str(out)
    assert sorted(f.name for f in tmp_path.iterdir()) == ["m.npz", "m.png"]
    assert (tmp_path / "m.png").stat().st_size > 5000
    model = load_motion_model(out)
    for a, b in zip(weights(model), weights(trained[0]), strict=True):
        np.testing.assert_array_equal(a, b)
    about = json.loads(model.about)
    assert about["settings"]["drift_deg"] == 8.0
    ratios = [float(x) for x in trained[1][:, 3]]  # of one of the epochs
    assert about["metrics"]["ratio at 9°"] in ratios


def test_presets_of_the_command(monkeypatch, tmp_path, capsys):
    """`--preset paper` is section 3.4, and options beside it prevail."""
    from bodyslam_jax import motion

    seen = []
    monkeypatch.setattr(motion, "train_from_data", lambda *args: seen.append(args[2]))
    out = tmp_path / "m.npz"
    for options in ((), ("--preset", "paper"), ("--preset=paper", "--epochs", "7")):
        assert command(monkeypatch, capsys, "data", "--out", out, *options)[0] == 0
    paper = MotionTraining.paper()
    assert seen == [MotionTraining(), paper, dataclasses.replace(paper, epochs=7)]
    assert (paper.past, paper.width, paper.epochs) == (2, (1024,), 100)
    assert paper.segments * paper.steps == 4096 and paper.learning_rate == 1e-3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trans": np.full((50, 3), np.nan)}, "NaN or infinite position in frame 0"),
        ({"poses": np.full((50, 156), np.nan)}, "NaN or infinite pose in frame 0"),
        ({"poses": np.zeros((50, 60))}, "poses (50, 60)"),
        ({}, "no usable sequence among 1"),
    ],
)
def test_bad_data_are_one_line_and_exit_code_1(
    monkeypatch, capsys, tmp_path, changes, message
):
    write_amass(tmp_path / "subject" / "walk.npz", t=50, **changes)
    code, _, error = command(
        monkeypatch, capsys, tmp_path, "--out", tmp_path / "m.npz", "--past", 16
    )
    assert code == 1
    assert message in error and len(error.strip().splitlines()) == 1
    assert not (tmp_path / "m.npz").exists()


def test_bad_names_are_one_line_and_exit_code_1(monkeypatch, capsys, tmp_path, data):
    found = [
        command(monkeypatch, capsys, tmp_path / "none", "--out", tmp_path / "m.npz"),
        command(monkeypatch, capsys, tmp_path, "--out", tmp_path / "m.npz"),
        command(monkeypatch, capsys, data, "--out", tmp_path / "weights"),
        command(
            monkeypatch,
            capsys,
            data,
            "--out",
            tmp_path / "m.npz",
            "--body-model",
            tmp_path / "SMPL_NEUTRAL.pkl",
        ),
    ]
    told = ("no such file", "no usable motion among 0", "npz", "SMPL_NEUTRAL.pkl")
    for (code, _, error), words in zip(found, told, strict=True):
        assert code == 1 and words in error and len(error.splitlines()) == 1


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--epochs 0", "epochs: found 0, expected 1 or more."),
        ("--epochs -1", "epochs: found -1, expected 1 or more."),
        ("--segments 0", "segments: found 0, expected 1 or more."),
        ("--past 0", "past: found 0, expected 1 or more."),
        ("--members 0", "members: found 0, expected 1 or more."),
        ("--future 2", "future: found 2, expected 0 to 1."),
        ("--clean-share nan", "clean_share: found nan, expected 0 to 1."),
        ("--run-weight inf", "run_weight: found inf, expected 0 or more, and finite."),
        (
            "--learning-rate 0",
            "learning_rate: found 0.0, expected more than 0, and finite.",
        ),
        ("--width", "width: found (), expected one number or more."),
        ("--strides", "strides: found (), expected one number or more."),
        ("--strides 4 0", "strides: found (4, 0), expected each 1 or more."),
    ],
)
def test_settings_that_train_nothing_are_one_line_and_exit_code_1(
    monkeypatch, capsys, tmp_path, data, option, message
):
    out = tmp_path / "m.npz"
    code, _, error = command(monkeypatch, capsys, data, "--out", out, *option.split())
    assert (code, error) == (1, f"bodyslam: {message}")
    assert not list(tmp_path.iterdir())


def test_the_output_path_is_checked_before_training(
    monkeypatch, capsys, tmp_path, data
):
    file, folder = tmp_path / "file", tmp_path / "folder.npz"
    file.touch()
    folder.mkdir()

    def read(path):
        raise InputError("read")

    monkeypatch.setattr("bodyslam_jax.motion.training.command.read_motion", read)
    new = tmp_path / "new" / "m.npz"  # a folder that can be made is no fault
    for out, message in (
        (file / "m.npz", f"{file / 'm.npz'}: {file} cannot be written (Not a dir"),
        (file / "a" / "m.npz", f"{file / 'a' / 'm.npz'}: {file} cannot be written"),
        (folder, f"{folder}: is a folder; expected a file"),
        (new, "read"),
    ):
        code, _, error = command(monkeypatch, capsys, data, "--out", out)
        assert code == 1 and error.startswith(f"bodyslam: {message}")
    assert sorted(tmp_path.iterdir()) == [file, folder]


@pytest.mark.slow
def test_training_learns(trained):
    _, history = trained
    assert history[-1, 0] < history[0, 0]


@pytest.mark.slow
def test_a_trained_network_is_trained_further(body, clips, trained):
    """From where it stopped, with the normalisation that it has."""
    before, first = trained
    after, history = train(clips, body, NOISY, network=before.network)
    assert history[0, 0] < first[0, 0]
    for name in ("inputs", "posture_inputs", "posture_outputs", "unit"):
        kept, found = (getattr(m.network, name) for m in (before, after))
        # A running mean of what stays the same rounds.
        assert eqx.tree_equal(kept, found, rtol=1e-5)


@pytest.mark.slow
def test_the_size_of_the_covariance_is_told(body, validation, trained):
    """So that another network may have the one that was found for this."""
    model, _ = trained
    factor = json.loads(model.about)["covariance_factor"]
    trials = place(body, resample([c for c in validation if c.phase == 0], FPS))
    again = calibrated(widened(model, 1 / factor), body, trials)
    assert json.loads(again.about)["covariance_factor"] == pytest.approx(factor, 1e-3)


class StepForward(MotionNetwork):
    """A custom network: a constant step, whatever the posture."""

    step: Float[Array, " 3"]
    log_sigma: Float[Array, " 3"]

    def __call__(self, window):
        last, like = window.body_pose[..., -2, :, :], window.leg[..., None]
        cholesky = jnp.exp(self.log_sigma) * jnp.eye(3, dtype=like.dtype)
        return Guess(
            translation=self.step * jnp.ones_like(like),
            cholesky=cholesky * jnp.ones_like(like)[..., None],
            body_pose=last,
            rotation=jnp.zeros((*like.shape[:-1], 3), like.dtype),
        )


def test_a_custom_network_is_trained_by_its_likelihood(body, clips, clean_batch):
    start = StepForward(jnp.zeros(3, jnp.float32), jnp.zeros(3, jnp.float32))
    model, history = train(clips, body, CLEAN, network=start)
    assert isinstance(model.network, StepForward)
    assert history[-1, 0] < history[0, 0]
    assert loss(model.network, clean_batch, CLEAN) < loss(start, clean_batch, CLEAN)


def test_validation_may_be_rare(body, clips, validation, trained, tmp_path):
    """Epochs without validation have NaN, also in the drawing."""
    from bodyslam_jax.motion import draw_history

    history = trained[1].copy()
    history[:2, 1:] = np.nan
    draw_history(history, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 5000


def test_a_checkpoint_of_another_run_is_refused(tmp_path, body, clips):
    file = tmp_path / "training.npz"
    np.savez(file, mark=np.array("something else"))
    with pytest.raises(ValueError, match="other settings or data"):
        train(clips, body, NOISY, checkpoint=file)
    for torn in (b"torn", file.read_bytes()[:100]):
        file.write_bytes(torn)
        with pytest.raises(ValueError, match="not a training checkpoint"):
            train(clips, body, NOISY, checkpoint=file)


def test_clips_that_are_too_short_are_one_line(body):
    with pytest.raises(ValueError, match=r"no usable sequence among 1: .* 0.07 s"):
        train([make_clip(3)], body, NOISY)


def test_motion_that_is_not_wanted_is_left_out(clips):
    dance = make_clip(40, name="a_2", motion="other")
    few = dataclasses.replace(CLEAN, other_weight=0.25)
    none = dataclasses.replace(CLEAN, other_weight=0.0)
    assert corpus([*clips, dance], none).num_windows == corpus(clips, few).num_windows
    found = corpus([clips[1], dance], few)  # as long as each other
    half = found.num_windows // 2
    assert float(found.cumulative[half - 1]) == pytest.approx(0.8, abs=1e-6)
    with pytest.raises(ValueError, match="none is named walk, run or jog"):
        corpus([dance], none)


@pytest.mark.parametrize("past", [2, 4])
def test_windows_of_a_corpus(clips, past):
    """All windows at 120 Hz, or those that do not overlap."""
    settings = dataclasses.replace(NOISY, past=past, steps=1)
    span = 4 * past  # a window of 1 + past frames at 30 Hz
    lengths = [(len(c.poses) - 1) * 4 + 1 for c in clips]
    for sliding in (True, False):
        found = corpus(clips, dataclasses.replace(settings, sliding=sliding))
        assert len(found.poses) == sum(lengths)
        start, last = np.asarray(found.start), np.asarray(found.last)
        assert (start + span <= last).all()
        if sliding:
            assert found.num_windows == sum(t - span for t in lengths)
            continue
        assert (start[1:] > start[:-1] + span).all()
        # As many as fit without a frame of the 30 Hz sequences in two of them.
        assert found.num_windows == sum(len(c.poses) // (past + 1) for c in clips)


def test_windows_that_may_not_overlap_are_drawn_singly():
    with pytest.raises(ValueError, match="steps: found 16, expected 1"):
        MotionTraining(sliding=False)
    assert MotionTraining.paper().steps == 1


def test_a_batch_is_consistent_with_its_labels(clean_batch):
    """Without noise, at real speed: joints in contact give the displacement."""
    batch = clean_batch
    assert batch.window.joints.shape == (64, 4, 5, 24, 3)
    assert batch.move.shape == (64, 4, 3)
    # the made-up walker moves 4 cm a frame, in legs of 0.8 m
    size = np.linalg.norm(batch.move, axis=-1)[np.asarray(batch.weight) > 0]
    assert np.median(size) == pytest.approx(0.05, rel=0.25)
    np.testing.assert_allclose(batch.window.joints[..., 0, :], 0.0, atol=1e-6)
    spin = batch.window.rotation[:, :, CLEAN.past - 1]
    np.testing.assert_allclose(spin, np.broadcast_to(np.eye(3), spin.shape), atol=1e-5)


def test_noise_disturbs_the_share_that_is_not_clean(body, clips, clean_batch):
    noisy = draw(jax.random.key(1), corpus(clips, NOISY), body, NOISY)
    gap = np.abs(clean_batch.window.joints - noisy.window.joints).max((1, 2, 3, 4))
    assert 0.1 < (gap < 1e-5).mean() < 0.35
    np.testing.assert_allclose(clean_batch.move, noisy.move, atol=1e-6)


def test_the_papers_loss_is_its_equation(clean_batch):
    batch = clean_batch
    network = PaperNetwork.init(jax.random.key(0), CLEAN.past, 16)
    scaled = jnp.linspace(0.5, 2.0, 75, dtype=jnp.float32)

    @jax.jit
    def both(network):
        out = network.normalised(network.features(batch.window))
        move = batch.move * batch.window.leg[..., None] / scaled[:3]
        pose = batch.pose.reshape(64, 4, 72) / scaled[3:]
        c_p = ((out[..., :3] - move) ** 2).sum(-1)
        c_theta = ((out[..., 3:] - pose) ** 2).sum(-1)
        equation = (c_p + c_theta / 24) * batch.weight
        settings = MotionTraining.paper()
        return equation.sum() / batch.weight.sum(), loss(network, batch, settings)

    network = dataclasses.replace(
        network, outputs=dataclasses.replace(network.outputs, std=scaled)
    )
    expected, found = both(network)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


SCRIPT = """
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


@pytest.mark.slow
def test_two_devices_agree_with_one(tmp_path):
    found = []
    for count in (1, 2):
        file = tmp_path / f"{count}.npz"
        devices = f"--xla_force_host_platform_device_count={count}"
        # Beside those of the tests, without which compiling takes three times as long.
        flags = f"{os.environ.get('XLA_FLAGS', '')} {devices}"
        subprocess.run(
            [sys.executable, "-c", SCRIPT, str(file)],
            check=True,
            cwd=Path(__file__).parent,
            env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        )
        found.append(np.load(file))
    one, two = found
    assert (int(one["count"]), int(two["count"])) == (1, 2)
    for name in set(one.files) - {"count"}:
        np.testing.assert_allclose(one[name], two[name], rtol=1e-3, atol=2e-4)


@pytest.mark.slow
def test_kill_9_loses_nothing(tmp_path, data):
    """The command, killed in its second epoch, is finished by the same command.

    That weights are then those of a run without interruption is tested above, without
    processes.
    """
    argv = [sys.executable, "-m", "bodyslam_jax", "train-motion", str(data), *OPTIONS]
    argv[-1:] = ["4", "--epochs", "40"]
    environment = os.environ | {"BODYSLAM_CACHE": str(tmp_path / "cache")}
    start = lambda name: subprocess.Popen(
        [*argv, "--out", str(tmp_path / name)], env=environment, stderr=subprocess.PIPE
    )
    checkpoint = tmp_path / "killed.ckpt.npz"
    killed = start("killed.npz")
    while not checkpoint.exists() and killed.poll() is None:
        time.sleep(0.01)
    killed.send_signal(signal.SIGKILL)
    killed.communicate()
    assert killed.returncode == -signal.SIGKILL
    assert checkpoint.exists() and not (tmp_path / "killed.npz").exists()
    again = start("killed.npz")
    told = again.communicate()[1].decode()
    assert "continuing" in told and again.returncode == 0
    assert not checkpoint.exists()
    found = load_motion_model(tmp_path / "killed.npz")
    assert json.loads(found.about)["settings"]["epochs"] == 40
    assert all(np.isfinite(x).all() for x in weights(found))
