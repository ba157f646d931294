"""Bodies from keypoints, and the cleaning of regressed ones, on made-up people."""

import copy
import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from bodyslam_jax import people
from bodyslam_jax.body import joints, keypoints, load_body_model, local_keypoints
from bodyslam_jax.body import local_joints as body_joints
from bodyslam_jax.config import Config, PeopleFit
from bodyslam_jax.people import (
    bodies,
    costs,
    frame_fit,
    hypotheses,
    posture_prior,
    skeleton,
    trajectory_fit,
)
from bodyslam_jax.people import fit as fitting
from bodyslam_jax.types import Bodies, Intrinsics, Keypoints, Sequence

FRAMES, FPS = 60, 30.0
CAMERA = Intrinsics(np.array([600.0, 600.0, 319.5, 239.5]), 640, 480)
KNEES = np.r_[9, 12]  # x of the left and of the right knee in θ of joints 1 to 21


@pytest.fixture(scope="module")
def body():
    return load_body_model()


@pytest.fixture(scope="module")
def truth(body):
    """Two people moving as the prior says: one turning from front to back, 4 m away;
    the other seen from the side, walking past at 5 m."""
    rng = np.random.default_rng(3)
    prior = posture_prior.load_posture_prior(FPS)
    heading = np.stack([np.linspace(0.2, 2.9, FRAMES), np.full(FRAMES, 1.4)])
    path = np.zeros((2, FRAMES, 3))
    path[0] = [-0.4, 0.1, 4.0]
    path[1, :, 0], path[1, :, 2] = np.linspace(-0.6, 1.4, FRAMES), 5.0
    poses = np.zeros((2, FRAMES, 72))
    upright = np.diag([1.0, -1.0, -1.0])
    for h in range(2):
        poses[h, :, :3] = logs(upright @ turns([0.0, 1.0, 0.0] * heading[h][:, None]))
        angles = np.asarray(prior.angles(jnp.asarray(_walk(prior, rng))))
        poses[h, :, 3:66] = np.clip(angles, prior.lower, prior.upper)
    shapes = np.zeros((2, FRAMES, 10))
    shapes[1, :, 0] = 0.5
    rest = joints(body, jnp.zeros(72), jnp.asarray(shapes[:, 0]), jnp.zeros(3))
    trans = path - np.asarray(rest)[:, None, 0]
    return Bodies(np.ones((2, FRAMES), bool), poses, shapes, trans)


def turns(angles):
    return np.asarray(jaxlie.SO3.exp(jnp.asarray(angles)).as_matrix())


def logs(rotations):
    return np.asarray(jaxlie.SO3.from_matrix(jnp.asarray(rotations)).log())


def _walk(prior, rng):
    """A sample of the prior's process, `FRAMES` long."""
    a1, a2 = np.asarray(prior.autoregression).T
    lag = a1 / (1 - a2)
    sigma = np.sqrt((1 - lag**2) * (1 - a2**2))
    z = [np.zeros_like(a1), np.zeros_like(a1)]
    for _ in range(FRAMES + 100):
        z.append(a1 * z[-1] + a2 * z[-2] + 0.7 * sigma * rng.normal(size=a1.shape))
    return np.array(z[-FRAMES:])


@pytest.fixture(scope="module")
def seen(body, truth):
    """Keypoints with 2 px of noise, 2 % outliers; the second person has an absence of
    20 frames and a short gap, and no feet and face as in the older detectors."""
    rng = np.random.default_rng(4)
    arguments = (jnp.asarray(a) for a in (truth.poses, truth.shapes, truth.trans))
    p_C = np.asarray(jax.jit(keypoints)(body, *arguments))
    uv = p_C[..., :2] / p_C[..., 2:] * CAMERA.params[:2] + CAMERA.params[2:]
    uv = uv + 2.0 * rng.normal(size=uv.shape)
    uv = np.where(rng.random((*uv.shape[:-1], 1)) < 0.02, uv + 80.0, uv)
    confidence = np.full(uv.shape[:-1], 0.8)
    confidence[1, :, 15:] = confidence[1, :, 0] = 0.0
    confidence[1, 20:40] = confidence[1, 50:53] = 0.0
    return Keypoints(np.where(confidence[..., None] > 0, uv, 0.0), confidence)


