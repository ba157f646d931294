"""Which way round people are does not depend on how noisy their measurements are."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodyslam_jax import io, people, simulation
from bodyslam_jax.body import joints, keypoints, load_body_model
from bodyslam_jax.config import Simulation
from bodyslam_jax.types import Bodies, Keypoints, Sequence

FRAMES, FPS = 90, 30.0
HALF_TURN = Rotation.from_rotvec([0.0, np.pi, 0.0])
PAIRS = (
    *((2, 5), (3, 6), (4, 7), (9, 12), (10, 13), (11, 14)),
    *((15, 16), (17, 18), (19, 22), (20, 23), (21, 24)),
)
JITTER, LASTING = 0.022, 0.09
"""rad per axis: regressors' usual changes of errors from frame to frame; and errors."""


@pytest.fixture(scope="module")
def body():
    return load_body_model()


@pytest.fixture(scope="module")
def truth(body) -> Sequence:
    """Somebody who walks before a camera that goes along: no errors."""
    settings = Simulation(
        sequence="E2", family="follow", length=FRAMES, seed=3, noise="none"
    )
    return simulation.as_sequence(simulation.simulate(settings, body))


def turned_by(bodies: Bodies, turn: Rotation) -> Bodies:
    """The same with orientations turned about the body's own axes."""
    poses = bodies.poses.copy()
    poses[0, :, :3] = (Rotation.from_rotvec(poses[0, :, :3]) * turn).as_rotvec()
    return dataclasses.replace(bodies, poses=poses)


def regressed(truth: Sequence, seed: int, jitter: float, lasting: float) -> Bodies:
    """What a regressor makes of it: rotations with white and with lasting errors."""
    rng = np.random.default_rng(seed)
    error = lasting * LASTING * rng.standard_normal((1, 24, 3))
    error = error + jitter * JITTER / np.sqrt(6) * rng.standard_normal((FRAMES, 24, 3))
    poses = Rotation.from_rotvec(truth.bodies.poses.reshape(-1, 3))
    poses = poses * Rotation.from_rotvec(error.reshape(-1, 3))
    return dataclasses.replace(
        truth.bodies, poses=poses.as_rotvec().reshape(1, FRAMES, 72)
    )


def detected(truth: Sequence, seed: int, noise: float, gross: float = 0.0) -> Keypoints:
    """Keypoints with errors of `noise` times 3 px, and some somewhere else."""
    rng = np.random.default_rng(1000 + seed)
    uv = truth.keypoints.uv + 3 * noise * rng.standard_normal((1, FRAMES, 25, 2))
    wrong = rng.random((1, FRAMES, 25, 1)) < gross
    uv = np.where(wrong, uv + 80 * rng.standard_normal(uv.shape), uv)
    there = truth.keypoints.confidence > 0
    return Keypoints(np.where(there[..., None], uv, 0.0), 0.8 * there)


def exchanged(keypoints: Keypoints, frames: np.ndarray) -> Keypoints:
    """Left and right have each other's names in some frames."""
    uv, confidence = keypoints.uv.copy(), keypoints.confidence.copy()
    at = np.asarray(frames)[:, None]
    for i, j in PAIRS:
        uv[0, at, [i, j]] = uv[0, at, [j, i]]
        confidence[0, at, [i, j]] = confidence[0, at, [j, i]]
    return Keypoints(uv, confidence)


def heading_error(found: Bodies, truth: Bodies) -> np.ndarray:
    """Degrees, where the person is found."""
    a, b = (Rotation.from_rotvec(x.poses[0, :, :3]) for x in (found, truth))
    return np.degrees((a.inv() * b).magnitude())[found.present[0]]


def estimated(truth: Sequence, bodies, keypoints, body) -> Bodies:
    if keypoints is not None:
        keypoints, _ = people.correct_left_right(keypoints, FPS)
    sequence = dataclasses.replace(truth, bodies=bodies, keypoints=keypoints)
    found = people.estimate_bodies(sequence, body)
    assert found.present[0].mean() > 0.9  # nobody is lost
    return found


