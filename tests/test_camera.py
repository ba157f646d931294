"""The camera against OpenCV, its own inverse, and points where it has no meaning."""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from bodyslam_jax.geometry import camera

PINHOLE = np.array([500.0, 510.0, 320.0, 240.0])
DISTORTED = np.array([500.0, 510.0, 320.0, 240.0, -0.28, 0.07, 1e-3, -2e-3])


def _points(num: int = 50) -> np.ndarray:
    rng = np.random.default_rng(0)
    xy = rng.uniform([-0.7, -0.5], [0.7, 0.5], (num, 2))
    z = rng.uniform(0.5, 8.0, (num, 1))
    return np.concatenate([xy * z, z], axis=-1)


def _cv2_project(intrinsics: np.ndarray, p_C: np.ndarray) -> np.ndarray:
    fx, fy, cx, cy = intrinsics[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    distortion = intrinsics[4:] if len(intrinsics) == 8 else np.zeros(4)
    return cv2.projectPoints(p_C, np.zeros(3), np.zeros(3), K, distortion)[0][:, 0]


@pytest.mark.parametrize("intrinsics", [PINHOLE, DISTORTED], ids=["pinhole", "opencv"])
def test_projects_like_opencv_and_back(intrinsics):
    p_C = _points()
    uv = jax.jit(camera.project)(jnp.asarray(intrinsics), jnp.asarray(p_C))
    np.testing.assert_allclose(uv, _cv2_project(intrinsics, p_C), atol=1e-9)
    ray = camera.unproject(jnp.asarray(intrinsics), uv)
    np.testing.assert_allclose(ray, p_C / p_C[:, 2:], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_keeps_its_dtype_and_broadcasts(dtype):
    intrinsics = jnp.asarray(DISTORTED, dtype)
    p_C = jnp.asarray(_points(6), dtype).reshape(2, 3, 3)
    uv = camera.project(jnp.stack([intrinsics] * 2)[:, None], p_C)
    assert uv.dtype == dtype
    np.testing.assert_allclose(uv, camera.project(intrinsics, p_C))
    mapped = jax.vmap(jax.vmap(camera.project, (None, 0)), (None, 0))(intrinsics, p_C)
    np.testing.assert_allclose(uv, mapped, rtol=1e-5)
    ray = camera.unproject(intrinsics, uv)
    assert ray.dtype == dtype
    tolerance = 1e-5 if dtype == jnp.float32 else 1e-12
    np.testing.assert_allclose(ray, p_C / p_C[..., 2:], atol=tolerance)


def test_derivatives_are_right():
    p_C = jnp.asarray(_points(5))
    check_grads(jax.jit(camera.project), (jnp.asarray(DISTORTED), p_C), order=1)
    uv = camera.project(jnp.asarray(DISTORTED), p_C)
    check_grads(jax.jit(camera.unproject), (jnp.asarray(DISTORTED), uv), order=1)


@pytest.mark.parametrize("intrinsics", [PINHOLE, DISTORTED], ids=["pinhole", "opencv"])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_is_finite_at_and_behind_the_camera(intrinsics, dtype):
    intrinsics = jnp.asarray(intrinsics, dtype)
    # Squared, as a cost does: float32 must not overflow either.
    cost = lambda k, p: jnp.sum(camera.project(k, p) ** 2)
    with_gradient = jax.jit(jax.value_and_grad(cost, (0, 1)))
    for depth in (-2.0, 0.0, 1e-9, 1e-3):
        for x in (0.0, 10.0):
            p_C = jnp.array([x, 0.5 * x, depth], dtype)
            value, gradients = with_gradient(intrinsics, p_C)
            assert jnp.isfinite(value)
            assert all(jnp.isfinite(g).all() for g in gradients)


def test_does_not_fold_the_outside_into_the_image():
    # OpenCV's polynomial brings a point at 75 degrees to the middle of this image.
    p_C = np.stack([np.linspace(0.0, 4.0, 200), np.zeros(200), np.ones(200)], axis=-1)
    barrel = np.array([500.0, 500.0, 320.0, 240.0, -0.3, 0.0, 0.0, 0.0])
    u = np.asarray(camera.project(jnp.asarray(barrel), jnp.asarray(p_C)))[:, 0]
    assert (np.diff(u) > 0).all()
    assert (np.diff(_cv2_project(barrel, p_C)[:, 0]) < 0).any()