@pytest.fixture(scope="module")
def fitted(seen, body):
    return people.fit_bodies(seen, CAMERA, body, FPS)


def joints_in_camera(bodies, body):
    arguments = (jnp.asarray(a) for a in (bodies.poses, bodies.shapes, bodies.trans))
    return np.asarray(jax.jit(joints)(body, *arguments))


def heading_error(found, truth):
    """Angle between orientations, degrees."""
    a, b = (turns(x.poses[..., :3]) for x in (found, truth))
    return np.degrees(np.linalg.norm(logs(np.swapaxes(a, -1, -2) @ b), axis=-1))


def test_fit_finds_posture_and_place(fitted, truth, body):
    found, wanted = (joints_in_camera(b, body)[..., :22, :] for b in (fitted, truth))
    posture = np.linalg.norm(
        found - found[:, :, :1] - wanted + wanted[:, :, :1], axis=-1
    )
    for h in range(2):
        now = fitted.present[h]
        # 2 px are 1.5 cm; depth within the body is several times less certain.
        assert posture[h, now].mean() < 0.06
        depth = found[h, now, 0, 2] / wanted[h, now, 0, 2]
        assert abs(depth.mean() - 1) < 0.06  # stature is not seen
        assert depth.std() < 0.02


def test_fit_knows_front_from_back(fitted, truth):
    error = heading_error(fitted, truth)
    assert np.all(error[fitted.present] < 45)


def test_fit_is_present_where_there_are_keypoints_or_a_short_gap(fitted):
    assert fitted.present[0].all()
    wanted = np.ones(FRAMES, bool)
    wanted[20:40] = False
    np.testing.assert_array_equal(fitted.present[1], wanted)


def test_whom_a_detector_only_guesses_is_absent(seen, body):
    """Somebody who leaves the image: all keypoints go on, with little confidence."""
    confidence = seen.confidence[:1].copy()
    confidence[:, 40:] *= 0.3
    leaving = dataclasses.replace(seen, uv=seen.uv[:1], confidence=confidence)
    found = people.fit_bodies(leaving, CAMERA, body, FPS)
    np.testing.assert_array_equal(found.present[0], np.arange(FRAMES) < 40)
    # The scale of confidences is the detector's.
    unsure = dataclasses.replace(leaving, confidence=0.3 * seen.confidence[:1])
    assert people.fit_bodies(unsure, CAMERA, body, FPS).present[0].all()


def test_fit_has_one_shape_and_no_backward_knees(fitted):
    assert np.ptp(fitted.shapes, axis=1).max() == 0
    assert np.abs(fitted.shapes).max() < 2
    knees = fitted.poses[..., 3:66][..., KNEES]
    assert knees.min() > -0.35  # the limit of the motion data, and a soft margin


def test_fit_without_any_keypoint(body):
    none = Keypoints(np.zeros((1, 8, 25, 2)), np.zeros((1, 8, 25)))
    found = people.fit_bodies(none, CAMERA, body, FPS)
    assert not found.present.any()
    assert np.isfinite(found.poses).all() and np.isfinite(found.trans).all()


@pytest.mark.slow
def test_fit_of_keypoints_that_are_all_in_one_place(body):
    here = np.full((1, 8, 25, 2), 200.0)
    found = people.fit_bodies(Keypoints(here, np.ones((1, 8, 25))), CAMERA, body, FPS)
    assert np.isfinite(found.poses).all() and np.isfinite(found.trans).all()


def test_elbows_bend_one_way():
    prior = posture_prior.load_posture_prior(FPS)
    left, right = 3 * 17 + 1, 3 * 18 + 1  # y of the elbows in θ of joints 1 to 21
    assert prior.lower[left] < -2 and prior.upper[left] < 0.2
    assert prior.upper[right] > 2 and prior.lower[right] > -0.2


