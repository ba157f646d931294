"""Whether people stand on the ground of the map, which the estimate does not ask."""

import dataclasses

import numpy as np
import pytest

from bodyslam_jax import export
from bodyslam_jax.ground import find_ground
from bodyslam_jax.result import Result


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
        joints[0, :, foot, 1] = 0.1 * np.maximum(np.sin(20 * s + phase), 0)
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


@pytest.mark.parametrize("tilt", [0.0, 0.1])
@pytest.mark.parametrize("factor", [1.0, 1.8, 0.6])
def test_says_how_much_too_small_the_map_is(factor, tilt):
    found = export.ground_scale(scene(factor, tilt))
    np.testing.assert_allclose(found, factor, rtol=0.04)  # floor: 2 cm rough


def test_the_ground_is_found_among_much_else():
    normal, offset = np.split(
        find_ground(scene().landmarks, scene().T_WC[:, :3, 3], np.array([0.0, 1, 0])),
        [3],
    )
    np.testing.assert_allclose(normal, [0, 1, 0], atol=0.01)
    np.testing.assert_allclose(offset, 0, atol=0.02)


def test_nothing_is_said_without_ground_or_people():
    whole = scene()
    walls = whole.landmarks[whole.landmarks[:, 1] > 0.5]
    assert export.ground_scale(dataclasses.replace(whole, landmarks=walls)) is None
    bare = dataclasses.replace(whole, landmarks=whole.landmarks[:0])
    assert export.ground_scale(bare) is None
    nobody = np.zeros_like(whole.present)
    assert export.ground_scale(dataclasses.replace(whole, present=nobody)) is None
