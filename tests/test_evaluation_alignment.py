"""Alignment: Umeyama's optimum, its derivative, and the four alignments by name."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from evo.core.geometry import umeyama_alignment
from jax.test_util import check_grads

from bodyslam_jax import evaluation


def _points(key, n=12):
    target, noise = jax.random.normal(key, (2, n, 3))
    turn = jaxlie.SO3.sample_uniform(key).as_matrix()
    return target, 0.4 * target @ turn.T + 0.2 * noise + 3.0


def _fit(target, source, weights=None, with_scale=True):
    found = evaluation.umeyama(target, source, weights, with_scale)
    return found.scale, found.rotation, found.translation


@pytest.mark.parametrize("with_scale", [False, True])
@pytest.mark.parametrize("mirrored", [False, True])
def test_equals_evo(key, with_scale, mirrored):
    target, source = _points(key)
    if mirrored:
        source = target * jnp.array([1.0, 1.0, -1.0])
    found = evaluation.umeyama(target, source, with_scale=with_scale)
    rotation, translation, scale = umeyama_alignment(
        np.asarray(source.T), np.asarray(target.T), with_scale
    )
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(found.translation, translation, atol=1e-12)
    np.testing.assert_allclose(found.scale, scale, atol=1e-12)
    assert np.linalg.det(found.rotation) > 0


def test_weight_zero_is_a_point_that_does_not_exist(key):
    target, source = _points(key)
    weights = jnp.ones(12).at[3:].set(0.0)
    few = _fit(target[:3], source[:3])
    for a, b in zip(_fit(target, source, weights), few, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-12)


def test_batches_like_a_loop(key):
    target, source = jax.random.normal(key, (2, 5, 9, 3))
    together = _fit(target, source)
    for i in range(5):
        for a, b in zip(together, _fit(target[i], source[i]), strict=True):
            np.testing.assert_allclose(a[i], b, atol=1e-12)


@pytest.mark.slow
def test_derivative_is_that_of_finite_differences(key):
    target, source = _points(key)
    fit = lambda *args: _fit(*map(jnp.asarray, args))
    check_grads(fit, (target, source, jnp.ones(12)), order=1)


_jacobian = jax.jit(jax.jacrev(_fit, (0, 1)))
_LINE = jnp.arange(12.0)[:, None] * jnp.array([1.0, 2.0, -1.0])


@pytest.mark.slow
@pytest.mark.parametrize(
    "target, source",
    [
        (_LINE, _LINE),
        (_LINE, -_LINE),
        (jnp.zeros((12, 3)), jnp.zeros((12, 3))),
        (_LINE, jnp.ones((12, 3))),
        (_LINE.at[:, 0].set(_LINE[:, 0] ** 2), _LINE),
        (_LINE * jnp.array([1.0, 0, 0]) + jnp.eye(12, 3), jnp.eye(12, 3)),
    ],
    ids=["line", "reversed", "all zero", "one point", "onto a plane", "planar"],
)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_degenerate_points(target, source, dtype):
    target, source = target.astype(dtype), source.astype(dtype)
    scale, rotation, translation = _fit(target, source)
    assert rotation.dtype == dtype
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-5)
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-5)
    assert np.isfinite(scale) and np.all(np.isfinite(translation))
    for leaf in jax.tree.leaves(_jacobian(target, source)):
        assert np.all(np.isfinite(leaf))


def test_no_weight_at_all_is_the_identity():
    nothing = evaluation.umeyama(_LINE, _LINE, jnp.zeros(12), with_scale=True)
    np.testing.assert_array_equal(nothing.rotation, np.eye(3))
    assert nothing.scale == 1


def _scene(key):
    """Cameras, a person's centre, and a rigid motion of the world."""
    t = jnp.linspace(0.0, 3.0, 20)
    cameras = jnp.tile(jnp.eye(4), (20, 1, 1))
    turns = jaxlie.SO3.exp(0.3 * jax.random.normal(key, (20, 3))).as_matrix()
    centres = jnp.stack([jnp.cos(t), jnp.sin(t), 0.2 * t], -1)
    cameras = cameras.at[:, :3, :3].set(turns).at[:, :3, 3].set(centres)
    human = jnp.stack([t, 0.1 * t**2, jnp.sin(2 * t)], -1)
    move = jaxlie.SE3.exp(jnp.array([1.0, -2.0, 0.5, 0.4, -0.8, 0.3])).as_matrix()
    return cameras, human, move


@pytest.mark.slow
@pytest.mark.parametrize("alignment", ["A1", "A2", "A3", "A4"])
def test_every_alignment_undoes_a_change_of_world(key, alignment):
    cameras, human, move = _scene(key)
    ones, moved = jnp.ones(20), human @ move[:3, :3].T + move[:3, 3]
    camera, person = evaluation.align(
        alignment, cameras, move @ cameras, ones, human, moved, ones
    )
    centres = (move @ cameras)[:, :3, 3]
    np.testing.assert_allclose(camera.apply(centres), cameras[:, :3, 3], atol=1e-12)
    np.testing.assert_allclose(person.apply(moved), human, atol=1e-12)


@pytest.mark.slow
def test_alignments_differ_where_the_appendix_says_so(key):
    """The person alone is displaced: only A1 hides it; A3 shares it out."""
    cameras, human, _ = _scene(key)
    ones, displaced = jnp.ones(20), human + jnp.array([0.0, 0.0, 0.3])
    args = (cameras, cameras, ones, human, displaced, ones)
    errors = {
        name: jnp.abs(evaluation.align(name, *args)[1].apply(displaced) - human).max()
        for name in ("A1", "A2", "A3", "A4")
    }
    assert errors["A1"] < 1e-12
    np.testing.assert_allclose(errors["A2"], 0.3, atol=1e-12)
    np.testing.assert_allclose(errors["A4"], 0.3, atol=1e-12)
    assert 0.01 < errors["A3"] < 0.3


@pytest.mark.slow
def test_a4_takes_the_first_pose_that_counts(key):
    cameras, human, move = _scene(key)
    estimate = (move @ cameras).at[0].set(jnp.eye(4))
    weights = jnp.ones(20).at[0].set(0.0)
    camera, _ = evaluation.align(
        "A4", cameras, estimate, weights, human, human, weights
    )
    np.testing.assert_allclose(
        camera.apply(estimate[1:, :3, 3]), cameras[1:, :3, 3], atol=1e-12
    )


def test_no_scale_from_one_pose(key):
    cameras, human, _ = _scene(key)
    args = (cameras, cameras, jnp.ones(20), human, human, jnp.ones(20))
    with pytest.raises(ValueError, match="fixes no scale"):
        evaluation.align("A4", *args, with_scale=True)
