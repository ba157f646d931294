"""People on the ground of the map: where it is, what it says of scale, the check."""

import dataclasses

import estimates
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes

from bodyslam_jax import diagnostics, graph, initialisation, motion, simulation
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import Config, GraphWeights, Simulation
from bodyslam_jax.diagnostics import scale_uncertainty
from bodyslam_jax.ground.plane import find_ground
from bodyslam_jax.pipeline.to_metric import to_metric
from bodyslam_jax.types import Result, ScaleStart


def scene(factor: float = 1.0, tilt: float = 0.0, num: int = 40) -> Result:
    """Somebody walks 5 m before a camera; map and path are `factor` times too small."""
    rng = np.random.default_rng(0)
    s = np.linspace(0, 1, num)
    T_WC = np.tile(np.eye(4), (num, 1, 1))
    T_WC[:, :3, 3] = np.stack([0.2 * s, 1.5 + 0.02 * np.sin(9 * s), 4 * s], axis=-1)
    floor = np.stack(
        [rng.uniform(-4, 4, 200), rng.normal(0, 0.02, 200), rng.uniform(1, 15, 200)], -1
    )
    floor[:, 1] += np.tan(tilt) * (floor[:, 2] - 7)
    trees = rng.uniform([-6, 0, 2], [6, 5, 16], (300, 3))
    joints = np.zeros((1, num, 24, 3))
    joints[..., 1] = 1.0
    joints[0, :, :, 2] = (5 + 4 * s)[:, None]
    for foot, phase in ((10, 0.0), (11, np.pi)):
        joints[0, :, foot, 1] = 0.027 + 0.1 * np.maximum(np.sin(20 * s + phase), 0)
        joints[0, :, foot, 1] += np.tan(tilt) * (joints[0, :, foot, 2] - 7)
    # The camera is where it is relative to the person; the map is about the camera.
    eye = T_WC[:, :3, 3].copy()
    joints -= eye[None, :, None]
    points = np.concatenate([floor, trees]) / factor
    T_WC[:, :3, 3] /= factor
    joints += T_WC[None, :, None, :3, 3]
    return Result(
        timestamps=np.arange(num) / 30,
        T_WC=T_WC,
        scale=1.0,
        intrinsics=np.array([500.0, 500.0, 320.0, 240.0]),
        landmarks=points,
        poses=np.zeros((1, num, 72)),
        trans=np.zeros((1, num, 3)),
        betas=np.zeros((1, 10)),
        joints=joints,
        present=np.ones((1, num), bool),
    )


@pytest.mark.slow
@pytest.mark.parametrize("tilt", [0.0, 0.1])
@pytest.mark.parametrize("factor", [1.0, 1.8, 0.6])
def test_ground_scale_is_the_factor_by_which_the_map_is_too_small(factor, tilt):
    found = diagnostics.ground_scale(scene(factor, tilt))
    np.testing.assert_allclose(found, factor, rtol=0.04)  # floor: 2 cm rough


def test_the_ground_is_found_among_much_else():
    normal, offset = np.split(
        find_ground(scene().landmarks, scene().T_WC[:, :3, 3], np.array([0.0, 1, 0])),
        [3],
    )
    np.testing.assert_allclose(normal, [0, 1, 0], atol=0.01)
    np.testing.assert_allclose(offset, 0, atol=0.02)


def test_ground_scale_is_none_without_ground_or_people():
    whole = scene()
    walls = whole.landmarks[whole.landmarks[:, 1] > 0.5]
    assert diagnostics.ground_scale(dataclasses.replace(whole, landmarks=walls)) is None
    bare = dataclasses.replace(whole, landmarks=whole.landmarks[:0])
    assert diagnostics.ground_scale(bare) is None
    nobody = np.zeros_like(whole.present)
    assert diagnostics.ground_scale(dataclasses.replace(whole, present=nobody)) is None


def test_a_table_is_not_the_ground():
    rng = np.random.default_rng(1)
    flat = lambda n, y: np.c_[
        rng.uniform(-3, 3, n), np.full(n, y), rng.uniform(1, 9, n)
    ]
    floor, table = flat(150, 0.0), flat(250, 0.7)
    clutter = rng.uniform([-4, 0, 1], [4, 3, 9], (200, 3))
    eyes = np.tile([0.0, 1.5, 0.0], (9, 1))
    up = np.array([0.0, 1, 0])
    found = find_ground(np.concatenate([floor, table, clutter]), eyes, up)
    np.testing.assert_allclose(found, [0, 1, 0, 0], atol=0.02)


def contact(state: graph.State, units: float = 1.0) -> graph.GroundContact:
    """A floor under the people of `scenes`, whose world has y down."""
    everywhere = state.roots.shape[:2]
    up, sigma = jnp.array([0.0, -1.0, 0.0]), jnp.full(everywhere, 0.05)
    offset = jnp.full(everywhere, 1.3 / float(state.scale) / units)
    none = jnp.zeros(everywhere)
    return graph.GroundContact(scenes.body_model(), up, offset, sigma, none)


@pytest.mark.slow
def test_the_scale_that_contact_asks_for_puts_the_feet_on_the_ground():
    state = scenes.truth(np.random.default_rng(2), frames=3, landmarks=5)
    ground = contact(state)
    for frame, scale in enumerate(ground.scales(state)[0]):
        moved = dataclasses.replace(state, scale=scale)
        np.testing.assert_allclose(ground.residual(moved)[0, frame], 0, atol=1e-12)


