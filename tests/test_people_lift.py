"""Postures guessed from keypoints: what they depend on, and what they are good for."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodyslam_jax import people
from bodyslam_jax.body import load_body_model
from bodyslam_jax.config import PeopleFit
from bodyslam_jax.motion import read_motion
from bodyslam_jax.people import fit, lift, skeleton
from bodyslam_jax.people.filter import PersonFilter
from bodyslam_jax.people.posture_prior import load_posture_prior
from bodyslam_jax.simulation import sensor_noise, sequences
from bodyslam_jax.types import Intrinsics, Keypoints

FPS = 30.0
CAMERA = Intrinsics(np.array([900.0, 900.0, 640.0, 360.0]), 1280, 720)
SIGMA = np.tile(lift.KEYPOINT_SIGMA, (60, 1))
ANKLES = [7, 8]
UNSEEN = PeopleFit(lifter="held-out")
"""With the network that has not learnt from the people here."""


@pytest.fixture(scope="module")
def body():
    return load_body_model()


def read_walk():
    return read_motion(str(sequences.ASSETS / "walking.npz"))[6]


@pytest.fixture(scope="module")
def walk(body):
    """Someone of whom nothing was learnt walks away: joints and keypoints in C, m."""
    return seen_from_behind(read_walk().poses[:60].astype(float), body)


def seen_from_behind(poses, body):
    trans = read_walk().trans[:60].astype(float)
    bones = skeleton.make_skeleton(body, 0.0)
    place = jax.jit(jax.vmap(skeleton.place_points, in_axes=(None, 0, None)))
    angles = jnp.asarray(poses[:, 1:22].reshape(-1, 63))
    local = place(bones, angles, jnp.zeros(skeleton.NUM_SHAPE))
    ahead = trans[-1] - trans[0]
    # C looks along the walk, y down, from 3 m behind.
    z = ahead * [1, 0, 1] / np.linalg.norm(ahead * [1, 0, 1])
    R_CW = np.stack([np.cross(z, [0.0, 1.0, 0.0]), [0.0, -1.0, 0.0], z])
    camera = trans[0] - 3 * z + [0.0, 0.5, 0.0]
    R_CH = R_CW @ Rotation.from_rotvec(poses[:, 0]).as_matrix()
    p_C = (trans - camera) @ R_CW.T
    joints, points = (
        np.einsum("tij,tkj->tki", R_CH, np.asarray(a)) + p_C[:, None] for a in local
    )
    return R_CH, joints, points


def pixels(points, intrinsics):
    return points[..., :2] / points[..., 2:] * intrinsics[:2] + intrinsics[2:]


def predict(uv, sigma, intrinsics=CAMERA.params, fps=FPS):
    arrays = (jnp.asarray(a) for a in (intrinsics, uv, sigma, fps))
    return lift.lift(lift.load_lifter(lift.HELD_OUT_ASSET), *arrays)


def test_a_guess_does_not_depend_on_the_lens_nor_on_where_the_camera_points(walk):
    _, _, points = walk
    plain, _ = predict(pixels(points, CAMERA.params), SIGMA)
    other = np.array([1500.0, 1400.0, 200.0, 500.0])
    zoomed, _ = predict(pixels(points, other), SIGMA, intrinsics=other)
    np.testing.assert_allclose(zoomed.latent, plain.latent, atol=1e-4)

    # Turned about its centre, as a camera held on its side and pointed elsewhere.
    turn = Rotation.from_rotvec([0.3, -0.2, 1.5]).as_matrix()
    turned, _ = predict(pixels(points @ turn.T, CAMERA.params), SIGMA)
    np.testing.assert_allclose(turned.latent, plain.latent, atol=0.05)
    wanted = turn @ np.asarray(plain.orientation)
    np.testing.assert_allclose(turned.orientation, wanted, atol=0.01)


def test_a_guess_does_not_depend_on_how_large_the_person_is_in_the_image(walk):
    _, _, points = walk
    ahead = points - points.mean(axis=(0, 1)) * [1.0, 1.0, 0.0]
    centre = CAMERA.params[2:]
    uv = pixels(ahead, CAMERA.params)
    plain, known = predict(uv, SIGMA)
    smaller, _ = predict(centre + 0.2 * (uv - centre), SIGMA)
    assert np.asarray(known).all()
    np.testing.assert_allclose(smaller.latent, plain.latent, atol=0.03)


def test_a_guess_is_the_same_at_twice_the_rate(walk):
    _, _, points = walk
    uv = pixels(points, CAMERA.params)
    doubled = np.repeat(uv, 2, axis=0)
    found, _ = predict(doubled, np.repeat(SIGMA, 2, axis=0), fps=2 * FPS)
    plain, _ = predict(uv, SIGMA)
    middle = slice(15, 45)  # frames that do not reach beyond the ends
    np.testing.assert_allclose(
        found.latent[::2][middle], plain.latent[middle], atol=1e-4
    )


def test_a_guess_is_close_to_who_was_not_learnt_from(walk, body):
    R_CH, joints, points = walk
    found, _ = predict(pixels(points, CAMERA.params), SIGMA)
    turn = Rotation.from_matrix(np.asarray(found.orientation) @ np.swapaxes(R_CH, 1, 2))
    assert np.degrees(turn.magnitude()).mean() < 12
    bones = skeleton.make_skeleton(body, 0.0)
    angles = load_posture_prior(FPS).angles(found.latent)
    place = jax.vmap(skeleton.place_points, in_axes=(None, 0, None))
    guess, _ = eqx.filter_jit(place)(bones, angles, jnp.zeros(skeleton.NUM_SHAPE))
    guess = np.einsum("tij,tkj->tki", found.orientation, guess)
    error = np.linalg.norm(guess - (joints - joints[:, :1]), axis=-1)
    assert error[:, :22].mean() < 0.05
    # Neither sure beyond reason nor of nothing.
    assert 0.1 < np.median(found.latent_sigma[:, :5]) < 1.0


def test_frames_without_keypoints_have_no_guess_and_spoil_no_other(walk, body):
    _, _, points = walk
    uv, sigma = pixels(points, CAMERA.params), SIGMA.copy()
    uv[20:30], sigma[20:30] = 0.0, np.inf
    sigma[40, 5:] = np.inf
    found, known = predict(uv, sigma)
    missing = [*range(20, 30), 40]
    assert np.flatnonzero(~np.asarray(known)).tolist() == missing
    assert all(np.isfinite(a).all() for a in jax.tree.leaves(found))
    plain, _ = predict(pixels(points, CAMERA.params), SIGMA)
    # Half a second after the last of them they are out of sight.
    np.testing.assert_allclose(found.latent[56:], plain.latent[56:], atol=1e-5)

    scene = fit.make_scene(CAMERA, body, FPS, PeopleFit())
    guess = fit.guess_postures(scene, uv, sigma, FPS, UNSEEN)
    assert np.isinf(guess.latent_sigma[missing]).all()
    assert np.isinf(guess.turn_sigma[missing]).all()
    assert np.isfinite(guess.latent_sigma[56:]).all()
    # One who is never seen.
    guess = fit.guess_postures(scene, 0 * uv, np.full_like(sigma, np.inf), FPS)
    assert np.isinf(guess.turn_sigma).all() and np.isfinite(guess.latent).all()


@pytest.fixture(scope="module")
def seen(walk):
    """With a detector's errors."""
    _, joints, points = walk
    uv, confidence = sensor_noise.detect_keypoints(
        points,
        joints,
        CAMERA.params,
        (CAMERA.width, CAMERA.height),
        sensor_noise.NOISE["real"],
        np.random.default_rng(0),
    )
    return Keypoints(uv[None], confidence[None])


