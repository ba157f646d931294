"""Up and standing feet, from made walkers whose up is known."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodyslam_jax.ground.gravity import GravityCues, find_upright
from bodyslam_jax.ground.plane import feet_plane, map_plane
from bodyslam_jax.ground.stances import find_stances, standing_feet
from bodyslam_jax.ground.vertical_edges import Vertical

FPS = 30.0
NOTHING = np.zeros((0, 3))


def walker(path, *, floor=lambda x, z: 0.0 * x, period=30, fps=FPS):
    """Toe joints of somebody whose feet stand by turns along `path` (t, 2), m."""
    t = len(path)
    feet = np.zeros((t, 2, 3))
    for side in range(2):
        starts = np.arange(-side * period // 2, t + period, period)
        for a in starts:  # stands for 60 % of the period, swings for the rest
            stop = a + round(0.6 * period)
            now, then = np.clip([a, a + period], 0, t - 1)
            for k in range(max(a, 0), min(a + period, t)):
                s = np.clip((k - stop) / (a + period - stop), 0, 1)
                s = s * s * (3 - 2 * s)
                xz = (1 - s) * path[now] + s * path[then]
                feet[k, side, [0, 2]] = xz
                feet[k, side, 1] = floor(*xz) + 0.12 * np.sin(np.pi * s)
    return feet[None]


def way(t=240, speed=1.2, bend=1.0):
    angle = bend * np.linspace(0, 2, t)
    step = speed / FPS * np.column_stack([np.sin(angle), np.cos(angle)])
    return np.cumsum(step, axis=0) + [0.0, 4.0]


def cues(feet, lean, landmarks=NOTHING, *, fitted=True):
    h, t = feet.shape[:2]
    trunks = np.broadcast_to(
        Rotation.from_rotvec(np.radians(lean)).apply([0.0, 1.0, 0.0]), (h, t, 3)
    )
    eyes = np.broadcast_to([0.0, 1.5, 0.0], (t, 3))
    present = np.ones((h, t), bool)
    return GravityCues(trunks, feet, present, eyes, landmarks, FPS, np.full(h, fitted))


def off(up):
    return np.degrees(np.arccos(np.clip(up[1], -1, 1)))


def test_a_foot_stands_while_it_is_on_the_ground():
    feet = walker(way())[0]
    stands, lower = standing_feet(feet, np.array([0.0, 1.0, 0.0]), FPS)
    assert 0.7 < stands.mean() < 1.0
    height = feet[np.arange(len(feet)), lower, 1]
    assert height[stands].max() < 0.04
    # Also seen at another rate, and of somebody whose feet never stand nothing is.
    assert abs(standing_feet(feet[::2], np.eye(3)[1], 15.0)[0].mean() - 0.85) < 0.15
    sliding = feet + np.arange(len(feet))[:, None, None] * [0.05, 0, 0]
    assert standing_feet(sliding, np.eye(3)[1], FPS)[0].mean() < 0.2
    assert not standing_feet(feet[:1], np.eye(3)[1], FPS)[0].any()


def test_each_stance_is_one_place():
    feet = walker(way(t=150))
    (places,) = find_stances(feet, np.ones((1, 150), bool), FPS)
    # Half a period of 30 frames apart, in 150 frames.
    assert 8 <= len(places) <= 12
    np.testing.assert_allclose(places[:, 1], 0, atol=0.02)
    nobody = find_stances(feet, np.zeros((1, 150), bool), FPS)
    assert [len(one) for one in nobody] == [0]


@pytest.mark.parametrize(
    "lean, left", [((6.0, 0, 0), 0.2), ((0, 0, 4.0), 0.5), ((-5.0, 0, 2.0), 0.25)]
)
def test_standing_feet_correct_trunks_that_all_lean(lean, left):
    """All but the share `left`; a lean across the view may be the floor's slope."""
    found = find_upright(cues(walker(way()), lean))
    assert off(found.up) < left * np.linalg.norm(lean)
    assert np.degrees(found.trunks) > (1 - left) * np.linalg.norm(lean)
    assert found.sigma < np.radians(4.5)


