"""Evaluating many pairs of different lengths: padded, and compiled once."""

import dataclasses
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import bodyslam_jax as bs
from bodyslam_jax import evaluation
from bodyslam_jax.types import Result

_STEP = "/jax/core/compile/jaxpr_trace_duration"


def _pair(num_frames: int, num_people: int = 1, seed: int = 0) -> tuple[Result, Result]:
    """A walk beside a camera, and an estimate that is centimetres off."""
    rng = np.random.default_rng(seed)
    t = np.arange(num_frames) / 30
    side = np.arange(num_people)[:, None]
    path = [1.2 * t + 0 * side, 0.02 * np.sin(12 * t) + 0 * side, np.sin(t) + 2 * side]
    root = np.stack(path, -1)
    joints = root[:, :, None] + rng.normal(0, 0.4, (24, 3))
    T_WC = np.tile(np.eye(4), (num_frames, 1, 1))
    T_WC[:, :3, 3] = root[0] + [0.3, 0.2, -3.0]
    truth = Result(
        timestamps=t,
        T_WC=T_WC,
        scale=1.0,
        intrinsics=np.ones(4),
        landmarks=np.zeros((0, 3)),
        poses=np.zeros((num_people, num_frames, 72)),
        trans=root,
        betas=np.zeros((num_people, 10)),
        joints=joints,
        present=np.ones((num_people, num_frames), bool),
    )
    moved = T_WC.copy()
    moved[:, :3, 3] += rng.normal(0, 0.03, (num_frames, 3))
    noisy = joints + rng.normal(0, 0.05, joints.shape)
    return dataclasses.replace(truth, T_WC=moved, joints=noisy), truth


@pytest.fixture(scope="module")
def pairs():
    """Of different lengths, and numbers of people."""
    return [_pair(20), _pair(70, 2, seed=1)]


@pytest.fixture(scope="module")
def stacked(pairs):
    return bs.stack_pairs(pairs)


@pytest.mark.slow
def test_stacked_errors_are_those_of_each_pair(pairs, stacked):
    found = jax.jit(jax.vmap(bs.evaluate))(*stacked)
    evaluate_unpadded = jax.jit(evaluation.evaluate_trajectories)
    for k, pair in enumerate(pairs):
        unpadded = evaluate_unpadded(*evaluation.associate(*pair))
        for name, value in unpadded.items():
            np.testing.assert_allclose(
                found[name][k], value, rtol=1e-9, atol=1e-12, err_msg=name
            )
        for name, values in unpadded.people.items():
            several = found.people[name][k]
            np.testing.assert_allclose(
                several[: len(values)], values, rtol=1e-9, atol=1e-12, err_msg=name
            )
            assert "of_truth" in name or np.isnan(several[len(values) :]).all(), name


@pytest.mark.slow
def test_gradients_of_stacked_errors_are_finite(stacked):
    estimates, truths = stacked
    names = ("c_ate_sim3_rmse", "wa_mpjpe", "rte", "h_ate_a3")

    def total(joints, T_WC):
        moved = dataclasses.replace(estimates, joints=joints, T_WC=T_WC)
        found = jax.vmap(bs.evaluate)(moved, truths)
        return sum(jnp.nansum(found[name]) for name in names)

    value, gradient = jax.jit(jax.value_and_grad(total, argnums=(0, 1)))(
        estimates.joints, estimates.T_WC
    )
    assert np.isfinite(value)
    assert all(np.isfinite(x).all() and np.any(x) for x in gradient)


@pytest.mark.slow
def test_another_length_is_not_compiled_again():
    evaluation.evaluate(*_pair(40, 2))
    traced = []

    def listen(event, duration, **_):
        if event == _STEP:
            traced.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        found = evaluation.evaluate(*_pair(33, 2))
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert not traced
    assert float(found["h_ate_se3"]) > 0


def test_no_pair_is_refused():
    with pytest.raises(ValueError, match="No pair"):
        bs.stack_pairs([])


def test_trajectories_are_stacked_as_they_are(pairs, stacked):
    """As those of states of a problem, which nobody has to associate."""
    again = bs.stack_pairs([evaluation.associate(*pair) for pair in pairs])
    jax.tree.map(np.testing.assert_array_equal, again, stacked)
    longer, shorter = (evaluation.associate(*pair)[0] for pair in (pairs[1], pairs[0]))
    with pytest.raises(ValueError, match="expected the same"):
        bs.stack_pairs([(longer, shorter)])


def test_the_page_of_metrics_has_every_key(stacked):
    one = jax.tree.map(lambda x: x[1], stacked)
    keys = set(jax.eval_shape(evaluation.evaluate_trajectories, *one).values)
    page = (Path(__file__).parents[1] / "docs" / "metrics.md").read_text()
    rows = [line.split("|")[1] for line in page.splitlines() if line.startswith("| `")]
    assert set(re.findall("`([a-z0-9_]+)`", " ".join(rows))) == keys