@pytest.mark.slow
def test_a_guess_says_less_the_longer_its_errors_last(seen, body):
    sigma = people.keypoint_sigma(seen, CAMERA, 0)
    guess = predict(seen.uv[0], sigma)[0].latent[:, :5]
    prior = load_posture_prior(FPS)
    decode = np.linalg.pinv(prior.basis)[:5]

    def away(seconds):
        settings = PeopleFit(lifter="held-out", lift_correlation=seconds)
        bodies = people.fit_bodies(seen, CAMERA, body, FPS, settings)
        angles = people.roots_from_bodies(bodies, body).body_pose[0, :, :21]
        latent = (angles.reshape(-1, 63) - np.asarray(prior.mean)) @ decode.T
        return np.abs(latent - guess).mean()

    assert away(0.0) < 0.8 * away(5.0)


@pytest.mark.slow
def test_legs_of_who_walks_away_swing(walk, seen, body):
    """Along the line of sight, where a single image says nothing."""
    _, joints, _ = walk

    def fit(settings):
        bodies = people.fit_bodies(seen, CAMERA, body, FPS, settings)
        roots = people.roots_from_bodies(bodies, body)
        place = jax.vmap(skeleton.place_points, in_axes=(None, 0, None))
        found, _ = eqx.filter_jit(place)(
            skeleton.make_skeleton(body, 0.0),
            jnp.asarray(roots.body_pose[0, :, :21].reshape(-1, 63)),
            jnp.zeros(skeleton.NUM_SHAPE).at[:10].set(roots.shape[0]),
        )
        return np.einsum("tij,tkj->tki", roots.T_CH[0, :, :3, :3], found)

    def swing(joints):
        left, right = (joints[:, j, 2] for j in ANKLES)
        return left - right

    def error(found):
        away = found - (joints - joints[:, :1])
        return np.linalg.norm(away, axis=-1)[:, [4, 5, 7, 8]].mean()  # m

    found = fit(UNSEEN)
    share = swing(found) @ swing(joints) / (swing(joints) @ swing(joints))
    assert 0.9 < share < 1.1
    assert error(found) < 0.055
    assert error(fit(PeopleFit(lifter="held-out", lift_scale=0.0))) > 1.2 * error(found)