def test_the_ground_of_the_map_corrects_them_where_nobody_walks():
    rng = np.random.default_rng(0)
    still = np.zeros((1, 90, 2, 3)) + [0.0, 0.0, 4.0]
    floor = np.column_stack(
        [rng.uniform(-3, 3, 400), rng.normal(0, 0.02, 400), rng.uniform(2, 8, 400)]
    )
    alone = find_upright(cues(still, (5.0, 0, 0)))
    assert off(alone.up) == pytest.approx(5.0, abs=0.1)
    found = find_upright(cues(still, (5.0, 0, 0), floor))
    assert off(found.up) < 1.0
    # A table top is no ground: people do not stand on it.
    table = find_upright(cues(still, (5.0, 0, 0), floor + [0, 0.8, 0]))
    assert off(table.up) == pytest.approx(5.0, abs=0.1)


def test_on_a_hill_up_stays_where_trunks_point():
    hill = lambda x, z: np.tan(np.radians(12.0)) * z
    feet = walker(way(bend=0.3), floor=hill)
    found = find_upright(cues(feet, (0.0, 0, 0), fitted=False))
    assert off(found.up) < 6.0
    assert np.degrees(found.ground) > 5.0
    # Bodies that were fitted to keypoints may be what is wrong: less is sure.
    loose = find_upright(cues(feet, (0.0, 0, 0), fitted=True))
    assert loose.sigma > np.radians(2.5)


@pytest.mark.parametrize("fitted", [False, True])
@pytest.mark.parametrize("direction", [0.0, 0.8, 1.6, 2.4])
def test_the_error_that_is_claimed_holds_on_a_slope(direction, fitted):
    """Up is taken to be nearly normal to a floor that slopes by 4 degrees, as most
    floors are level; what is claimed for floors that slope allows for that."""
    slope = np.tan(np.radians(4.0)) * np.array([np.cos(direction), np.sin(direction)])
    feet = walker(way(), floor=lambda x, z: slope[0] * x + slope[1] * z)
    found = find_upright(cues(feet, (0.0, 0, 0), fitted=fitted))
    assert 1.0 < off(found.up) < 1.15 * np.degrees(found.sigma_if_sloping)
    assert found.sigma < found.sigma_if_sloping


def test_up_is_claimed_as_a_mixture_of_level_and_sloping_floors():
    """Half of the floors are level, a quarter nearly, and a quarter slope; trunks lean
    as those of bodies that were fitted to keypoints."""
    rng = np.random.default_rng(0)
    error, sigma, steep, sloping = np.zeros((4, 200))
    kinds = rng.choice([0.2, 0.7, 4.0], p=[0.5, 0.25, 0.25], size=200)
    for k, kind in enumerate(kinds):
        slope = np.tan(np.radians(kind * rng.standard_normal(2)))
        feet = walker(way(120), floor=lambda x, z: slope[0] * x + slope[1] * z)
        lean = rng.standard_normal(3) * [4.5, 0.0, 2.0]
        found = find_upright(cues(feet, lean))
        error[k], sigma[k] = off(found.up) / 2**0.5, np.degrees(found.sigma)
        steep[k], sloping[k] = found.sigma_if_sloping, found.slope_probability
    rms = lambda x: np.sqrt(np.mean(x**2))
    # σ is that of the less certain axis.
    assert 0.5 < rms(error / sigma) < 1.1
    slopes = kinds == 4.0
    assert rms(error[slopes]) > 2 * rms(error[~slopes])
    assert 0.5 < rms(error[slopes] / np.degrees(steep[slopes])) < 1.1
    assert sloping[slopes].mean() > 1.2 * sloping[~slopes].mean()


def test_a_floor_of_steps_says_less_of_gravity_than_a_level_one():
    """Stances on stairs are off a plane one like the next, so that many are no better
    than a few; and a plane of the map that they are not on may lie across steps."""
    steps = lambda x, z: 0.17 * np.clip(np.floor(z - 7.0) + 1, 0, 4)
    stances = lambda floor: find_stances(
        walker(way(bend=0.5), floor=floor), np.ones((1, 240), bool), FPS
    )
    rough, flat = stances(steps), stances(lambda x, z: 0.0 * x)
    sigma = lambda plane: np.sqrt(np.trace(plane.covariance))
    assert sigma(feet_plane(rough, 0.08)) > 2.0 * sigma(feet_plane(flat, 0.08))
    rng = np.random.default_rng(1)
    floor = np.column_stack(
        [rng.uniform(-3, 3, 900), rng.normal(0, 0.01, 900), rng.uniform(2, 12, 900)]
    )
    eyes = np.tile([0.0, 1.5, 0.0], (20, 1))
    slanted = floor + [0, -0.4, 0] + np.outer(floor[:, 2], [0, np.tan(0.1), 0])
    level = map_plane(floor, eyes, flat)
    assert np.degrees(sigma(level)) < 0.6
    assert sigma(map_plane(slanted, eyes, flat)) > 2.0 * sigma(level)


