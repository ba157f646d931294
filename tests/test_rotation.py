"""SO(3): values, derivatives up to half a turn, agreement of the two forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bodyslam_jax.geometry import so3, so3_numpy
from bodyslam_jax.geometry.so3 import compose, exp, inverse_right_jacobian, log
from bodyslam_jax.graph import retract_rotation

AXES = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, 1], [2, -1, 2], [-1, 2, 0.5]])
AXES /= np.linalg.norm(AXES, axis=1, keepdims=True)
ANGLES = [0.0, 1e-12, 1e-5, 1e-3, 1.0, 3.0, np.pi - 1e-6, np.pi]


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_logarithm_undoes_the_exponential(dtype):
    vectors = jnp.asarray(np.multiply.outer(ANGLES, AXES), dtype)
    back = jax.jit(log)(exp(vectors))
    assert back.dtype == dtype
    # At half a turn either of the two vectors will do.
    same = exp(back)
    atol = 1e-12 if dtype == jnp.float64 else 2e-6
    np.testing.assert_allclose(same, exp(vectors), atol=atol)
    np.testing.assert_allclose(back[:-2], vectors[:-2], atol=5 * atol)
    assert float(jnp.linalg.norm(back, axis=-1).max()) < np.pi + 1e-6
    tiny = back[1] if dtype == jnp.float64 else back[2]
    np.testing.assert_allclose(
        tiny, vectors[1 if dtype == jnp.float64 else 2], rtol=1e-3
    )


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("angle", ANGLES)
def test_a_further_turn_changes_it_as_the_jacobian_says(dtype, angle):
    """Also at exactly half a turn, where a person stands upright before a camera."""

    zero = jnp.zeros(3, dtype)

    def by_step(vector):
        return compose(vector, zero), jax.jacfwd(lambda d: compose(vector, d))(zero)

    def by_matrix(vector):
        further = lambda d: log(exp(vector) @ exp(d))
        return further(zero), jax.jacrev(further)(zero)

    vectors = jnp.asarray(angle * AXES, dtype)
    atol = 1e-8 if dtype == jnp.float64 else 2e-3
    for function in (by_step, by_matrix):
        # At half a turn either of two branches will do, with its own derivative.
        branch, found = jax.jit(jax.vmap(function))(vectors)
        expected = inverse_right_jacobian(branch)
        np.testing.assert_allclose(found, expected, atol=atol)


def test_there_and_back_is_the_identity_with_its_derivative():
    upright = jnp.diag(jnp.array([1.0, -1.0, -1.0]))
    turned = lambda step: upright @ exp(step)
    zero = jnp.zeros(3)
    expected = jax.jacfwd(turned)(zero)
    found = jax.jacfwd(lambda step: exp(log(turned(step))))(zero)
    np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("axis", range(len(AXES)))
def test_a_step_at_half_a_turn_moves_along_the_axis_too(axis):
    start = jnp.asarray(np.pi * AXES[axis])
    zero = jnp.zeros(3)
    found = jax.jacfwd(lambda step: retract_rotation(start, step))(zero)
    np.testing.assert_allclose(found, inverse_right_jacobian(start), atol=1e-9)
    steps = 1e-6 * jnp.concatenate([jnp.eye(3), -jnp.eye(3)])
    moved = jax.vmap(lambda step: retract_rotation(start, step))(steps)
    differences = (moved[:3] - moved[3:]).T / 2e-6
    np.testing.assert_allclose(found, differences, atol=1e-8)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_the_exponential_and_its_derivatives_are_exact_at_every_angle(dtype):
    angles = [0.0, 1e-12, 1e-5, 0.0316, 0.0317, 0.5, 3.0, np.pi, 6.0, 9.0]
    vectors = np.multiply.outer(angles, AXES).reshape(-1, 3)
    found = jax.jit(exp)(jnp.asarray(vectors, dtype))
    assert found.dtype == dtype
    rounding = 1e-15 if dtype == jnp.float64 else 1e-6
    np.testing.assert_allclose(
        found, Rotation.from_rotvec(vectors).as_matrix(), atol=4 * rounding
    )

    def at(vector):
        # dR = R [J_r dθ]x: from a matrix to the vector of its antisymmetric part.
        derivative = jax.jacfwd(exp)(vector)
        spin = jnp.einsum("ji,jka->ika", exp(vector), derivative)
        return jnp.stack([spin[2, 1], spin[0, 2], spin[1, 0]]), jax.hessian(exp)(vector)

    below = vectors[: 8 * len(AXES)]
    right, second = jax.jit(jax.vmap(at))(jnp.asarray(below, dtype))
    product = right @ jax.vmap(inverse_right_jacobian)(jnp.asarray(below, dtype))
    eye = np.broadcast_to(np.eye(3), product.shape)
    np.testing.assert_allclose(product, eye, atol=1e3 * rounding)
    assert np.isfinite(second).all()


def test_the_second_derivative_is_continuous_where_the_series_begins():
    hessian = jax.jit(jax.hessian(exp))
    edge = jnp.asarray(np.sqrt(1e-3) * AXES[3])
    np.testing.assert_allclose(
        hessian(edge * (1 - 1e-9)), hessian(edge * (1 + 1e-9)), atol=1e-8
    )


def test_numpy_has_the_same_functions_with_the_same_values():
    rng = np.random.default_rng(0)
    a, b = rng.normal(0, 1, (2, 4, 5, 3))
    share = rng.uniform(0, 1, (4, 5))
    R, S = so3_numpy.exp(a), so3_numpy.exp(b)
    calls = {
        "exp": (a,),
        "log": (R,),
        "compose": (a, b),
        "between": (a, b),
        "interpolate": (R, S, share),
        "from_quaternion": (so3_numpy.quaternion(a),),
    }
    for name, arrays in calls.items():
        in_numpy = getattr(so3_numpy, name)(*arrays)
        in_jax = getattr(so3, name)(*map(jnp.asarray, arrays))
        np.testing.assert_allclose(in_numpy, in_jax, atol=1e-12)


def test_a_path_is_interpolated_between_its_nearest_poses():
    rotations = so3_numpy.exp(np.random.default_rng(1).normal(0, 1, (3, 3)))
    found = so3_numpy.interpolate_path(
        np.array([0.0, 1.0, 3.0]), rotations, np.array([0.0, 0.25, 2.0, 3.0])
    )
    start, end = rotations[[0, 1]], rotations[[1, 2]]
    half = so3_numpy.interpolate(start, end, np.array([0.25, 0.5]))
    wanted = [rotations[0], half[0], half[1], rotations[2]]
    np.testing.assert_allclose(found, wanted, atol=1e-12)


def test_the_optical_axis_is_turned_into_a_ray():
    xy = np.array([[0.0, 0.0], [0.3, -0.4], [-2.0, 1.0]])
    ray = np.column_stack([xy, np.ones(3)])
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    vectors = so3_numpy.optical_axis_to_ray(xy)
    np.testing.assert_allclose(so3_numpy.exp(vectors)[:, :, 2], ray, atol=1e-12)
    np.testing.assert_allclose(vectors[:, 2], 0.0)


def test_the_logarithm_in_numpy_passes_missing_rotations_on():
    rotations = np.stack([np.eye(3), np.full((3, 3), np.nan)])
    vectors = so3_numpy.log(rotations)
    assert (vectors[0] == 0).all() and np.isnan(vectors[1]).all()
