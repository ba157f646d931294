"""The estimate while a video runs: the prior of a window, and all of it (slow)."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from passing_camera import CAMERA, passing

import bodyslam_jax as bs
from bodyslam_jax import evaluation, graph, simulation
from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.graph import CHUNK
from bodyslam_jax.online import maps, window_problem
from bodyslam_jax.online import prior as priors
from bodyslam_jax.online.online import SMOOTHED
from bodyslam_jax.online.record import smoothed_scales
from bodyslam_jax.online.window import SCALE_WALK, Window
from bodyslam_jax.online.window_content import FRAMES, Measured
from bodyslam_jax.online.window_problem import (
    GROUND_HALF_INFORMATION_FRAMES as HALF_INFORMATION,
)
from bodyslam_jax.types import Result, Sequence

# The prior of a window.


def random_prior(frames: int, people: int, rng: np.random.Generator):
    state = graph.State(
        scale=jnp.asarray(1.5),
        cameras=jnp.asarray(np.tile(np.eye(4), (frames, 1, 1))),
        roots=jnp.asarray(np.tile(np.eye(4), (people, frames, 1, 1))),
        poses=jnp.zeros((people, frames, 23, 3)),
        shapes=jnp.zeros((people, 10)),
        landmarks=jnp.zeros((0, 3)),
        intrinsics=jnp.asarray(CAMERA.params),
    )
    prior = priors.no_prior(state, frames, 2)
    size = len(prior.offset)
    root = jnp.asarray(rng.standard_normal((size, size)))
    offset = jnp.asarray(rng.standard_normal(size))
    return state, graph.MarginalPrior(
        root=root,
        offset=offset,
        estimate=prior.estimate,
        anchor=prior.anchor,
        invariant=prior.invariant,
        reach=2,
    )


def mean_and_covariance(prior: graph.MarginalPrior):
    matrix, slope = priors.information(prior)
    covariance = np.linalg.inv(matrix)
    return -covariance @ slope, covariance


def test_a_walk_of_the_scale_adds_variance_to_it_alone():
    _, prior = random_prior(12, 1, np.random.default_rng(0))
    mean, covariance = mean_and_covariance(prior)
    walked = priors.with_walk_of_scale(prior, 0.7)
    after, wider = mean_and_covariance(walked)
    covariance[0, 0] += 0.7
    assert np.abs(wider - covariance).max() < 1e-7 * np.abs(covariance).max()
    assert np.abs(after - mean).max() < 1e-6


def test_a_prior_of_another_unit_costs_the_same_at_the_scale_in_that_unit():
    state, prior = random_prior(12, 1, np.random.default_rng(1))
    state = eqx.tree_at(lambda s: s.scale, state, jnp.asarray(1.7))
    longer = eqx.tree_at(lambda s: s.scale, state, jnp.asarray(1.7 * 0.9))
    found = priors.with_drift_of_scale(prior, 0.9).residual(longer)
    np.testing.assert_allclose(found, prior.residual(state), atol=1e-6)


def test_people_who_go_leave_what_they_told_of_the_rest():
    _, prior = random_prior(12, 2, np.random.default_rng(1))
    mean, covariance = mean_and_covariance(prior)
    rest = priors.without_person(prior, 0)
    matrix, slope = priors.information(rest)
    gone = np.diag(matrix) < 1e-12
    assert gone.sum() == 10 + 2 * 6 + 69
    kept = ~gone
    inverse = np.linalg.inv(matrix[np.ix_(kept, kept)])
    expected = covariance[np.ix_(kept, kept)]
    assert np.abs(inverse - expected).max() < 1e-6 * np.abs(expected).max()
    assert np.abs(-inverse @ slope[kept] - mean[kept]).max() < 1e-6


def test_a_padded_prior_costs_what_it_did():
    rng = np.random.default_rng(2)
    state, prior = random_prior(15, 1, rng)
    longer, _ = random_prior(20, 1, rng)
    wide = priors.padded(prior, longer, 20)
    assert wide.frames == 20
    # Whatever the five frames are that it knows nothing of.
    moved = graph.retract_pose(
        longer.cameras, jnp.asarray(0.1 * rng.standard_normal((20, 6)))
    )
    there = graph.State(**{**vars(longer), "cameras": moved})
    here = graph.State(**{**vars(state), "cameras": moved[:15]})
    costs = [float(p.cost(x)) for p, x in ((wide, there), (prior, here))]
    assert abs(costs[0] - costs[1]) < 1e-9 * costs[1]


def test_scales_of_all_windows_are_those_of_a_dense_smoother():
    rng = np.random.default_rng(0)
    frames, fps = np.arange(0, 100, 10), 10.0
    told, mean, variance = [], 2.0, 0.04
    walks, measured = [], []
    for k in range(len(frames)):
        if k:
            walks.append((SCALE_WALK * mean) ** 2 * 10 / fps)
            variance += walks[-1]
        z = 2.0 + 0.05 * rng.standard_normal()
        gain = variance / (variance + 0.01)
        mean, variance = mean + gain * (z - mean), (1 - gain) * variance
        measured.append(z)
        told.append((int(frames[k]), mean, variance**0.5))
    _, found, sigma = smoothed_scales([(-10, 1.0, float("nan")), *told], fps)
    n = len(frames)
    matrix, right = np.eye(n) / 0.01, np.array(measured) / 0.01
    matrix[0, 0] += 1 / 0.04
    right[0] += 2.0 / 0.04
    for k, walk in enumerate(walks):
        matrix[k : k + 2, k : k + 2] += np.array([[1, -1], [-1, 1]]) / walk
    assert np.abs(found - np.linalg.solve(matrix, right)).max() < 1e-4
    assert sigma == pytest.approx(told[-1][2])


def test_what_was_told_of_s_is_forgotten_as_it_walks():
    """As much is left of the information of steps and ground on s as of that of all."""
    window = Window(CAMERA, bs.load_body_model(), Config(), 10.0, 1)
    squared = Config().weights.fitted_step_error ** 2
    of_steps = lambda: window.steps_told / (1 + squared * window.steps_told)
    of_ground = lambda: window.ground_told / (HALF_INFORMATION + window.ground_told)
    window.steps_told[:], window.ground_told = 300.0, 30.0
    before = of_steps(), of_ground()
    window_problem.forget(window, 0.01)  # no s yet
    assert (of_steps(), of_ground()) == before
    window.scale, window.scale_sigma = 4.0, 0.4
    window_problem.forget(window, 0.01)
    np.testing.assert_allclose(of_steps(), before[0] / 2, rtol=1e-12)
    np.testing.assert_allclose(of_ground(), before[1] / 2, rtol=1e-12)
    window_problem.forget(window, 0.0)
    np.testing.assert_allclose(of_steps(), before[0] / 2, rtol=1e-12)


def test_what_update_and_finish_refuse():
    with pytest.raises(InputError, match="fps"):
        bs.Online(fps=0.0)
    with pytest.raises(InputError, match="places"):
        bs.Online(places=0)
    online = bs.Online(threads=False)
    with pytest.raises(InputError, match="intrinsics"):
        online.update(None, 0.0)
    with pytest.raises(InputError, match="0 frames"):
        online.finish()


# All of it.


def play(online: bs.Online, sequence: Sequence, frames, twice=()):
    tracks, keypoints = sequence.tracks, sequence.keypoints
    for k in frames:
        at = tracks.frame == k
        points = tracks.landmark[at], tracks.uv[at]
        found = np.concatenate(
            [keypoints.uv[:, k], keypoints.confidence[:, k, :, None]], axis=-1
        )
        given = float(sequence.timestamps[k]), found
        yield online.update(None, *given, points=points)
        if k in twice:
            yield online.update(None, *given, points=points)


@pytest.fixture(scope="module")
def walk() -> tuple[Sequence, Result]:
    made = simulation.simulate(Simulation(sequence="M2", family="follow", length=150))
    return simulation.as_sequence(made), simulation.as_truth(made)


@pytest.mark.slow
def test_the_estimate_of_a_simulated_walk(walk):
    sequence, truth = walk
    given = {"intrinsics": sequence.intrinsics, "fps": 30.0}
    online = bs.Online(**given, threads=False, smooth=True)
    estimates = list(play(online, sequence, range(150), twice=(100,)))
    assert len(estimates) == 151
    late = [e for e in estimates if e.status == "late"]
    assert [e.timestamp for e in late] == [pytest.approx(100 / 30)]
    assert estimates[0].status == "starting" and estimates[-1].status == "tracking"
    assert np.isnan(estimates[0].scale_sigma)
    assert any("scale unknown" in note for note in estimates[0].notes)
    last = estimates[-1]
    assert last.scale_sigma < 0.1 * last.scale
    assert len(last.people) == 1 and abs(last.people[0].joints[[7, 8], 1].min()) < 0.25
    # What is in the window and what waits for it does not grow with time.
    assert len(online.slots.front) <= FRAMES and len(online.slots.waiting) < 10
    result = online.finish()
    found = evaluation.evaluate(result, truth, online.body)
    assert float(found["c_ate_se3"]) < 0.05
    assert float(found["h_ate_se3"]) < 0.08
    assert abs(float(found["scale"]) - 1) < 0.05
    assert result.present[0].mean() > 0.9
    assert len(result.timestamps) == 150
    assert "1 frames came late" in " ".join(result.summary["warnings"])
    with pytest.raises(InputError, match="finished"):
        online.update(None, 99.0)
    smooth = online.smooth()
    assert any(SMOOTHED in line for line in smooth.summary["warnings"])
    assert len(smooth.timestamps) == 150
    last = evaluation.evaluate(smooth, truth, online.body)
    assert float(last["c_ate_se3"]) < 0.03
    assert float(last["j_ate_se3"]) < float(found["j_ate_se3"])


@pytest.mark.slow
def test_a_lost_camera_is_told_and_a_new_map_begins(walk):
    sequence, _ = walk
    online = bs.Online(intrinsics=sequence.intrinsics, fps=30.0, threads=False)
    states = [e.status for e in play(online, sequence, range(60))]
    assert states[-1] == "tracking"
    nothing = np.zeros(0, int), np.zeros((0, 2))
    for k in range(60, 75):
        now = online.update(None, k / 30, np.zeros((0, 25, 3)), points=nothing)
        assert now.status == "lost" and not now.located
        assert np.isfinite(now.T_WC).all()
    result = online.finish()
    assert np.isfinite(result.T_WC).all() and np.isfinite(result.joints).all()
    assert "lost 1 times" in " ".join(result.summary["warnings"])


class LatePool:
    """A second thread whose first window is there after `delay` s of the video."""

    def __init__(self, delay: float) -> None:
        self.delay, self.now, self.due = delay, 0.0, 0.0
        self.taken: list[int] = []

    def submit(self, function, frames):
        self.found, self.due = function(frames), self.now + self.delay
        self.taken.append(len(frames))
        self.delay = 0.0
        return self

    def done(self) -> bool:
        return self.now >= self.due

    def result(self):
        return self.found

    def shutdown(self) -> None:
        pass


@pytest.fixture(scope="module")
def long_walk() -> tuple[Sequence, Result]:
    made = simulation.simulate(Simulation(sequence="M2", family="follow", length=240))
    return simulation.as_sequence(made), simulation.as_truth(made)


def late(sequence: Sequence, delay: float) -> tuple[bs.Online, LatePool]:
    online = bs.Online(intrinsics=sequence.intrinsics, fps=30.0, threads=False)
    online.prepare()
    pool: Any = LatePool(delay)
    online.pool = pool
    return online, pool


def play_late(online: bs.Online, pool: LatePool, sequence: Sequence) -> None:
    updates = play(online, sequence, range(sequence.num_frames))
    for timestamp, _ in zip(sequence.timestamps[1:], updates, strict=False):
        pool.now = float(timestamp)


@pytest.mark.slow
def test_a_window_mends_what_came_while_it_was_busy():
    """The front end's unit grows by 5 % after the first ten frames."""
    window = Window(CAMERA, bs.load_body_model(), Config(), 10.0, 1)
    frames, truth = [], []
    for k, (T, ids, uv) in enumerate(passing(70, np.random.default_rng(3))):
        drifted = T.copy()
        drifted[0, 3] += 0.05 * max(T[0, 3] - 0.05 * (CHUNK - 1), 0.0)
        frames.append(Measured(k / 10, drifted, True, ids, uv, {}))
        truth.append(T[:3, 3])
    found = {}
    for part in (frames[:CHUNK], frames[CHUNK:]):
        for solved in window.advance(part):
            centres = solved.T_WC[CHUNK:, :3, 3]
            found |= dict(enumerate(centres, start=solved.first + CHUNK))
    assert sorted(found) == list(range(70))
    step = lambda x: np.linalg.norm(x[5:] - x[:-5], axis=1)
    ratio = step(np.array([found[k] for k in range(70)])) / step(np.array(truth))
    # Where a map is cut, the path jumps: by 20 % here.
    assert ratio.max() < 1.08 * ratio.min()