@pytest.mark.slow
def test_the_unit_of_the_map_does_not_matter_to_contact():
    state = scenes.truth(np.random.default_rng(3), frames=3, landmarks=5)
    factor = 3.0
    cameras = state.cameras.at[:, :3, 3].divide(factor)
    other = dataclasses.replace(state, cameras=cameras, scale=state.scale * factor)
    there, here = contact(state, factor), contact(state)
    there = dataclasses.replace(there, offset=here.offset / factor)
    np.testing.assert_allclose(
        there.scales(other), factor * here.scales(state), rtol=1e-12
    )
    np.testing.assert_allclose(there.residual(other), here.residual(state), atol=1e-12)


def test_the_floor_is_below_what_somebody_stands_on():
    made = simulation.simulate(Simulation(sequence="M1", length=15))
    sequence, body = simulation.as_sequence(made), load_body_model()
    cameras, joint = (
        estimates.still_camera(sequence),
        estimates.standing_people(sequence),
    )
    rung = np.zeros((*joint.present.shape, 3))
    rung[..., 1] = -0.5  # y of the camera is down
    plain, raised = (
        to_metric(
            sequence,
            Config(),
            body,
            cameras,
            dataclasses.replace(joint, above_ground=above),
        )[0]
        for above in (None, rung)
    )
    higher = raised.joints - plain.joints
    np.testing.assert_allclose(higher[..., 1], 0.5, atol=0.02)
    np.testing.assert_allclose(higher[..., [0, 2]], 0.0, atol=0.02)


def test_cues_are_weighted_by_their_errors_and_say_when_they_disagree():
    both = ScaleStart(motion=2.0, motion_error=0.2, ground=3.0, ground_error=0.1)
    assert both.value == pytest.approx((2 / 0.04 + 3 / 0.01) / (1 / 0.04 + 1 / 0.01))
    assert both.standard_error == pytest.approx((1 / 0.04 + 1 / 0.01) ** -0.5)
    apart = scale_uncertainty.cue_discrepancy(both)
    assert apart == pytest.approx(np.log(3 / 2))
    (line,) = scale_uncertainty.discrepancy_warning(both)
    assert "0.67 times" in line and "no better than 20 %" in line
    nothing = ScaleStart()
    assert nothing.value == 1.0 and np.isinf(nothing.standard_error)
    unsure = dataclasses.replace(both, motion_error=0.5)
    alone = ScaleStart(motion=2.0, motion_error=0.1)
    for start in (dataclasses.replace(both, motion=2.8), unsure, alone, nothing):
        assert scale_uncertainty.cue_discrepancy(start) == 0.0
        assert not scale_uncertainty.discrepancy_warning(start)


@pytest.mark.slow
def test_steps_that_may_all_be_short_say_no_more_of_scale_than_that():
    frames, share = 200, 0.25
    step = jnp.array([0.04, 0.0, 0.001])
    one = motion.Prediction(
        translation=jnp.broadcast_to(step, (frames, 3)),
        covariance=jnp.broadcast_to(1e-4 * jnp.eye(3), (frames, 3, 3)),
        body_pose=jnp.zeros((frames, 23, 3)),
        rotation=jnp.zeros((frames, 3)),
        valid=jnp.ones(frames, bool).at[0].set(False),
    )
    seen = jax.tree.map(lambda x: x[None], one)
    shapes = jnp.zeros((1, 10))
    body = scenes.body_model()

    def error(shared: float) -> float:
        """Standard deviation of a factor of all steps, by the residuals."""
        factor = initialisation.motion_factor(
            seen, shapes, body, GraphWeights(), shared_error=shared
        )
        rho = np.asarray(factor.correlation)[0, 2:, None]
        white = np.asarray(factor.whitening @ factor.translation[..., None])[
            0, 2:, :, 0
        ]
        return float((((1 - rho) ** 2 / (1 - rho**2) * white**2).sum()) ** -0.5)

    alone = error(0.0)
    assert alone < 0.1
    np.testing.assert_allclose(error(share), np.hypot(alone, share), rtol=0.01)


def test_up_is_the_mean_direction_of_trunks():
    state = scenes.truth(np.random.default_rng(4), frames=30, people=2, landmarks=5)
    lean = 0.2 * np.sin(np.arange(30) * 2 * np.pi / 10)  # about 0 on average
    c, s, o = np.cos(lean), np.sin(lean), np.zeros(30)
    tilt = np.array([[o + 1, o, o], [o, c, -s], [o, s, c]]).transpose(2, 0, 1)
    back = np.asarray(state.cameras)[:, :3, :3].transpose(0, 2, 1)
    roots = np.array(state.roots)
    roots[:, :, :3, :3] = back @ np.diag([1.0, -1.0, -1.0]) @ tilt
    roots[1, :5, :3, :3] = np.eye(3)
    state = dataclasses.replace(state, roots=jnp.asarray(roots))
    present = np.ones((2, 30), bool)
    present[1, :10] = False  # a whole period
    np.testing.assert_allclose(
        initialisation.mean_up(state, present), [0, -1, 0], atol=1e-12
    )
