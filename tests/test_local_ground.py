"""Ground that is not a plane: its height under feet, scale on stairs, drift of feet."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes

from bodyslam_jax import graph, initialisation, motion
from bodyslam_jax.config import GraphWeights
from bodyslam_jax.ground.heights import (
    elevation,
    ground_under,
    running_median,
    wander,
)
from bodyslam_jax.people import PersonState
from bodyslam_jax.pipeline.joint_problem import Prepared
from bodyslam_jax.pipeline.joint_stage import is_uneven, with_ground_of
from bodyslam_jax.types import ScaleStart

UP = np.array([0.0, 1.0, 0.0])
FPS = 30.0


def level(x, z):
    return 0.0 * x


def stairs(x, z):
    """A landing, five steps upwards, and a floor behind them."""
    return 0.17 * np.clip(np.floor((z - 5.0) / 0.35) + 1, 0, 5)


def slope(x, z):
    return np.tan(np.radians(4.0)) * z


def bumps(x, z):
    return 0.15 * np.sin(2 * x) * np.sin(1.5 * z)


def floor_points(height, rng, count=6000, noise=0.005):
    x, z = rng.uniform(-3, 3, count), rng.uniform(1, 12, count)
    return np.column_stack([x, height(x, z) + rng.normal(0, noise, count), z])


@pytest.mark.parametrize("height", [level, stairs, slope, bumps])
@pytest.mark.parametrize("unit", [1.0, 0.1])
def test_the_ground_under_a_foot_in_any_unit(height, unit):
    rng = np.random.default_rng(0)
    points = floor_points(height, rng) / unit
    x, z = rng.uniform(-1, 1, 40), rng.uniform(3, 9, 40)
    feet = np.column_stack([x, height(x, z), z]) / unit
    eyes = np.tile([0.0, 2.0, 0.0], (40, 1)) / unit
    rays = 0.3 * (feet - eyes)  # of any length, as the scale is not known
    error = unit * (ground_under(eyes, rays, points, UP) - feet[:, 1])
    assert np.isfinite(error).mean() > 0.9
    # Beside the edge of a step the level of the other side is as near.
    tolerance = 0.05 if height is bumps else 0.025  # which are as steep as 17 degrees
    assert np.nanquantile(np.abs(error), 0.8) < tolerance


def test_of_two_floors_on_one_ray_the_upper_one_is_seen():
    """At the upper edge of stairs the lower floor is beside the foot in the image."""
    rng = np.random.default_rng(1)
    upper = floor_points(level, rng)
    upper = upper[upper[:, 2] < 5]
    lower = floor_points(lambda x, z: 0.0 * x - 0.9, rng)
    lower = lower[lower[:, 2] > 6]
    eye, foot = np.array([[0.0, 1.5, 1.0]]), np.array([[0.0, 0.0, 4.8]])
    (found,) = ground_under(eye, foot - eye, np.concatenate([upper, lower]), UP)
    assert found == pytest.approx(0.0, abs=0.02)


def test_ground_that_is_not_in_view_is_unknown():
    rng = np.random.default_rng(2)
    eye = np.array([[0.0, 1.5, 0.0]])
    under = lambda ray, points: ground_under(eye, np.array([ray]), points, UP)[0]
    points = floor_points(level, rng)
    assert np.isfinite(under([0.0, -1.5, 5.0], points))
    assert np.isnan(under([0.0, 0.5, 5.0], points))  # a foot above the horizon
    assert np.isnan(under([0.0, -1.5, 5.0], points[:0]))
    assert np.isnan(under([9.0, -1.5, 1.0], points))
    walls = points + [0, 1.0, 0] * rng.random((len(points), 1))
    assert np.isnan(under([0.0, -1.5, 5.0], walls[walls[:, 1] > 0.6]))


def test_a_running_median_ignores_frames_that_are_not_in_use():
    values = np.array([1.0, 1.0, 50.0, 1.0, 1.0, np.nan, 3.0, 3.0, 3.0])
    used = np.isfinite(values)
    found = running_median(values, used, fps=10.0, seconds=0.2)
    np.testing.assert_array_equal(found, [1, 1, 1, 1, 1, 2, 3, 3, 3])
    nothing = running_median(values, np.zeros(9, bool), 10.0)
    assert np.isnan(nothing).all()


def test_feet_wander_where_they_rise_over_seconds_and_not_by_noise_or_size():
    rng = np.random.default_rng(3)
    t = 300
    heights = 0.02 * rng.standard_normal((2, t))
    heights[1] += 0.2  # a person who is estimated too small
    used = np.ones((2, t), bool)
    slow, sigma = wander(heights, used, FPS)
    assert sigma == 0.0 and not slow.any()
    rise = np.linspace(0.0, 0.3, t)
    slow, sigma = wander(heights + rise, used, FPS)
    assert sigma == pytest.approx(0.3 / 12**0.5, rel=0.3)
    np.testing.assert_allclose(slow[0], 0.9 * (rise - 0.15), atol=0.03)
    used[0] = False
    slow, _ = wander(heights + rise, used, FPS)
    assert not slow[0].any() and slow[1].any()
    assert wander(heights, np.zeros((2, t), bool), FPS)[1] == 0.0


def test_who_stands_at_different_heights_stands_above_the_floor():
    rng = np.random.default_rng(5)
    used = np.ones(480, bool)
    noise = 0.01 * rng.standard_normal(480)
    above, sigma = elevation(noise, used, FPS)
    assert sigma == 0.0 and not above.any()
    rungs = np.tile(np.repeat([0.28, 0.56, 0.84, 0.56], 30), 4)
    above, sigma = elevation(rungs + noise, used, FPS)
    np.testing.assert_allclose(above - above.min(), rungs - 0.28, atol=0.05)
    assert 0 < above.min() < sigma < 0.28
    # Where the floor is seen, too, and where less is seen.
    steps = np.where(np.arange(480) < 240, 0.0, rungs)
    above, sigma = elevation(steps + noise - 3.0, used, FPS)
    assert np.abs(above - steps).mean() < sigma
    _, long = elevation(rungs + noise, used, FPS)
    _, short = elevation((rungs + noise)[:120], used[:120], FPS)
    assert 3 * long < short


UNIT = 5.0
"""m per unit of the map."""


def standing(height, lift: float | np.ndarray = 0.0, frames=120, table=False):
    """A person at rest who is moved over a floor, filmed from eye level; map in units.

    `lift` raises the person over the floor, m, for each frame. A `table` hides the feet
    for a while.
    """
    rng = np.random.default_rng(4)
    k = np.linspace(0, 1, frames)
    eyes = np.column_stack([0.3 * np.sin(6 * k), 2.2 + 0 * k, 0.5 * k])
    T_WC = np.tile(np.diag([1.0, -1, -1, 1]), (frames, 1, 1))
    T_WC[:, :3, :3] = np.diag([-1.0, -1.0, 1.0])  # x to the left, y down, z ahead
    T_WC[:, :3, 3] = eyes
    place = np.column_stack([0.5 * np.sin(5 * k), 0 * k, 3.5 + 5 * k])
    place[:, 1] = height(place[:, 0], place[:, 2]) + lift
    body = scenes.body_model()
    roots = np.tile(np.eye(4), (1, frames, 1, 1))
    R_CW = T_WC[0, :3, :3].T
    roots[0, :, :3, :3] = R_CW
    person = PersonState(
        np.ones((1, frames), bool),
        roots,
        np.zeros((1, frames, 23, 3)),
        np.zeros((1, 10)),
    )
    pelvis = -_lowest(person, body)
    roots[0, :, :3, 3] = (place + pelvis * UP - eyes) @ R_CW.T
    points = floor_points(height, rng)
    trees = rng.uniform([-5, 0, 2], [5, 4, 14], (500, 3))
    T_WC[:, :3, 3] /= UNIT
    if table:
        top = rng.uniform([-1.5, 0.9, 3.4], [1.5, 0.9, 4.2], (800, 3))
        points = np.concatenate([points, top])
    points = np.concatenate([points, trees[np.abs(trees[:, 0]) > 3]]) / UNIT
    state = initialisation.first_state(T_WC, points, person, scenes.INTRINSICS)
    return state, person, body


def _lowest(person, body):
    """Height of the soles over the pelvis, m."""
    alone = initialisation.first_state(
        np.tile(np.eye(4), (person.present.shape[1], 1, 1)),
        np.zeros((0, 3)),
        person,
        scenes.INTRINSICS,
    )
    still = dataclasses.replace(
        alone, roots=jnp.broadcast_to(jnp.eye(4), alone.roots.shape)
    )
    everywhere = person.present.shape
    feet = graph.GroundContact(
        body,
        jnp.asarray(UP),
        jnp.zeros(everywhere),
        jnp.ones(everywhere),
        jnp.zeros(everywhere),
    )
    residual = np.asarray(feet.residual(still))
    return float(residual[0, 0, 0])


def ground_of(height, lift: float | np.ndarray = 0.0, table=False):
    state, person, body = standing(height, lift, table=table)
    found = initialisation.ground_contact(
        state, person.present, None, body, GraphWeights(), FPS
    )
    assert found is not None
    return found, state


def start_of(contact, state):
    """The first scale, from the ground alone."""
    nothing = motion.Prediction(
        translation=jnp.zeros((0, 3)),
        covariance=jnp.zeros((0, 3, 3)),
        body_pose=jnp.zeros((0, 23, 3)),
        rotation=jnp.zeros((0, 3)),
        valid=jnp.zeros(0, bool),
    )
    everyone = range(len(state.roots))
    prediction = jax.tree.map(lambda x: jnp.stack([x for _ in everyone]), nothing)
    return initialisation.scale_start(state, prediction, contact, without=everyone)


@pytest.mark.parametrize("height", [level, slope, stairs, bumps])
def test_scale_from_people_on_any_floor(height):
    contact, state = ground_of(height)
    start = start_of(contact, state)
    assert start.ground == pytest.approx(UNIT, rel=0.02)
    # A plane is used as it is; elsewhere the ground has a height under each foot.
    planar = np.ptp(np.asarray(contact.offset)) == 0
    assert planar == (height in (level, slope))
    wide = start_of(initialisation.with_elevation(contact, state, FPS), state)
    assert wide.ground == pytest.approx(UNIT, rel=0.02)
    assert wide.ground_error < 1.2 * start.ground_error and not wide.climbing


def test_a_table_before_the_feet_is_not_the_ground():
    contact, state = ground_of(level, table=True)
    assert np.ptp(np.asarray(contact.offset)) == 0
    assert start_of(contact, state).ground == pytest.approx(UNIT, rel=0.02)


def test_feet_that_rise_and_sink_over_the_floor_say_less_of_scale():
    """Motion capture whose floor drifts: scale errs by no more than is claimed."""
    rise = 0.16 * np.linspace(0, 1, 120)
    contact, state = ground_of(level, rise)
    wide = initialisation.with_elevation(contact, state, FPS)
    before, after = start_of(contact, state), start_of(wide, state)
    assert abs(after.ground - UNIT) < abs(before.ground - UNIT) > 0.02 * UNIT
    assert after.ground_error > 1.5 * before.ground_error
    assert abs(after.ground - UNIT) < 2 * after.ground_error


def test_rungs_of_a_ladder_are_not_the_floor():
    """Taken for the floor, they make the map a quarter too small."""
    rungs = np.repeat([0.28, 0.56, 0.84, 0.56], [25, 35, 35, 25])
    contact, state = ground_of(level, rungs)
    wide = initialisation.with_elevation(contact, state, FPS)
    before, after = start_of(contact, state), start_of(wide, state)
    assert before.ground < 0.8 * UNIT
    assert abs(after.ground - UNIT) < after.ground_error < 0.25 * UNIT
    assert after.climbing and after.by_climbers > 0.1
    walked = dataclasses.replace(after, motion=UNIT, motion_error=0.1 * UNIT)
    assert np.isnan(walked.by_climbers)


def test_who_stands_on_the_floor_tells_its_height_beside_a_climber():
    rungs = np.repeat([0.28, 0.56, 0.84, 0.56], [25, 35, 35, 25])
    (low, _, body), (high, _, _) = standing(level), standing(level, rungs)
    people = ("roots", "poses", "shapes")
    both = dataclasses.replace(
        low,
        **{
            name: jnp.concatenate([getattr(s, name) for s in (low, high)])
            for name in people
        },
    )
    found = initialisation.ground_contact(
        both, np.ones((2, 120), bool), None, body, GraphWeights(), FPS
    )
    assert found is not None
    wide = initialisation.with_elevation(found, both, FPS)
    start = start_of(wide, both)
    assert start.ground == pytest.approx(UNIT, rel=0.02)
    assert start.ground_error < 0.06 / 2.2 * UNIT and not start.climbing


def test_feet_in_the_air_are_on_no_ground():
    hop = np.zeros(120)
    hop[50:60] = 0.3
    contact, state = ground_of(level, hop)
    wide = initialisation.with_elevation(contact, state, FPS)
    away = np.isinf(np.asarray(wide.sigma)[0])
    np.testing.assert_array_equal(away, hop > 0)
    weighted = lambda f: np.average(
        np.asarray(f.scales(state))[0], weights=np.asarray(f.sigma)[0] ** -2.0
    )
    assert weighted(wide) == pytest.approx(UNIT, rel=0.01)
    assert weighted(contact) < 0.99 * UNIT


def test_soles_are_where_the_person_stands():
    contact, state = ground_of(stairs)
    soles = np.asarray(contact.soles(state))[0] @ np.asarray(state.cameras[0, :3, :3]).T
    below = UNIT * np.asarray(state.cameras[:, :3, 3]) + soles
    k = np.linspace(0, 1, len(soles))
    place = np.column_stack([0.5 * np.sin(5 * k), 3.5 + 5 * k])
    np.testing.assert_allclose(below[:, [0, 2]], place, atol=0.2)
    # A soft minimum of four points is a little below the lowest.
    np.testing.assert_allclose(below[:, 1], stairs(*place.T), atol=0.03)


def test_uneven_ground_is_estimated_again_where_people_are_found():
    contact, state = ground_of(stairs)
    _, person, body = standing(stairs)
    prepared = Prepared(
        graph.make_problem([contact], state), state, ScaleStart(), person, True, ()
    )
    assert is_uneven(prepared.problem)
    registered = np.ones(person.present.shape[1], bool)
    anew = lambda state, prepared: with_ground_of(
        state, prepared, registered, None, body, GraphWeights(), FPS
    )
    offset = lambda prepared: np.asarray(prepared.problem.factors[0].offset)[0]
    np.testing.assert_array_equal(offset(anew(state, prepared)), offset(prepared))
    # A person who turns out to be nearer to the camera stands elsewhere.
    nearer = dataclasses.replace(
        state, roots=state.roots.at[..., :3, 3].add(jnp.array([0.0, 0.3, 0.0]))
    )
    assert (offset(anew(nearer, prepared)) != offset(prepared)).any()
    flat, level_state = ground_of(level)
    plane = dataclasses.replace(
        prepared, problem=graph.make_problem([flat], level_state)
    )
    assert not is_uneven(plane.problem)
    bare = dataclasses.replace(level_state, landmarks=level_state.landmarks[:0])
    assert anew(bare, plane) is plane
