"""Claims of people's places in W: they follow what moves a place, and only that."""

import dataclasses

import numpy as np
import pytest

from bodyslam_jax.body.skeleton import FEET, PELVIS
from bodyslam_jax.diagnostics.place_uncertainty import place_uncertainty
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.types import JointEstimate, Result, ScaleStart

T, EYE = 60, np.array([0.0, 1.5, 0.0])
PEOPLE = ("poses", "trans", "betas", "joints", "present")
UNTIL = 50  # frames with the person; absent after


def walk(distance=4.0, side=0.5):
    """A person who walks away from a level camera that does not move, on y = 0; feet
    stand, both, over the whole path."""
    level = np.diag([-1.0, -1.0, 1.0, 1.0])
    level[:3, 3] = EYE
    joints = np.zeros((1, T, 24, 3))
    joints[..., 0] = side
    joints[..., 2] = distance + 0.03 * np.arange(T)[:, None]
    joints[..., PELVIS, 1] = 0.9
    # Feet step: each stands for ten frames.
    for foot, k in zip(FEET, (0, 10), strict=True):
        joints[0, :, foot, 2] = distance + 0.03 * ((np.arange(T) + k) // 20 * 20)
    result = Result(
        timestamps=np.arange(T) / 30,
        T_WC=np.tile(level, (T, 1, 1)),
        scale=2.0,
        intrinsics=np.ones(4),
        landmarks=np.zeros((0, 3)),
        poses=np.zeros((1, T, 72)),
        trans=np.zeros((1, T, 3)),
        betas=np.zeros((1, 10)),
        joints=joints,
        present=np.arange(T)[None] < UNTIL,
    )
    joint = JointEstimate(
        scale=2.0,
        start=ScaleStart(),
        scale_sigma=0.1,
        shape_covariance=np.zeros((1, 10, 10)),
        unobserved=(),
        cameras=np.tile(np.eye(4), (T, 1, 1)),
        roots=np.tile(np.eye(4), (1, T, 1, 1)),
        poses=np.zeros((1, T, 23, 3)),
        shapes=np.zeros((1, 10)),
        landmarks=np.zeros((0, 3)),
        intrinsics=np.ones(4),
        present=result.present,
        status="converged",
        stages=(),
        root_covariance=np.zeros((1, T, 3, 3)),
    )
    return joint, result


def claimed(joint, result, *, size=0.0, joints=0.0, scale_sigma=0.1, up=0.0, focal=0.0):
    sigma = np.full((len(result.present), T, 24), joints)
    sizes = np.full(len(result.present), size)
    return place_uncertainty(
        joint,
        result,
        sigma,
        sizes,
        scale_sigma=scale_sigma,
        up_sigma=up,
        focal_sigma=focal,
    )


def spread(matrix):
    """The joint with this covariance of the pelvis in all frames."""
    return np.tile(matrix, (1, T, 1, 1))


def test_a_place_is_claimed_in_metres_and_zero_where_nobody_is():
    joint, result = walk()
    joint = dataclasses.replace(joint, root_covariance=spread(np.diag([4, 9, 16.0])))
    found = claimed(joint, result, size=0.05)
    assert found.root_sigma.shape == (1, T, 3)
    # The graph's world is the first camera: its x is to the right, W's to the left.
    np.testing.assert_allclose(found.root_sigma[0, :UNTIL, [0, 2]].T, [[2, 4]] * UNTIL)
    np.testing.assert_allclose(found.root_sigma[0, :UNTIL, 1], 0.05 * 0.9)
    assert (found.root_sigma[0, UNTIL:] == 0).all()
    assert found.camera_height == pytest.approx(0.1 / 2.0 * 1.5)
    # A camera that does not move has its metres from the people.
    still = claimed(joint, result, size=0.08, scale_sigma=0.0)
    assert still.camera_height == pytest.approx(0.08 * 1.5)


def test_the_claim_is_the_same_whatever_world_the_graph_has():
    joint, result = walk()
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    joint = dataclasses.replace(joint, root_covariance=spread(root @ root.T))
    expected = claimed(joint, result, up=0.03, size=0.04, joints=0.02)
    turn = np.eye(4)
    turn[:3, :3] = so3.exp(rng.normal(size=3))
    R = turn[:3, :3]
    other = dataclasses.replace(
        joint,
        cameras=turn @ joint.cameras,
        root_covariance=R @ joint.root_covariance @ R.T,
    )
    found = claimed(other, result, up=0.03, size=0.04, joints=0.02)
    np.testing.assert_allclose(found.root_sigma, expected.root_sigma, rtol=1e-9)
    # If W itself is turned about y by a right angle, x and z change places.
    right = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    T_WC = result.T_WC.copy()
    T_WC[:, :3] = right @ T_WC[:, :3]
    turned = dataclasses.replace(result, T_WC=T_WC, joints=result.joints @ right.T)
    found = claimed(joint, turned, up=0.03, size=0.04, joints=0.02)
    np.testing.assert_allclose(
        found.root_sigma, expected.root_sigma[..., [2, 1, 0]], rtol=1e-9
    )


def test_what_scale_and_focal_length_leave_open_grows_with_the_distance():
    near, far = (claimed(*walk(d), scale_sigma=0.2, focal=0.1) for d in (3.0, 30.0))
    assert (near.root_sigma[0, :UNTIL, 2] < far.root_sigma[0, :UNTIL, 2]).all()
    joint, result = walk(4.0)
    depth = result.joints[0, :UNTIL, PELVIS, 2]
    # Half of a contradiction of cues: σ² - σ_covariance² of the scale, all depths.
    found = claimed(joint, result, scale_sigma=np.hypot(0.1, 0.2))
    np.testing.assert_allclose(found.root_sigma[0, :UNTIL, 2], 0.1 * depth)
    np.testing.assert_allclose(found.root_sigma[0, :UNTIL, 0], 0.1 * 0.5)
    # The focal length: along the view only.
    found = claimed(joint, result, focal=0.1)
    np.testing.assert_allclose(found.root_sigma[0, :UNTIL, 2], 0.1 * depth)
    np.testing.assert_allclose(found.root_sigma[0, :UNTIL, 0], 0.0, atol=1e-12)


def test_the_claim_for_up_is_the_scatter_of_worlds_with_other_up():
    joint, result = walk(4.0, side=1.0)
    sigma, rng = 0.02, np.random.default_rng(1)
    places, eyes = [], []
    for tilt in sigma * rng.normal(size=(4000, 2)):
        R = so3.exp(np.array([tilt[0], 0.0, tilt[1]]))
        pelvis = (result.joints[0, :UNTIL, PELVIS] - EYE) @ R.T + EYE
        feet = (result.joints[0, :UNTIL, list(FEET)] - EYE) @ R.T + EYE
        floor = np.median(feet[..., 1])
        pelvis[:, 1] -= floor
        places.append(pelvis)
        eyes.append(EYE[1] - floor)
    found = claimed(joint, result, scale_sigma=0.0, up=sigma)
    expected = np.std(places, axis=0)
    got = found.root_sigma[0, :UNTIL]
    np.testing.assert_allclose(got[:, [0, 2]], expected[:, [0, 2]], rtol=0.05)
    # Where the person is among the stances, the floor there is the floor's height.
    np.testing.assert_allclose(got[:, 1], expected[:, 1], rtol=0.2, atol=0.004)
    assert got[0, 1] > 2 * got[UNTIL // 2, 1]
    assert found.camera_height == pytest.approx(np.std(eyes), rel=0.1)


@pytest.mark.parametrize("what", ["covariance", "scale", "up"])
def test_nothing_is_claimed_where_scale_up_or_covariance_are_unknown(what):
    joint, result = walk()
    given = {}
    if what == "covariance":
        joint = dataclasses.replace(joint, root_covariance=None)
    elif what == "scale":
        given = {"scale_sigma": np.inf}
    else:
        given = {"up": np.inf}
    assert claimed(joint, result, **given) is None


def test_of_nobody_nothing_is_claimed_and_nothing_fails():
    joint, result = walk()
    nobody = {name: getattr(result, name)[:0] for name in PEOPLE}
    result = dataclasses.replace(result, **nobody)
    names = ("roots", "poses", "shapes", "present", "root_covariance")
    nobody = {name: getattr(joint, name)[:0] for name in names}
    joint = dataclasses.replace(joint, shape_covariance=np.zeros((0, 10, 10)), **nobody)
    found = claimed(joint, result, up=0.01)
    assert found.root_sigma.shape == (0, T, 3) and np.isnan(found.camera_height)