def test_the_prior_at_another_rate_is_the_same_process():
    """Correlation over 1/30 s: one step at 30 fps, two steps at 60."""
    at = {
        fps: np.asarray(posture_prior.load_posture_prior(fps).autoregression)
        for fps in (30.0, 60.0)
    }
    first = {fps: a[:, 0] / (1 - a[:, 1]) for fps, a in at.items()}
    second = at[60][:, 0] * first[60] + at[60][:, 1]
    # Sampling an oscillator's own correlation is exact only without zeros: 1 %.
    np.testing.assert_allclose(second, first[30], atol=0.02)
    slow = np.asarray(posture_prior.load_posture_prior(24.0).autoregression)
    assert (np.abs(slow[:, 1]) < 1).all() and (slow[:, 0] < 1 - slow[:, 1]).all()


def random_fit(seed=0):
    rng = np.random.default_rng(seed)
    prior = posture_prior.load_posture_prior(FPS)
    turn = jaxlie.SO3.exp(jnp.asarray([3.0, 0.3, -0.2])).as_matrix()
    latent = jnp.asarray(0.8 * rng.normal(size=prior.basis.shape[1]))
    fit = costs.Fit(turn, jnp.asarray([0.2, -0.1, 4.0]), latent)
    return fit, jnp.asarray(0.5 * rng.normal(size=skeleton.NUM_SHAPE))


def test_the_skeleton_is_the_body(body):
    """Joints exactly; keypoints on the skin within a centimetre of the skinned ones."""
    fit, shape = random_fit()
    shape = shape.at[10:].set(0.0)
    prior = posture_prior.load_posture_prior(FPS)
    bones = skeleton.make_skeleton(body, 1.0)
    found = jax.jit(skeleton.place_points)(bones, prior.angles(fit.latent), shape)
    pose = prior.decode(fit.latent)
    wanted = jax.jit(body_joints)(body, pose, shape[:10])
    np.testing.assert_allclose(found[0], wanted, atol=1e-12)
    skinned = eqx.filter_jit(local_keypoints)(body, pose, shape[:10], bias=1.0)
    np.testing.assert_allclose(found[1], skinned, atol=0.01)
    np.testing.assert_allclose(found[1][1:15], skinned[1:15], atol=1e-12)


