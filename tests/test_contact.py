"""Which of heels and toes stand: labels, network, the factor that holds them."""

import json
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import scenes

import bodyslam_jax.graph as g
from bodyslam_jax import initialisation, motion, simulate_case
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import ContactTraining, GraphWeights
from bodyslam_jax.evaluation.errors import posture_figures
from bodyslam_jax.geometry import so3
from bodyslam_jax.ground.stances import find_stances
from bodyslam_jax.initialisation import mean_up
from bodyslam_jax.motion.contact_network import windows_within
from bodyslam_jax.motion.training.contact import standing_points
from bodyslam_jax.pipeline import contact_stage, joint_problem
from bodyslam_jax.pipeline.contact_stage import hold_standing_feet, stand_on_plane
from bodyslam_jax.simulation import sequences

WALKS = str(sequences.ASSETS / "walking.npz")


def steps(fps=30.0, seconds=4.0, floor=0.0):
    """Two points that stand in turns of half a second; else they swing forward."""
    t = np.arange(round(seconds * fps)) / fps
    points = np.zeros((len(t), 2, 3))
    stands = np.stack([(t % 1) < 0.5, (t % 1) >= 0.5], axis=1)
    for i in range(2):
        swing = ((t - 0.5 * (1 - i)) % 1) * 2
        points[:, i, 1] = np.where(stands[:, i], 0, 0.1 * np.sin(np.pi * swing)) + floor
        points[:, i, 2] = np.cumsum(np.where(stands[:, i], 0, 2.0 / fps))
    return points, stands


@pytest.mark.parametrize("fps", [30.0, 120.0])
@pytest.mark.parametrize("floor", [0.0, 0.7])
def test_points_that_are_slow_and_low_stand_at_any_height_of_the_floor(fps, floor):
    points, stands = steps(fps, floor=floor)
    assert (standing_points(points, fps) == stands).mean() > 0.9


def test_a_foot_held_in_the_air_does_not_stand():
    points = np.zeros((60, 2, 3))
    points[:, 1, 1] = 0.3
    assert standing_points(points, 30.0).tolist() == [[True, False]] * 60


def test_windows_stay_within_a_run_of_frames():
    present = jnp.array([True, True, True, False, True, True])
    rows = np.asarray(windows_within(present, 2))
    assert rows[1].tolist() == [0, 0, 1, 2, 2]
    assert rows[4].tolist() == [4, 4, 4, 5, 5]


@pytest.fixture
def rng():
    return np.random.default_rng(0)


@pytest.fixture(scope="module")
def walks():
    clips = [clip for clip in motion.read_motion(WALKS) if clip.phase == 0]
    return clips[:3]


def test_the_network_reads_contacts_of_subjects_that_it_was_not_trained_on(walks):
    """From postures alone, with errors as estimates have them; the rule fails there."""
    model, body = motion.load_contact_model(), load_body_model()
    assert not {clip.subject for clip in walks} - {"02", "08", "55"}
    exact = motion.judge_contact(model, body, walks)
    assert exact["precision"] > 0.9 and exact["recall"] > 0.8
    noisy = motion.judge_contact(model, body, walks, 6.0)
    assert noisy["precision"] > 0.8 and noisy["recall"] > 0.7
    assert noisy["slip"] < 0.3
    assert noisy["rule_recall"] < noisy["recall"] - 0.2
    assert abs(noisy["probability"] - noisy["share"]) < 0.1


@pytest.mark.slow
def test_contacts_depend_neither_on_heading_nor_on_world_nor_on_frame_rate(rng):
    model, body = motion.load_contact_model(), load_body_model()
    (clip, *_) = motion.read_motion(WALKS)
    poses = jnp.asarray(clip.poses[:60], float)
    shape, present = jnp.zeros(10), jnp.ones(60, bool).at[:4].set(False)
    contact = eqx.filter_jit(motion.contact_between)
    turn = jaxlie.SO3.exp(jnp.asarray(rng.standard_normal(3))).as_matrix()
    way = lambda fps: (model, motion.make_clock(np.arange(60) / fps))
    given = (so3.exp(poses[:, 0]), poses[:, 1:], shape, present)
    found = contact(way(30.0), body, *given)
    assert found.shape == (60, 4) and (found[:4] == 0).all()
    assert 0.2 < float(found[4:].mean()) < 0.8
    turned = contact(way(30.0), body, turn @ given[0], *given[1:])
    np.testing.assert_allclose(turned, found, atol=1e-6)
    # Every second frame is missing: frames between are interpolated.
    half = [x[::2] for x in (given[0], given[1], given[3])]
    clock = motion.make_clock(np.arange(30) / 15.0)
    coarse = contact((model, clock), body, half[0], half[1], shape, half[2])
    assert np.abs(coarse[3:] - found[6::2]).mean() < 0.1