def test_trunks_count_more_across_the_view_than_along_it():
    """The same wrong slope of the ground, once along the view and once across it."""
    along = walker(way(), floor=lambda x, z: 0.07 * z)
    across = walker(way(), floor=lambda x, z: 0.07 * x)
    tilts = [find_upright(cues(feet, (0.0, 0, 0))).up for feet in (along, across)]
    assert abs(tilts[0][2]) > abs(tilts[1][0])


@pytest.mark.parametrize("count", [1, 2, 8])
def test_many_people_who_lean_alike_do_not_outvote_the_floor(count):
    """Seen by one detector from one side, trunks err alike: a crowd is no better a
    spirit level than one of them."""
    feet = np.concatenate(
        [walker(way(bend=0.2) + [0.8 * h - 3.0, 0.5 * h]) for h in range(count)]
    )
    found = find_upright(cues(feet, [9, 0, 0]))
    assert off(found.up) < 3.0
    assert found.sigma < np.radians(6.0)


@pytest.mark.parametrize("floor", [True, False])
def test_people_who_sit_do_not_tilt_those_who_stand(floor):
    """Two of seven have trunks at 45 and 30 degrees, one way; with a floor, all of
    them walk on it."""
    feet = np.concatenate(
        [walker(way(bend=0.2) + [0.8 * h - 3.0, 0.5 * h]) for h in range(7)]
    )
    given = cues(feet, [0, 0, 2])
    trunks = given.trunks.copy()
    for h, lean in ((5, 45.0), (6, 30.0)):
        trunks[h] = Rotation.from_rotvec(np.radians([0, 0, -lean])).apply([0, 1.0, 0])
    if not floor:
        feet = np.cumsum(np.full_like(feet, 0.05), axis=1)
    found = find_upright(dataclasses.replace(given, trunks=trunks, feet=feet))
    assert off(found.up) < 3.0
    assert found.trunks < np.radians(3.0)


def test_people_of_wrong_size_do_not_tilt_the_floor():
    """A man who is made 5 % too small floats; he is further away as well."""
    near, far = walker(way(bend=2.0)), walker(way(bend=2.0) + [0.0, 3.0])
    stances = find_stances(
        np.concatenate([near, far + [0, 0.1, 0]]), np.ones((2, 240), bool), FPS
    )
    plane = feet_plane(stances, 0.08)
    assert plane is not None
    assert np.degrees(np.linalg.norm(plane.gradient)) < 0.7
    assert feet_plane([stances[0][:2]], 0.08) is None


def test_without_people_the_ground_of_the_map_is_level():
    rng = np.random.default_rng(0)
    floor = np.column_stack(
        [rng.uniform(-3, 3, 400), rng.normal(0, 0.02, 400), rng.uniform(2, 8, 400)]
    )
    turn = Rotation.from_rotvec(np.radians([8.0, 0, 0]))
    eyes = turn.apply(np.tile([0.0, 1.5, 0.0], (20, 1)))
    nobody = np.zeros((0, 20), bool)
    empty = np.zeros((0, 20, 3)), np.zeros((0, 20, 2, 3)), nobody, eyes
    map_alone = GravityCues(*empty, turn.apply(floor), FPS, np.zeros(0, bool))
    found = find_upright(map_alone)
    np.testing.assert_allclose(found.up, turn.apply([0.0, 1, 0]), atol=0.01)
    assert np.isnan(found.trunks)
    found = find_upright(dataclasses.replace(map_alone, landmarks=NOTHING))
    np.testing.assert_array_equal(found.up, [0.0, 1, 0])
    assert np.isinf(found.sigma)


def test_a_measured_gravity_holds_on_a_hill():
    """Where trunks and the ground disagree, an accelerometer decides."""
    hill = lambda x, z: np.tan(np.radians(12.0)) * z
    feet = walker(way(bend=0.3), floor=hill)
    given = cues(feet, (4.0, 0, 0), fitted=True)
    found = find_upright(
        dataclasses.replace(given, measured_up=np.array([0.0, 1.0, 0.0]))
    )
    assert off(found.up) < 1.5 < off(find_upright(given).up)
    assert found.sigma < np.radians(1.1)
    assert np.degrees(found.ground) > 9.0
    # Alone it is as sure as it is said to be.
    nobody = np.zeros((0, 20), bool)
    empty = np.zeros((0, 20, 3)), np.zeros((0, 20, 2, 3)), nobody, np.zeros((20, 3))
    measured = np.array([0.1, 1.0, 0.0])
    alone = find_upright(GravityCues(*empty, NOTHING, FPS, np.zeros(0, bool), measured))
    np.testing.assert_allclose(alone.up[:2], np.array([0.1, 1.0]) / 1.01**0.5)
    assert alone.sigma == pytest.approx(np.radians(1.0))