@pytest.mark.slow
@pytest.mark.parametrize("lasting", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("jitter", [0.5, 1.0, 2.0, 4.0, 8.0])
def test_nobody_is_turned_round_by_jitter(truth, body, jitter, lasting):
    for seed in range(4):
        given = regressed(truth, seed, jitter, lasting)
        seen = detected(truth, seed, 1.0)
        error = heading_error(estimated(truth, given, seen, body), truth.bodies)
        assert error.max() < 90
        # No more than the regressor's own: three axes of it.
        usual = np.degrees(np.hypot(lasting * LASTING, jitter * JITTER / np.sqrt(6)))
        assert error.mean() < 2.5 * np.sqrt(3) * usual


@pytest.mark.parametrize("gross", [0.03, 0.2])
@pytest.mark.parametrize("noise", [1.0, 2.0, 4.0])
def test_nobody_is_turned_round_by_noisy_keypoints(truth, body, noise, gross):
    given = regressed(truth, 0, 4.0, 1.0)
    for seed in range(3):
        seen = detected(truth, seed, noise, gross)
        found = estimated(truth, given, seen, body)
        assert heading_error(found, truth.bodies).max() < 90
        arguments = [
            (jnp.asarray(a) for a in (b.poses, b.shapes, b.trans))
            for b in (found, truth.bodies)
        ]
        place, wanted = (np.asarray(jax.jit(joints)(body, *a)) for a in arguments)
        across = (place - wanted)[0, found.present[0], 0, :2]
        assert np.linalg.norm(across, axis=-1).mean() < 0.05 * (1 + noise)


def test_a_burst_of_jitter_turns_nobody_round(truth, body):
    """As where somebody is hidden for a while: 30 degrees an axis, anew each frame."""
    rng = np.random.default_rng(5)
    burst = np.zeros((FRAMES, 3))
    burst[30:42] = 0.5 * rng.standard_normal((12, 3))
    given = turned_by(regressed(truth, 0, 2.0, 1.0), Rotation.from_rotvec(burst))
    error = heading_error(
        estimated(truth, given, detected(truth, 0, 1.0), body), truth.bodies
    )
    calm = np.r_[0:30, 42 : len(error)]
    assert error[calm].max() < 45
    own = np.degrees(np.linalg.norm(burst, axis=1))
    assert np.all(error < own[: len(error)] + 45)


@pytest.mark.slow
@pytest.mark.parametrize(
    "wrong",
    [
        np.arange(30, 60),
        np.arange(60, FRAMES),
        np.flatnonzero(np.random.default_rng(0).random(FRAMES) < 0.33),
        np.arange(FRAMES),
    ],
    ids=["in the middle", "to the end", "here and there", "always"],
)
@pytest.mark.parametrize("jitter", [1.0, 4.0])
def test_a_regressor_that_takes_front_for_back_is_put_right(truth, body, wrong, jitter):
    turn = np.zeros((FRAMES, 3))
    turn[wrong] = HALF_TURN.as_rotvec()
    given = turned_by(regressed(truth, 1, jitter, 1.0), Rotation.from_rotvec(turn))
    seen = detected(truth, 1, 1.0, 0.03)
    found = estimated(truth, given, seen, body)
    assert heading_error(found, truth.bodies).max() < 60
    if len(wrong) < FRAMES / 2:  # then most of the frames tell, without keypoints
        found = estimated(truth, given, None, body)
        assert heading_error(found, truth.bodies).max() < 60


@pytest.mark.slow
@pytest.mark.parametrize(
    "frames",
    [
        np.arange(30, 48),
        np.flatnonzero(np.random.default_rng(1).random(FRAMES) < 0.2),
    ],
    ids=["at a stretch", "here and there"],
)
@pytest.mark.parametrize("with_bodies", [True, False])
def test_names_that_a_detector_exchanges_turn_nobody_round(
    truth, body, frames, with_bodies
):
    seen = exchanged(detected(truth, 2, 1.0), frames)
    given = regressed(truth, 2, 2.0, 1.0) if with_bodies else None
    error = heading_error(estimated(truth, given, seen, body), truth.bodies)
    assert error.max() < 60
    renamed, which = people.correct_left_right(seen, FPS)
    assert which[0, frames].mean() > 0.9
    assert np.delete(which[0], frames, axis=0).mean() < 0.02
    right = frames[which[0, frames].all(axis=1)]
    body_points = np.r_[1:15, 19:25]
    np.testing.assert_array_equal(
        renamed.uv[0, right][:, body_points],
        exchanged(seen, frames).uv[0, right][:, body_points],
    )


def test_who_turns_round_is_left_to_turn(truth, body):
    """By half a turn within 0.4 s, with four times the usual jitter."""
    turn = np.zeros((FRAMES, 3))
    turn[:, 1] = np.pi * np.clip((np.arange(FRAMES) - 40) / 12, 0, 1)
    given = turned_by(regressed(truth, 3, 4.0, 1.0), Rotation.from_rotvec(turn))
    wanted = turned_by(truth.bodies, Rotation.from_rotvec(turn))
    found = estimated(truth, given, None, body)
    assert heading_error(found, wanted).max() < 45
    # Exact keypoints of that motion.
    seen = detected(_seen_of(truth, wanted, body), 3, 1.0)
    found = estimated(truth, given, seen, body)
    assert heading_error(found, wanted).max() < 45
    assert not people.correct_left_right(seen, FPS)[1].any()


def _seen_of(truth: Sequence, bodies: Bodies, body) -> Sequence:

    arrays = (jnp.asarray(a) for a in (bodies.poses, bodies.shapes, bodies.trans))
    p_C = np.asarray(jax.jit(keypoints)(body, *arrays))
    camera = truth.intrinsics.params
    uv = p_C[..., :2] / p_C[..., 2:] * camera[:2] + camera[2:]
    return dataclasses.replace(truth, keypoints=Keypoints(uv, np.ones(uv.shape[:-1])))


def test_a_single_frame_and_none_that_changes(truth, body):
    one = truth.bodies.present.copy()
    one[0, 1:] = False
    given = dataclasses.replace(truth.bodies, present=one)
    sequence = dataclasses.replace(truth, bodies=given)
    assert people.estimate_bodies(sequence, body).present.sum() == 1


@pytest.mark.slow
def test_of_forty_jittery_sequences_nobody_is_turned_round(body):
    """As `simulate` makes them, every other four with 3.6 times the usual jitter, 68
    m/s^2."""
    kinds = (("E2", "follow"), ("M1", "follow"), ("M2", "room"), ("D1", "room"))
    for seed in range(40):
        name, family = kinds[seed % 4]
        jitter = 3.6 if seed // 4 % 2 else 1.0
        settings = Simulation(
            sequence=name, family=family, length=90, seed=seed, body_jitter=jitter
        )
        made = simulation.simulate(settings, body)
        found = people.estimate_bodies(simulation.as_sequence(made), body)
        R_CW = np.swapaxes(made.T_WC[:, :3, :3], 1, 2)
        true = Rotation.from_matrix(R_CW) * Rotation.from_rotvec(made.poses[:, :3])
        poses = np.zeros((1, 90, 72))
        poses[0, :, :3] = true.as_rotvec()
        wanted = dataclasses.replace(found, poses=poses)
        assert np.mean(heading_error(found, wanted) > 90) < 0.02


@pytest.mark.slow
def test_a_detectors_own_idea_of_hips_and_knees_is_found(truth, body):
    """Hips 4 cm lower and knees 6 cm: MediaPipe's, on a man seen by four cameras."""
    arrays = (truth.bodies.poses, truth.bodies.shapes, truth.bodies.trans)
    place = np.asarray(jax.jit(joints)(body, *map(jnp.asarray, arrays)))[0]
    unit = lambda v: v / np.linalg.norm(v, axis=-1, keepdims=True)
    trunk = unit(place[:, 0] - place[:, 12])
    moved = {
        9: place[:, 2] + 0.04 * trunk,
        12: place[:, 1] + 0.04 * trunk,
        10: place[:, 5] + 0.06 * unit(place[:, 5] - place[:, 2]),
        13: place[:, 4] + 0.06 * unit(place[:, 4] - place[:, 1]),
    }
    camera = truth.intrinsics.params
    pixels = lambda p: p[..., :2] / p[..., 2:] * camera[:2] + camera[2:]
    uv = truth.keypoints.uv.copy()
    for point, p in moved.items():
        uv[0, :, point] = pixels(p)
    there = truth.keypoints.confidence > 0
    seen = Keypoints(np.where(there[..., None], uv, 0.0), 1.0 * there)
    found = estimated(truth, None, seen, body)
    roots = people.roots_from_bodies(found, body)
    arguments = (roots, np.array([True]), truth.intrinsics, body, FPS)
    corrected = people.as_body_keypoints(seen, *arguments)
    points = list(moved)
    away = lambda k: np.median(
        np.linalg.norm((k.uv - truth.keypoints.uv)[0][:, points], axis=-1)[
            there[0][:, points]
        ]
    )
    assert away(corrected) < 0.6 * away(seen)
    nobody = (roots, np.array([False]), truth.intrinsics, body, FPS)
    np.testing.assert_array_equal(people.as_body_keypoints(seen, *nobody).uv, seen.uv)


def test_who_is_named_left_for_right_is_the_same_person(truth):
    """Seen from so near that shoulders and hips are far apart in the image."""
    seen = detected(truth, 0, 1.0)
    k = int(np.flatnonzero((seen.confidence[0] > 0).all(axis=1))[0])
    one = np.concatenate([seen.uv[0, k], seen.confidence[0, k, :, None]], axis=-1)
    middle = one[8, :2]
    one[:, 0] = middle[0] + 3 * (one[:, 0] - middle[0])  # facing, arms spread
    other = one.copy()
    for i, j in PAIRS:
        other[[i, j]] = other[[j, i]]
    frames = [(other if k % 5 == 4 else one)[None] for k in range(40)]
    sequence = dataclasses.replace(truth, keypoints=None, bodies=None)
    found = io.with_detections(
        dataclasses.replace(sequence, timestamps=np.arange(40) / FPS), frames
    )
    assert found.keypoints.uv.shape[0] == 1
    assert (found.keypoints.confidence[0] > 0).any(axis=1).all()


def test_legs_exchanged_from_one_crossing_to_the_next_are_found():
    """Of a walker seen from the side: where legs cross, the vector from left to right
    is near zero, so that exchanged labels show in its velocity only."""
    legs = ((10, 13), (11, 14), (22, 19), (24, 21))  # knees, ankles, toes, heels
    frame = np.arange(60)
    swing = 60.0 * np.sin(2 * np.pi * frame / 30)
    rng = np.random.default_rng(0)
    uv = np.tile([300.0, 200.0], (1, 60, 25, 1))
    for depth, (right, left) in enumerate(legs, start=1):
        uv[0, :, right] += np.column_stack(
            [swing * depth / 2, 60.0 * depth + 0 * swing]
        )
        uv[0, :, left] += np.column_stack(
            [-swing * depth / 2, 60.0 * depth + 0 * swing]
        )
    uv[0, :, 0, 1] -= 120.0
    uv += 1.5 * rng.standard_normal(uv.shape)
    confidence = np.zeros((1, 60, 25))
    confidence[0][:, [0, *np.ravel(legs)]] = 1.0
    seen = Keypoints(uv, confidence)
    between = (frame >= 15) & (frame < 30)
    _, none = people.correct_left_right(seen, 30.0)
    assert not none.any()
    wrong = uv.copy()
    for right, left in legs:
        wrong[:, between, right] = uv[:, between, left]
        wrong[:, between, left] = uv[:, between, right]
    found, renamed = people.correct_left_right(Keypoints(wrong, confidence), 30.0)
    # In the frames of a crossing either label explains the same pixels.
    crossing = np.abs(swing) < 15.0
    assert (renamed[0, :, 1] == between)[~crossing].all()
    assert not renamed[0, :, 0].any()
    apart = np.abs(found.uv - uv)[0][~crossing][:, np.ravel(legs)]
    assert apart.max() == 0.0