def test_contact_weights_are_read_as_they_were_written(tmp_path):
    model = motion.load_contact_model()
    assert {"data", "licence", "metrics"} <= json.loads(model.about).keys()
    motion.save_contact_model(tmp_path / "again.npz", model)
    again = motion.load_contact_model(tmp_path / "again.npz")
    assert eqx.tree_equal(model, again)
    np.savez(tmp_path / "other.npz", header=np.array(json.dumps({"format": "other"})))
    with pytest.raises(ValueError, match="other.npz: not a contact network"):
        motion.load_contact_model(tmp_path / "other.npz")


@pytest.mark.slow
def test_training_learns_contacts(walks):
    body = load_body_model()
    settings = ContactTraining(updates=300, width=(64,), segments=16, steps=8)
    losses = []
    model = motion.train_contact(
        walks, body, settings, report=lambda _, loss: losses.append(loss)
    )
    assert losses[-1] < 0.6 * losses[0]
    assert motion.judge_contact(model, body, walks)["precision"] > 0.8


def standing(rng, sigma=0.01):
    state = scenes.truth(rng, frames=5, people=2, landmarks=4)
    t = len(state.cameras)
    shape = jnp.broadcast_to(state.shapes[:, None], (2, t, 10))
    late = jnp.full((2, t, 4), sigma).at[:, 0].set(jnp.inf).at[0, 2, 1].set(jnp.inf)
    scale = jnp.full((2, t), state.scale)
    return g.FootContact(scenes.body_model(), shape, scale, late), state


def test_standing_feet_depend_neither_on_the_world_nor_on_shape_and_scale(rng):
    factor, state = standing(rng)
    cost = eqx.filter_jit(lambda f, s: f.cost(s))
    turn = jaxlie.SE3.exp(jnp.asarray(rng.standard_normal(6))).as_matrix()
    elsewhere = eqx.tree_at(lambda s: s.cameras, state, turn @ state.cameras)
    larger = eqx.tree_at(lambda s: s.scale, state, 1.1 * state.scale)
    taller = eqx.tree_at(lambda s: s.shapes, state, state.shapes + 1.0)
    before = cost(factor, state)
    assert before > 0
    np.testing.assert_allclose(cost(factor, elsewhere), before)
    # Shape and scale are constants of the factor: neither person nor world grows to
    # reach its steps.
    np.testing.assert_allclose(cost(factor, taller), before)
    np.testing.assert_allclose(cost(factor, larger), before)


def test_a_point_that_does_not_stand_has_no_weight(rng):
    factor, state = standing(rng)
    residual = eqx.filter_jit(lambda f, s: f.residual(s))(factor, state)
    assert (residual[0, 2, 1] == 0).all() and (residual[:, 0] == 0).all()
    assert (residual[0, 2, 0] != 0).any()


def test_probable_contacts_of_two_frames_have_the_weight(rng):
    _, state = standing(rng)
    probability = jnp.zeros((2, 5, 4)).at[0, 1:3, 0].set(0.9)
    present = np.ones((2, 5), bool)
    body = scenes.body_model()
    factor = initialisation.contact_factor(
        probability, state, present, 30.0, body, GraphWeights(contact_sigma=0.01)
    )
    leg = float(motion.leg_length(body, state.shapes)[0])
    assert np.argwhere(np.isfinite(factor.sigma)).tolist() == [[0, 2, 0]]
    np.testing.assert_allclose(factor.sigma[0, 2, 0], 0.01 * leg / 0.9)


def test_stances_are_where_the_network_finds_toes_standing():
    points, stands = steps()
    feet, there = points[None], np.ones((1, len(points)), bool)
    (places,) = find_stances(feet, there, 30.0, stands[None])
    assert len(places) == 8
    np.testing.assert_allclose(places[:, 1], 0.0, atol=1e-9)
    (none,) = find_stances(feet, there, 30.0, np.zeros_like(stands)[None])
    assert len(none) == 0