def vertical_edges(x, z, sigma=0.5):
    """The vertical by edges, in degrees from y."""
    tilt, covariance = np.radians([x, z]), np.radians(sigma) ** 2 * np.eye(2)
    return Vertical(tilt, covariance, 0.01, 8.0, 20.0, np.ones(8))


def test_walls_tell_a_hill_from_trunks_that_lean():
    """Where the ground slopes, and where nobody walks."""
    hill = lambda x, z: np.tan(np.radians(8.0)) * z
    given = cues(walker(way(bend=0.3), floor=hill), (3.0, 0, 0))
    found = find_upright(given, vertical=vertical_edges(0.0, 0.0))
    assert off(found.up) < 0.7 < off(find_upright(given).up)
    assert np.degrees(found.ground) == pytest.approx(8.0, abs=1.0)
    assert found.sigma < find_upright(given).sigma
    still = cues(np.zeros((1, 90, 2, 3)) + [0.0, 0.0, 4.0], (5.0, 0, 0))
    found = find_upright(still, vertical=vertical_edges(0.0, 0.0))
    assert off(found.up) < 0.7
    assert np.degrees(found.edges) == pytest.approx(off(found.up), abs=0.1)


def test_edges_that_contradict_people_and_ground_are_believed_less():
    given = cues(walker(way()), (0.0, 0, 0), fitted=False)
    found = find_upright(given, vertical=vertical_edges(12.0, 0.0))
    assert off(found.up) < 3.0
    agreeing = find_upright(given, vertical=vertical_edges(0.0, 0.0))
    assert agreeing.sigma < found.sigma
    nobody = np.zeros((0, 30, 2, 3))
    alone = find_upright(cues(nobody, (0.0, 0, 0)), vertical=vertical_edges(2.0, 0.0))
    assert off(alone.up) == pytest.approx(2.0, abs=0.1)
    assert np.isfinite(alone.sigma)


def test_a_level_floor_outweighs_trunks_that_lean_a_little():
    """Over 20 m a slope of 0.3 degrees is 10 cm: floors of buildings have none."""
    rng = np.random.default_rng(0)
    floor = np.column_stack(
        [rng.uniform(-10, 10, 600), rng.normal(0, 0.01, 600), rng.uniform(-10, 10, 600)]
    )
    path = 8.0 * np.column_stack(
        [np.sin(np.linspace(0, 6, 900)), np.cos(np.linspace(0, 6, 900))]
    )
    found = find_upright(cues(walker(path), (1.5, 0, 0), floor, fitted=False))
    assert off(found.up) < 0.2


def test_who_hardly_moves_says_little_of_the_floor_along_the_line_of_sight():
    """Errors of distance move feet along it, upwards as they go away."""
    eye = np.array([0.0, 1.5, 0.0])
    sight = np.array([0.0, -1.5, 4.0])
    jumps = np.array([eye + (1 + s) * sight for s in np.linspace(-0.04, 0.04, 8)])
    jumps[::2, 0] += 0.3
    (walk,) = find_stances(walker(way()), np.ones((1, 240), bool), FPS)

    def along(places, eye):
        plane = feet_plane([places], 0.08, eye)
        assert plane is not None
        return plane.covariance[1, 1] ** 0.5

    slope = np.arctan(1.5 / 4.0)
    assert along(jumps, eye) > 0.5 * slope
    assert along(walk, eye) < 1.2 * along(walk, None)


def test_people_who_are_held_on_one_floor_show_how_it_lies():
    near, far = walker(way(bend=2.0)), walker(way(bend=2.0) + [0.0, 6.0])
    given = cues(np.concatenate([near, far + [0, 0.2, 0]]), (0, 0, 0))
    both = np.array([True, True])
    found, free = (
        find_upright(dataclasses.replace(given, on_floor=held)) for held in (both, None)
    )
    rise = lambda normal: np.degrees(np.arctan(-normal[2] / normal[1]))
    assert rise(found.normal) > 3 * abs(rise(free.normal)), (found, free)
    np.testing.assert_allclose(np.linalg.norm(found.normal), 1.0)