@pytest.mark.slow
def test_a_late_window_takes_all_in_and_compiles_nothing(long_walk):
    sequence, truth = long_walk
    online, pool = late(sequence, 7.0)
    compiled: list[str] = []

    def listen(event, seconds, **about):
        if event.endswith("backend_compile_duration"):
            compiled.append(str(about.get("fun_name")))

    jax.monitoring.register_event_duration_secs_listener(listen)
    play_late(online, pool, sequence)
    jax.monitoring.unregister_event_duration_listener(listen)
    assert max(pool.taken) > FRAMES - CHUNK  # some of them came and went meanwhile
    assert compiled == []
    result = online.finish()
    found = evaluation.evaluate(result, truth, online.body)
    assert float(found["c_ate_sim3"]) < 0.03  # m
    assert abs(float(found["scale"]) - 1) < 0.05


@pytest.mark.slow
def test_a_window_that_is_too_late_goes_on_at_the_newest_frames(walk, monkeypatch):
    sequence, truth = walk
    monkeypatch.setattr(maps, "_MAX_WAITING_FRAMES", 2 * CHUNK)
    online, pool = late(sequence, 3.0)
    play_late(online, pool, sequence)
    assert max(pool.taken) <= 2 * CHUNK
    result = online.finish()
    assert "were not in the graph" in " ".join(result.summary["warnings"])
    assert online.counts.skipped >= 10
    # The path between is that of the map alone; its unit is kept, and s with it.
    found = evaluation.evaluate(result, truth, online.body)
    assert float(found["c_ate_sim3"]) < 0.1  # m
    assert abs(float(found["scale"]) - 1) < 0.1
