"""What can be true is not doubted; what cannot is, and for the right reason."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import bodyslam_jax as bs
from bodyslam_jax import simulation
from bodyslam_jax.body.skeleton import HIPS
from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.diagnostics import figures, moments, standing_height
from bodyslam_jax.diagnostics.checks import (
    Reason,
    judge,
    status_of,
)
from bodyslam_jax.diagnostics.thresholds import (
    MEASURABLE_CHECKS,
    PERSON_CHECKS,
    WORLD_CHECKS,
)
from bodyslam_jax.types import Result

FPS = 30.0


@pytest.fixture(scope="module")
def truth():
    """Somebody who really walked, and a camera that goes along."""
    return simulation.as_truth(
        simulation.simulate(
            Simulation(sequence="M1", family="follow", length=120, seed=5, noise="none")
        )
    )


@pytest.fixture
def walk(truth):
    return truth.joints[0].copy()


def doubts(joints, present=None, fps=FPS):
    """Names of what is doubted of one person."""
    if present is None:
        present = np.ones(len(joints), bool)
    found = judge(PERSON_CHECKS, figures.person_figures(joints, present, fps), 0)
    return {reason.name for reason in found}


def test_who_really_walked_is_believed(truth, walk):
    assert doubts(walk) == set()
    assert doubts(walk[::2], fps=15.0) == set()
    # Also with a centimetre of noise that lasts, and in any place.
    rng = np.random.default_rng(0)
    slow = np.repeat(rng.normal(0, 0.01, (24, 1, 3)), 5, axis=0)
    assert doubts(walk + slow + [3.0, 0.0, -2.0]) == set()
    camera = figures.camera_figures(truth.T_WC, FPS)
    assert judge(WORLD_CHECKS, camera) == []


def test_frames_in_which_somebody_is_absent_are_no_jump(walk):
    present = np.ones(len(walk), bool)
    present[40:70] = False
    walk[40:70] = 0.0
    walk[70:] += [2.0, 0.0, 0.0]
    assert doubts(walk, present) == set()
    assert doubts(walk, np.zeros(len(walk), bool)) == set()
    present[:] = False
    present[:5] = True
    assert doubts(walk, present) == set()


def test_feet_that_slide_are_doubted(walk):
    drift = np.arange(len(walk))[:, None, None] / FPS * [0.6, 0.0, 0.0]
    assert "standing_foot_speed" in doubts(walk + drift)
    slow = drift / 6
    assert doubts(walk + slow) == set()


def test_steps_on_the_spot_are_doubted(walk):
    """As on a treadmill: the middle of the path is taken away."""
    time = np.arange(len(walk)) / FPS
    gone = np.array([np.polyval(np.polyfit(time, x, 1), time) for x in walk[:, 0].T]).T
    still = walk - (gone - gone[0])[:, None] * [1.0, 0.0, 1.0]
    names = doubts(still)
    assert "step_short_of_reach" in names and "gliding" not in names
    # A scale that is far too small looks alike.
    small = walk - 0.6 * (gone - gone[0])[:, None] * [1.0, 0.0, 1.0]
    assert "step_short_of_reach" in doubts(small)


def test_people_who_are_carried_are_doubted(walk):
    """A moving walkway, which makes the walker as fast as a runner; and somebody who
    rolls along without a step."""
    time = np.arange(len(walk)) / FPS
    way = (walk[-1, 0] - walk[0, 0]) * [1.0, 0.0, 1.0]
    way /= np.linalg.norm(way)
    onward = walk + time[:, None, None] * 1.0 * way
    assert "step_beyond_reach" in doubts(onward)
    rolling = np.repeat(walk[:1], len(walk), axis=0) + 3.0 * time[:, None, None] * way
    assert doubts(rolling) == {"gliding"}
    slowly = np.repeat(walk[:1], len(walk), axis=0) + 1.2 * time[:, None, None] * way
    assert {"gliding", "standing_foot_speed"} <= doubts(slowly)


def test_a_child_taken_for_an_adult_is_doubted_where_steps_are_quick(walk):
    """All lengths are too large by the same factor: only time tells."""
    child = walk * 1.1 / 1.7
    quick = np.sqrt(1.7 / 1.1) * 1.25
    assert "quick_steps" in doubts(child * 1.7 / 1.1, fps=FPS * quick)
    assert doubts(walk) == set()


def test_a_constant_rotation_from_the_given_body_is_doubted():
    rng = np.random.default_rng(0)
    given = Rotation.random(40, rng=rng)
    noise = Rotation.from_rotvec(rng.normal(0, 0.15, (40, 3)))

    def doubted(degrees):
        turn = Rotation.from_rotvec([np.radians(degrees), 0.0, 0.0])
        found = (given * noise * turn).as_matrix()
        figure = figures.turned_from_body(found, given.as_rotvec())
        return figure, judge(PERSON_CHECKS, {"turned_from_body": figure}) != []

    assert doubted(5.0) == (pytest.approx(5.0, abs=3.0), False)
    assert doubted(20.0) == (pytest.approx(20.0, abs=3.0), True)
    # Front and back are no matter of degrees.
    assert not doubted(175.0)[1]
    few = figures.turned_from_body(given.as_matrix()[:5], given.as_rotvec()[:5])
    assert np.isnan(few)


def test_up_is_compared_with_the_top_of_the_image(truth):
    assert figures.up_in_image(truth.T_WC) < 30
    for angle, axis in ((90.0, 2), (90.0, 0), (180.0, 2)):
        turn = Rotation.from_rotvec(np.radians(angle) * np.eye(3)[axis]).as_matrix()
        turned = truth.T_WC.copy()
        turned[:, :3, :3] = turned[:, :3, :3] @ turn
        of_person = {"up_in_image": figures.up_in_image(turned)}
        assert [r.name for r in judge(WORLD_CHECKS, of_person)] == ["up_in_image"]


def test_walkers_who_lean_further_than_their_feet_reach_are_doubted(walk):
    def names(joints, walking):
        lean = figures.lean_of_walkers(joints, walking)
        return [r.name for r in judge(WORLD_CHECKS, {"lean_of_walkers": lean})]

    def leaning(degrees):
        turn = Rotation.from_euler("x", degrees, degrees=True).as_matrix()
        return walk @ turn.T

    everywhere = np.ones((2, len(walk)), bool)
    both = np.stack([walk, walk])
    assert figures.lean_of_walkers(both, everywhere) < 3
    assert names(both, everywhere) == []
    assert names(np.stack([leaning(12), leaning(12)]), everywhere) == [
        "lean_of_walkers"
    ]
    # One to each side: neither is up wrong nor do all bodies lean.
    assert names(np.stack([leaning(9), leaning(-9)]), everywhere) == []
    # Who crouches may have a seat; nobody who walks, nobody to judge.
    low = walk.copy()
    low[:, HIPS] -= [0.0, 0.4, 0.0]
    assert np.isnan(figures.lean_of_walkers(low[None], everywhere[:1]))
    assert np.isnan(figures.lean_of_walkers(both, ~everywhere))


@pytest.mark.slow
def test_a_run_is_doubted_for_walkers_who_lean_against_a_wrong_gravity():
    made = simulation.simulate(
        Simulation(sequence="M1", family="follow", length=60, noise="low")
    )
    turn = Rotation.from_euler("z", 14, degrees=True).as_matrix()
    down = turn @ made.T_WC[0, :3, :3].T @ [0.0, -1.0, 0.0]
    config = Config(gravity=tuple(map(float, down)))
    result = bs.run(simulation.as_sequence(made), config)
    assert result.summary["status"] == "doubtful"
    assert "lean_of_walkers" in [r["name"] for r in result.summary["reasons"]]


def test_people_who_float_or_sink_are_doubted(walk):
    along = walk[:, :1] - walk[:1, :1]
    gone = np.linalg.norm(along, axis=-1, keepdims=True)
    rising = walk + gone * [0.0, np.tan(np.radians(8.0)), 0.0]
    assert "ground_slope" in doubts(rising)
    swaying = walk.copy()
    time = np.arange(len(walk))[:, None] / FPS
    swaying[..., 1] += 0.12 * np.sin(2 * np.pi * time / 3.0)
    assert "feet_off_ground" in doubts(swaying)


def _with_floor(walk, height):
    """The figures of standing feet over landmarks of a floor, of somebody who walks on
    it or not."""
    low, high = walk[..., 0].min() - 3, walk[..., 0].max() + 3
    far = walk[..., 2].max() + 3
    rng = np.random.default_rng(0)
    at = rng.uniform([low, walk[..., 2].min() - 3], [high, far], (20_000, 2))
    t = len(walk)
    T_WC = np.tile(np.eye(4), (t, 1, 1))
    T_WC[:, :3, 3] = walk[:, 0] * [1, 0, 1] + [0.0, 2.2, -2.5]
    present = np.ones(t, bool)
    made = Result(
        timestamps=np.arange(t) / FPS,
        T_WC=T_WC,
        scale=1.0,
        intrinsics=np.array([500.0, 500.0, 320.0, 240.0]),
        landmarks=np.column_stack([at[:, 0], height(at), at[:, 1]]),
        poses=np.zeros((1, t, 72)),
        trans=np.zeros((1, t, 3)),
        betas=np.zeros((1, 10)),
        joints=walk[None],
        present=present[None],
    )
    ground = standing_height.ground_heights(made, 0, present)
    found = standing_height.standing_height_figures(walk, present, FPS, ground)
    return {reason.name for reason in judge(PERSON_CHECKS, found)}


def test_people_on_uneven_ground_are_not_doubted_and_those_who_float_are(walk):
    """Ground that rises and sinks by 24 cm, of which the map has landmarks; then the
    same walk over a level floor."""
    waves = lambda at: 0.12 * np.sin(2 * np.pi * at[..., 0] / 3.0)
    level = lambda at: np.zeros(at.shape[:-1])
    turned = walk if np.ptp(walk[:, 0, 0]) > 2 else walk[..., [2, 1, 0]]
    over = turned.copy()
    feet = turned[:, [10, 11]]
    lower = feet[np.arange(len(feet)), feet[..., 1].argmin(axis=1)]
    over[..., 1] += waves(lower[:, [0, 2]])[:, None]
    assert _with_floor(over, waves) == set()
    assert "feet_off_ground" in _with_floor(over, level)


def test_people_who_crouch_are_doubted(walk):
    """Thighs turned forward and shins back, so that knees bend by 30 degrees more."""
    crouched = walk.copy()
    side = walk[:, 1] - walk[:, 2]
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    bend = np.radians(30.0)
    for hip, knee, ankle, foot in ((1, 4, 7, 10), (2, 5, 8, 11)):
        up = Rotation.from_rotvec(-bend * side)
        down = Rotation.from_rotvec(bend * side / 2)
        crouched[:, knee] = walk[:, hip] + up.apply(walk[:, knee] - walk[:, hip])
        crouched[:, ankle] = crouched[:, knee] + down.apply(
            walk[:, ankle] - walk[:, knee]
        )
        crouched[:, foot] = crouched[:, ankle] + walk[:, foot] - walk[:, ankle]
    assert {"knee", "straighter_knee"} <= doubts(crouched)
    leaning = Rotation.from_rotvec([np.radians(25.0), 0, 0])
    bowed = walk.copy()
    for joint in (3, 6, 9, *range(12, 24)):
        bowed[:, joint] = walk[:, 0] + leaning.apply(walk[:, joint] - walk[:, 0])
    assert "trunk_lean" in doubts(bowed)


def test_a_sudden_change_of_identity_is_doubted(walk):
    other = walk.copy()
    half = len(walk) // 2
    about = walk[half, 0]
    turn = Rotation.from_rotvec([0.0, np.pi * 0.9, 0.0])
    there = (walk[half:] - about).reshape(-1, 3)
    other[half:] = about + turn.apply(there).reshape(-1, 24, 3)
    assert "turn_of_walker" in doubts(other)
    jumping = walk.copy()
    jumping[half:] += [0.8, 0.0, 0.0]
    assert "velocity_jump_of_walker" in doubts(jumping)
    trembling = walk + np.random.default_rng(0).normal(0, 0.02, walk.shape)
    assert "joint_acceleration" in doubts(trembling)


def test_impossible_speeds_and_statures_are_doubted(walk):
    assert "speed" in doubts(walk * 8.0)
    for stature, names in ((1.7, set()), (2.4, {"stature"}), (0.8, {"short_stature"})):
        of_person = {"stature": stature, "short_stature": stature}
        assert {r.name for r in judge(PERSON_CHECKS, of_person)} == names


def test_a_camera_that_moves_as_no_hand_does_is_doubted(truth):
    jumped = truth.T_WC.copy()
    jumped[60:, 0, 3] += 1.0
    names = {r.name for r in judge(WORLD_CHECKS, figures.camera_figures(jumped, FPS))}
    assert "camera_acceleration" in names
    turned = truth.T_WC.copy()
    turn = Rotation.from_rotvec([0.0, 2.0, 0.0]).as_matrix()
    turned[60:, :3, :3] = turned[60:, :3, :3] @ turn
    names = {r.name for r in judge(WORLD_CHECKS, figures.camera_figures(turned, FPS))}
    assert names == {"camera_turning"}
    assert figures.camera_figures(truth.T_WC[:3], FPS) == {}


def test_people_on_different_floors_are_doubted(walk):
    present = np.ones((2, len(walk)), bool)
    apart = figures.floors_apart(np.stack([walk, walk + [0, 0.5, 0]]), present, FPS)
    assert apart == pytest.approx(0.5, abs=1e-9)
    assert np.isnan(figures.floors_apart(walk[None], present[:1], FPS))


def test_keypoints_that_are_another_persons_are_doubted():
    rng = np.random.default_rng(0)
    error = np.abs(rng.normal(0, 3.0, (60, 25)))
    size = np.full(60, 200.0)
    error[rng.random(error.shape) < 0.1] = 150.0
    error[rng.random(error.shape) < 0.2] = np.nan
    doubted = lambda error: judge(
        PERSON_CHECKS, {"keypoint_misfit": figures.worst_misfit(error, size, FPS)[0]}
    )
    assert doubted(error) == []
    assert doubted(4 * error) == []  # noise, however large
    error[20:24] = 30.0  # too short
    assert doubted(error) == []
    error[30:45] = 30.0
    assert figures.worst_misfit(error, size, FPS)[0] == pytest.approx(15.0)
    assert len(doubted(error)) == 1
    error[:] = np.nan
    assert np.isnan(figures.worst_misfit(error, size, FPS)[0])


def test_a_reason_says_where_to_look(truth):
    joints, present = truth.joints[0].copy(), truth.present[0]
    joints[60:] = joints[60:] + np.array([1.5, 0.0, 0.0])
    hidden = np.zeros(len(joints), bool)
    hidden[20:30] = True
    found = moments.of_person(joints, present, hidden, FPS)
    first, last = found["velocity_jump"]
    assert first < 60 <= last and last - first <= 12
    assert found["legs_inferred"] == (20, 29)
    T_WC = truth.T_WC.copy()
    T_WC[80:, :3, 3] += [3.0, 0.0, 0.0]
    within = np.ones(len(T_WC), bool)
    within[:5] = False
    for first, last in moments.of_camera(T_WC, within, FPS).values():
        assert 5 <= first < last < len(T_WC)
    first, last = moments.of_camera(T_WC, within, FPS)["camera_speed"]
    assert first < 80 <= last
    (reason,) = judge(
        PERSON_CHECKS,
        {"velocity_jump": 9.0},
        0,
        moments=found,
        times=truth.timestamps + 7.0,
    )
    where = f"frames {found['velocity_jump'][0]} to {found['velocity_jump'][1]}, 1."
    assert where in reason.message
    assert reason.to_dict()["frames"] == found["velocity_jump"]
    assert reason.to_dict()["seconds"][0] == pytest.approx(
        found["velocity_jump"][0] / FPS, abs=0.01
    )


def test_advice_never_drops_everybody():
    for check in (*PERSON_CHECKS, *MEASURABLE_CHECKS, *WORLD_CHECKS):
        assert "--no-people" not in check.advice
        assert "look at both" not in check.advice


def test_a_reason_says_what_is_expected_and_what_to_do():
    (reason,) = judge(PERSON_CHECKS, {"standing_foot_speed": 0.62}, 1)
    assert judge(WORLD_CHECKS, {"slope_of_ground": np.degrees(np.array(0.01))}) == []
    assert "person 1" in reason.message and "0.62 m/s" in reason.message
    assert reason.expected == "at most 0.4 m/s" and reason.advice
    written = reason.to_dict()
    assert written["figure"] == 0.62 and written["person"] == 1
    assert written["status"] == "doubtful"
    fatal = Reason("x", "nothing is found.", "something", "look", fatal=True)
    assert fatal.to_dict()["status"] == "failed" and "figure" not in fatal.to_dict()
    assert status_of([]) == "ok"
    assert status_of([reason]) == "doubtful"
    assert status_of([reason, fatal]) == "failed"


def test_every_check_has_a_name_of_its_own_and_says_where_it_is_from():
    checks = (*PERSON_CHECKS, *WORLD_CHECKS)
    assert len({check.name for check in checks}) == len(checks)
    for check in checks:
        assert check.source and check.advice and not check.advice.endswith(".")
        assert not check.fails(np.nan) and not check.fails(check.limit)
