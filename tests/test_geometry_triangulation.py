"""Points from many views: exact, robust, unbiased, finite without parallax."""

import numpy as np

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.triangulation import triangulate, unit_rays, widest_angle

PIXEL = 1 / 500.0


def _views(num_cameras: int, points: np.ndarray, baseline: float = 1.0):
    """Cameras on a line across, all of which see all points in front of them."""
    x = np.linspace(-0.5, 0.5, num_cameras) * baseline
    centres = np.stack([x, 0 * x, 0 * x], axis=1)
    R = so3.exp(np.stack([0.1 + 0 * x, -0.1 * x, 0.02 + 0 * x], axis=1))
    camera = np.repeat(np.arange(num_cameras), len(points))
    landmark = np.tile(np.arange(len(points)), num_cameras)
    p_C = np.einsum("mij,mj->mi", R[camera], points[landmark] - centres[camera])
    return R[camera], centres[camera], p_C[:, :2] / p_C[:, 2:], landmark


def test_exact_views_give_the_points():
    points = np.random.default_rng(0).uniform((-2, -1, 3), (2, 1, 8), (20, 3))
    found = triangulate(*_views(4, points), len(points), PIXEL)
    np.testing.assert_allclose(found, points, atol=1e-8)


def test_one_outlier_among_eight_views_hardly_moves_the_point():
    points = np.array([[0.3, -0.2, 4.0]])
    R, centre, xy, landmark = _views(8, points)
    xy[3] += 50 * PIXEL
    found = triangulate(R, centre, xy, landmark, 1, PIXEL)
    np.testing.assert_allclose(found, points, atol=1e-3)


def test_noise_does_not_draw_points_nearer():
    rng = np.random.default_rng(1)
    points = rng.uniform((-1, -1, 9), (1, 1, 11), (500, 3))
    R, centre, xy, landmark = _views(8, points)
    xy = xy + PIXEL * rng.standard_normal(xy.shape)
    found = triangulate(R, centre, xy, landmark, len(points), PIXEL)
    ratio = found[:, 2] / points[:, 2]
    # Inverse depth has a standard deviation of 2.5 %: its mean is known to 0.1 %.
    assert abs(np.mean(1 / ratio) - 1) < 0.005


def test_points_without_parallax_or_views_are_finite():
    R, centre, xy, landmark = _views(2, np.array([[0.0, 0.0, 5.0]]), baseline=0.0)
    found = triangulate(R, centre, xy, landmark, 3, PIXEL)
    assert np.isfinite(found).all()
    angle = widest_angle(centre, landmark, found)
    np.testing.assert_allclose(angle, 0.0, atol=1e-6)


def test_the_widest_angle_is_the_parallax_seen_from_the_point():
    points = np.array([[0.0, 0.0, 0.5]])
    _, centre, _, landmark = _views(3, points)
    np.testing.assert_allclose(widest_angle(centre, landmark, points), [np.pi / 2])


def test_rays_have_unit_length():
    xy = np.array([[0.0, 0.0], [0.5, -2.0]])
    np.testing.assert_allclose(np.linalg.norm(unit_rays(xy), axis=1), 1.0)