def test_in_single_precision(walk):
    _, _, points = walk
    found, _ = predict(pixels(points, CAMERA.params), SIGMA)
    single = [
        jnp.asarray(a, jnp.float32)
        for a in (CAMERA.params, pixels(points, CAMERA.params), SIGMA, FPS)
    ]
    other, _ = lift.lift(lift.load_lifter(lift.HELD_OUT_ASSET), *single)
    assert other.latent.dtype == other.orientation.dtype == jnp.float32
    np.testing.assert_allclose(other.latent, found.latent, atol=1e-3)


def test_knees_are_as_measured_and_not_as_those_of_most_people(body):
    """Somebody who walks with knees bent by 15 degrees more than usual."""
    poses = read_walk().poses[:60].astype(float)
    for joint, turn in ((1, -0.5), (4, 1), (7, -0.5), (2, -0.5), (5, 1), (8, -0.5)):
        poses[:, joint, 0] += np.radians(15.0) * turn
    _, _, points = seen_from_behind(poses, body)
    keypoints = Keypoints(pixels(points, CAMERA.params)[None], np.ones((1, 60, 25)))
    found = people.fit_bodies(keypoints, CAMERA, body, FPS, UNSEEN).poses[0]
    straighter = lambda poses: np.degrees(
        np.linalg.norm(poses.reshape(-1, 24, 3)[:, [4, 5]], axis=-1).min(axis=1).mean()
    )
    # Seen from behind the guess takes 6 degrees of it; a mean of gait would take 10.
    assert abs(straighter(found) - straighter(poses)) < 8.0


@pytest.mark.parametrize("which", ["everybody", "held-out"])
def test_the_setting_chooses_the_network_of_fits_and_of_the_filter(walk, body, which):
    _, _, points = walk
    uv, settings = pixels(points, CAMERA.params), PeopleFit(lifter=which)
    network = lift.load_lifter(lift.ASSETS[which])
    scene = fit.make_scene(CAMERA, body, FPS, settings)
    guess = fit.guess_postures(scene, uv, SIGMA, FPS, settings)
    arrays = (jnp.asarray(a) for a in (CAMERA.params, uv, SIGMA, FPS))
    wanted, _ = lift.lift(network, *arrays)
    np.testing.assert_allclose(guess.latent, wanted.latent, atol=1e-4)
    assert PersonFilter(CAMERA, body, FPS, settings).lifter is network


def test_guesses_of_no_scale_are_trusted_nowhere(walk, body):
    _, _, points = walk
    scene = fit.make_scene(CAMERA, body, FPS, UNSEEN)
    given = scene, pixels(points, CAMERA.params), SIGMA, FPS
    guess = fit.guess_postures(*given, PeopleFit(lifter="held-out", lift_scale=0.0))
    assert np.isinf(guess.latent_sigma).all() and np.isinf(guess.turn_sigma).all()