@pytest.mark.slow
def test_the_linearisation_is_the_gradient_of_the_cost(body):
    fit, shape = random_fit()
    scene = fitting.make_scene(CAMERA, body, FPS, PeopleFit(limit_sigma=0.2))
    rng = np.random.default_rng(1)
    uv = jnp.asarray(rng.normal([320, 240], 60.0, size=(25, 2)))
    sigma = jnp.full(25, 20.0).at[3].set(jnp.inf)
    fit = dataclasses.replace(fit, latent=3 * fit.latent)  # beyond the limits
    other = jaxlie.SO3.exp(jnp.asarray([-0.4, 0.6, 0.3])).as_matrix() @ fit.orientation
    size = len(fit.latent)
    latent_sigma = jnp.asarray(rng.uniform(0.5, 2.0, size)).at[7].set(jnp.inf)
    lifted = costs.Lifted(
        other, jnp.asarray(rng.normal(size=size)), latent_sigma, jnp.asarray(0.3)
    )

    def moved(step):
        split = 6 + len(fit.latent)
        return costs.cost(
            scene, fit.moved(step[:split]), shape + step[split:], uv, sigma, lifted
        )

    normal = jax.jit(costs.linearise)(scene, fit, shape, uv, sigma, lifted)
    value, wanted = jax.jit(jax.value_and_grad(moved))(
        jnp.zeros(6 + len(fit.latent) + len(shape))
    )
    found = jnp.concatenate([normal.gradient, normal.shape_gradient])
    np.testing.assert_allclose(found, wanted, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(normal.cost, value, rtol=1e-12)
    assert jnp.linalg.eigvalsh(normal.hessian).min() > -1e-6


def test_a_guess_weighs_as_much_as_it_is_sure(body):
    fit, shape = random_fit()
    scene = fitting.make_scene(CAMERA, body, FPS, PeopleFit())
    uv, sigma = jnp.zeros((25, 2)), jnp.full(25, 20.0)
    size = len(fit.latent)
    sure = jnp.linspace(0.5, 2.0, size)
    guess = costs.Lifted(fit.orientation, fit.latent, sure, jnp.asarray(0.3))
    none = guess.widened(jnp.asarray(jnp.inf))
    linearise = jax.jit(costs.linearise)
    found, plain = (linearise(scene, fit, shape, uv, sigma, g) for g in (guess, none))
    wanted = np.concatenate([np.full(3, 0.3**-2), np.zeros(3), np.asarray(sure) ** -2])
    np.testing.assert_allclose(
        found.hessian - plain.hessian, np.diag(wanted), rtol=1e-9, atol=1e-5
    )


def test_a_guess_is_the_start(body):
    """With no steps at all it is placed where the keypoints are."""
    fit, _ = random_fit()
    scene = fitting.make_scene(CAMERA, body, FPS, PeopleFit())
    _, local = jax.jit(skeleton.place_points)(
        scene.skeleton, scene.prior.angles(fit.latent), jnp.zeros(skeleton.NUM_SHAPE)
    )
    p_C = np.asarray(local @ fit.orientation.T + fit.position)
    uv = p_C[:, :2] / p_C[:, 2:] * CAMERA.params[:2] + CAMERA.params[2:]
    sure = (jnp.full_like(fit.latent, 0.5), jnp.asarray(0.3))
    guess = costs.Lifted(fit.orientation, fit.latent, *sure)
    guess = jax.tree.map(lambda a: a[None], guess)
    fits = frame_fit.fit_frames(scene, uv[None], np.full((1, 25), 5.0), guess, steps=0)
    np.testing.assert_allclose(fits.latent[0], fit.latent)
    np.testing.assert_allclose(fits.position[0], fit.position, atol=1e-3)


def test_the_banded_solver_is_a_dense_one():
    rng = np.random.default_rng(0)
    t, n = 6, 4
    root = rng.normal(size=(t, n, 2 * n))
    diagonal = root @ np.swapaxes(root, 1, 2) + 20 * np.eye(n)
    one, two = rng.normal(size=(2, t, n))
    dense = np.zeros((t, n, t, n))
    for k in range(t):
        dense[k, :, k] = diagonal[k]
        for back, off in ((1, one), (2, two)):
            if k >= back:
                dense[k, :, k - back] = np.diag(off[k])
                dense[k - back, :, k] = np.diag(off[k])
    right = rng.normal(size=(t, n, 3))
    wanted = np.linalg.solve(dense.reshape(t * n, t * n), right.reshape(t * n, 3))
    found = jax.jit(trajectory_fit._solve_banded)(
        *map(jnp.asarray, (diagonal, one, two, right))
    )
    np.testing.assert_allclose(found.reshape(t * n, 3), wanted, atol=1e-10)


def test_an_error_is_what_no_motion_explains():
    """Two readings a metre apart; the second is a little cheaper in one frame."""
    places = np.zeros((8, 2, 12, 3))
    places[:, 1] = 1.0
    costs = np.tile([0.0, 4.0], (8, 1))
    costs[2] = [2.0, 0.0]
    time = np.arange(8) / 30
    assert not hypotheses.are_errors(costs, places, time, 0.05).any()
    costs[:4], costs[4:] = [0.0, 200.0], [200.0, 0.0]
    found = hypotheses.are_errors(costs, places, time, 0.05)
    assert found.tolist() == [False] * 4 + [True] * 4
    one = hypotheses.are_errors(costs[-1:], places[-1:], time[:1], 0.05)
    assert one.tolist() == [True]


def test_roots_and_back(truth, body):
    present = truth.present.copy()
    present[0, 5:9] = False
    bodies = dataclasses.replace(truth, present=present)
    roots = people.roots_from_bodies(bodies, body)
    place = joints_in_camera(truth, body)[:, :, 0]
    np.testing.assert_allclose(roots.T_CH[present][:, :3, 3], place[present], atol=1e-9)
    assert (roots.T_CH[0, 5:9] == np.eye(4)).all()
    back = people.bodies_from_roots(roots, body)
    found, wanted = joints_in_camera(back, body), joints_in_camera(truth, body)
    np.testing.assert_allclose(found[present], wanted[present], atol=1e-6)


@pytest.mark.parametrize("with_keypoints", [True, False])
def test_prepared_bodies_are_whole_smooth_and_the_right_way_round(
    truth, seen, body, with_keypoints
):
    rng = np.random.default_rng(5)
    trans, poses = truth.trans.copy(), truth.poses.copy()
    trans[..., 2] *= 1 + 0.02 * rng.normal(size=trans.shape[:2])  # 8-10 cm a frame
    shapes = truth.shapes + 0.2 * rng.normal(size=truth.shapes.shape)
    for k in (10, 30, 31, 32):
        poses[0, k, :3] = logs(turns(poses[0, k, :3]) @ np.diag([-1.0, 1.0, -1.0]))
    present = truth.present.copy()
    present[0, 40:43] = present[1, 10:35] = False
    regressed = Bodies(present, poses, shapes, trans)
    found = people.prepare_bodies(
        regressed, seen if with_keypoints else None, CAMERA, body, FPS
    )
    present[0, 40:43] = True
    np.testing.assert_array_equal(found.present, present)
    assert heading_error(found, truth)[present].max() < 15
    assert np.ptp(found.shapes, axis=1).max() == 0
    place, wanted = (joints_in_camera(b, body)[:, :, 0] for b in (found, truth))
    assert np.diff(place[0, :, 2], 2).std() < 0.01  # was 0.2
    error = np.linalg.norm(place - wanted, axis=-1)[present]
    assert error.mean() < 0.06
    gap = poses[0, 40:43, 3:66] - found.poses[0, 40:43, 3:66]
    assert 0 < np.abs(gap).max() < 0.5  # interpolated


def test_people_without_bodies_are_fitted_to_their_keypoints(
    monkeypatch, truth, seen, body
):
    asked = []
    given = dataclasses.replace(
        truth, present=truth.present & [[True], [False]], poses=0 * truth.poses
    )
    given.poses[0] = truth.poses[0]
    one = lambda name: getattr(truth, name)[1:]
    fitted = Bodies(one("present"), one("poses"), one("shapes"), one("trans"))
    monkeypatch.setattr(
        bodies, "fit_bodies", lambda keypoints, *_: asked.append(keypoints) or fitted
    )
    monkeypatch.setattr(bodies, "prepare_bodies", lambda x, *_: copy.deepcopy(x))
    sequence = Sequence("two", None, np.arange(FRAMES) / FPS, CAMERA, seen, given)
    assert people.without_bodies(sequence).tolist() == [False, True]
    found = people.estimate_bodies(sequence, body)
    (keypoints,) = asked
    np.testing.assert_array_equal(keypoints.uv, seen.uv[1:])
    np.testing.assert_array_equal(found.present, truth.present)
    np.testing.assert_array_equal(found.poses, truth.poses)
    blind = dataclasses.replace(sequence, keypoints=None)
    assert not people.estimate_bodies(blind, body).present[1].any()
    alone = dataclasses.replace(sequence, bodies=None)
    assert people.without_bodies(alone).tolist() == [True, True]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("regressed", "said", "gain"),
    [
        (True, None, 1.2),
        (False, None, 1.0),
        (True, 1.0, 1.0),
        (True, 1.3, 1.3),
        (False, 1.3, 1.3),
    ],
)
def test_a_regressors_shape_is_taken_to_be_drawn_to_the_mean(
    truth, body, regressed, said, gain
):
    settings = PeopleFit() if said is None else PeopleFit(regressor_shape_gain=said)
    given = dataclasses.replace(truth, shapes_regressed=regressed)
    found = people.prepare_bodies(given, None, CAMERA, body, FPS, settings)
    np.testing.assert_allclose(found.shapes, gain * truth.shapes, atol=1e-12)
    assert not found.shapes_regressed  # or it would be multiplied again
    assert Config.paper().people_fit.regressor_shape_gain == 1