@pytest.mark.slow
def test_the_plane_is_where_feet_stand_and_believed_as_far_as_it_explains(rng):
    state = scenes.truth(rng, frames=20, people=1, landmarks=4)
    up = jnp.array([0.0, -1.0, 0.0])
    sigma = jnp.full((1, 20), 0.3).at[0, 0].set(jnp.inf)
    offset = jnp.full((1, 20), 2.0)
    level = jnp.zeros((1, 20))
    contact = g.GroundContact(scenes.body_model(), up, offset, sigma, level)
    stands = np.ones((1, 20, 4))
    stands[0, 5] = 0.0
    height = lambda factor, state: np.asarray(
        g.residual_of(eqx.tree_at(lambda f: f.sigma, factor, jnp.ones((1, 20))), state)
    )[0, :, 0]
    found = stand_on_plane(contact, state, stands, 30.0)
    used = np.isfinite(np.asarray(found.sigma[0]))
    assert not used[[0, 5]].any() and used.sum() > 12
    assert abs(np.median(height(found, state)[used])) < 0.02
    # Feet of half of the frames are a step higher: the plane has less weight.
    C_CW = jnp.swapaxes(state.cameras[:, :3, :3], 1, 2)
    raised = 0.4 * (np.arange(20) % 2)
    lift = jnp.asarray(raised)[:, None] * (C_CW @ up)
    lifted = state.roots.at[0, :, :3, 3].add(lift)
    stairs = eqx.tree_at(lambda s: s.roots, state, lifted)
    rough = stand_on_plane(contact, stairs, stands, 30.0)
    weight = lambda f: float((np.asarray(f.sigma) ** -2.0).sum())
    assert weight(rough) < 0.2 * weight(found)
    nobody = stand_on_plane(contact, state, 0 * stands, 30.0)
    assert eqx.tree_equal(nobody, contact)


@pytest.mark.slow
def test_feet_of_climbers_are_held_at_their_own_height(rng):
    state = scenes.truth(rng, frames=20, people=2, landmarks=4)
    up, everywhere = jnp.array([0.0, -1.0, 0.0]), jnp.ones((2, 20))
    of = lambda height: g.GroundContact(
        scenes.body_model(), up, 2 * everywhere, 0.3 * everywhere, height
    )
    C_CW = jnp.swapaxes(state.cameras[:, :3, :3], 1, 2)
    lifted = state.roots.at[1, :, :3, 3].add(0.5 * C_CW @ up)
    state = eqx.tree_at(lambda s: s.roots, state, lifted)
    stands = np.ones((2, 20, 4))

    def apart(height):
        found = stand_on_plane(of(height), state, stands, 30.0)
        bare = eqx.tree_at(lambda f: f.sigma, found, everywhere)
        return np.abs(np.median(np.asarray(g.residual_of(bare, state))[..., 0], 1))

    assert apart(0 * everywhere).max() > 0.2
    assert apart(jnp.array([[0.0], [0.1]]) * everywhere).max() < 0.02


@pytest.mark.slow
def test_standing_feet_stop_sliding_and_nothing_else_changes():
    """From a regressor's bodies: the speed of the lower foot falls, to the truth's."""
    case = simulate_case("E2", frames=60, family="follow")
    prepared = joint_problem.prepare(
        case.sequence,
        case.cameras,
        case.bodies,
        case.body,
        case.config,
    )
    start = prepared.state
    found = hold_standing_feet(
        prepared, start, case.sequence, case.cameras, case.body, case.config
    )
    for name in ("scale", "cameras", "shapes", "landmarks", "intrinsics"):
        assert eqx.tree_equal(getattr(found.state, name), getattr(start, name))
    speed = lambda state: float(
        posture_figures(
            case.trajectories(state).joints[0],
            case.truth.present[0],
            jnp.asarray(mean_up(state, np.asarray(case.truth.present))),
            case.truth.fps,
        )["foot_speed"]
    )
    assert speed(found.state) < 0.2 < speed(start)
    moved = found.state.roots[..., :3, 3] - start.roots[..., :3, 3]
    assert float(jnp.abs(moved).max()) < 0.15
    assert found.probability.shape == (1, 60, 4)


@pytest.mark.slow
def test_the_joint_problem_and_that_of_standing_feet_are_one_program(monkeypatch):
    """Their trees and shapes are equal, so that the second solve compiles nothing."""
    case = simulate_case("E2", frames=20, family="follow")
    arguments = case.sequence, case.cameras, case.bodies, case.body, case.config
    solved = []

    def record(problem, state, config, name):
        solved.append(problem)
        return SimpleNamespace(state=state), {}

    monkeypatch.setattr(contact_stage, "solve_stage", record)
    prepared = joint_problem.prepare(*arguments)
    rest = case.sequence, case.cameras, case.body, case.config
    hold_standing_feet(prepared, prepared.state, *rest)
    (problem,) = solved
    shape = lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype) if eqx.is_array(x) else x
    ours, joint = (jax.tree.map(shape, p) for p in (problem, prepared.problem))
    assert eqx.tree_equal(ours, joint)
    (contact,) = [f for f in problem.factors if isinstance(f, g.FootContact)]
    assert np.isfinite(contact.sigma).any()
    bare = joint_problem.prepare(*arguments, feet=False)
    with pytest.raises(ValueError, match="no FootContact"):
        hold_standing_feet(bare, bare.state, *rest)
