"""The truth of `bench_real.py`: points that several views agree on, and errors."""

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pytest

from bodyslam_jax.geometry import so3_numpy as so3

FILE = Path(__file__).parents[1] / "benchmarks" / "bench_real.py"


@pytest.fixture(scope="module")
def bench():
    if not FILE.exists():
        pytest.skip("the benchmarks are not part of an installed package")
    spec = importlib.util.spec_from_file_location("bench_real", FILE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def points():
    rng = np.random.default_rng(0)
    at_rest = rng.normal(0, 0.5, (12, 3))
    away = np.linspace(0, 0.6, 80)[:, None, None] * np.array([1.0, 0.2, 0.5])
    return at_rest + away + rng.normal(0, 0.02, (80, 12, 3))


def cameras(bench, angles):
    """Cameras at 3.5 m around the origin, which look at it."""
    views = []
    for k, angle in enumerate(angles):
        forward = np.array([np.sin(angle), 0.0, np.cos(angle)])
        right, down = np.cross([0.0, -1.0, 0.0], -forward), np.array([0.0, -1.0, 0.0])
        R_CW = np.stack([right, down, np.cross(right, down)])
        centre = -3.5 * R_CW[2]
        none = np.zeros(0)
        views.append(bench.View(f"v{k}", np.eye(3), none, R_CW, centre, None))
    return views


def seen(views, points):
    p_C = [view.to_camera(points) for view in views]
    return [p[..., :2] / p[..., 2:] for p in p_C]


def test_a_keypoint_that_disagrees_is_left_out(bench, points):
    views = cameras(bench, [0.3, 1.7, 2.9, 4.4])
    xy = [a.copy() for a in seen(views, points)]
    xy[1][10:20, 3] += 0.2
    xy[2][:, 7] = np.nan
    found, off = bench.meet(views, xy)
    np.testing.assert_allclose(found, points, atol=2e-3)
    assert np.isnan(off[1, 10:20, 3]).all() and np.isnan(off[2, :, 7]).all()
    assert np.isfinite(np.delete(off[1], 3, axis=1)).all()
    alone, _ = bench.meet(views[:1], xy[:1])
    assert np.isnan(alone).all()


def test_poses_of_cameras_are_refined(bench, points):
    views = cameras(bench, [0.3, 1.7, 2.9])
    xy = seen(views, points)
    wrong = [
        dataclasses.replace(v, R_CW=so3.exp(np.array(turn)) @ v.R_CW)
        for v, turn in zip(views, ([0, 0.008, 0], [0, 0, -0.006], [0.007, 0, 0]))
    ]
    before, _ = bench.meet(wrong, xy)
    after, off = bench.meet(bench.refined(wrong, xy), xy)
    # Where all cameras together are is the calibration's.
    flat = lambda x: x.reshape(1, -1, 3)
    away = lambda x: bench.aligned(flat(points), flat(x))[0] - flat(points)
    residual = lambda x: np.median(np.linalg.norm(away(x), axis=-1))
    assert residual(after) < 0.3 * residual(before)
    assert np.nanmedian(off) < 0.003


def compared(bench, points, found, axes):
    valid = np.ones(len(points), bool)
    return bench.Compared(
        "v", points, found, axes, valid, points[None, ..., 0], None, 0
    )


def test_errors_are_those_made(bench, points):
    """A similarity is no error of PA; offsets of joints come out as they went in."""
    rng = np.random.default_rng(1)
    points = points + [0.0, 0.0, 4.0]
    axes = so3.exp(rng.normal(0, 1.0, (80, 12, 3)))
    shift = rng.normal(0, 0.02, (6, 3))
    shift = np.concatenate([shift, shift * [-1, 1, 1]])
    R = so3.exp(np.array([0.1, 0.3, -0.2]))
    moved = 1.1 * points @ R.T + [0.3, 0.1, 0.2]
    plain = compared(bench, points, moved, axes)
    exact = bench.figures(plain, np.zeros((12, 3)))
    assert exact["pa"] < 1e-6 and exact["size"] == pytest.approx(1.1)
    assert exact["mpjpe"] > 100  # mm: neither turned nor scaled
    body = np.einsum("tjab,jb->tja", axes, shift)
    turned = np.einsum("ab,tjbc->tjac", R, axes)
    moved = 1.1 * (points - body) @ R.T
    row = compared(bench, points, moved, turned)
    raw = bench.figures(row, np.zeros((12, 3)))
    found = bench.offsets([row])
    left = bench.figures(row, found)
    assert raw["pa"] > 15 and left["pa"] < 0.1 * raw["pa"]
    # A common offset and a size are the similarity's.
    np.testing.assert_allclose(found, 1.1 * shift, atol=0.004)
