"""Logarithms of rotations: values, and derivatives up to half a turn."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from bodyslam_jax.geometry.so3 import compose, log, log_of
from bodyslam_jax.graph import retract_rotation
from bodyslam_jax.graph.state import inverse_right_jacobian

pytestmark = pytest.mark.usefixtures("quick_compilation")

AXES = np.array([[1.0, 0, 0], [0, -1, 0], [0, 0, 1], [2, -1, 2], [-1, 2, 0.5]])
AXES /= np.linalg.norm(AXES, axis=1, keepdims=True)
ANGLES = [0.0, 1e-12, 1e-5, 1e-3, 1.0, 3.0, np.pi - 1e-6, np.pi]
exp = lambda vector: jaxlie.SO3.exp(vector).as_matrix()


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


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize("angle", ANGLES)
def test_a_further_turn_changes_it_as_the_jacobian_says(dtype, angle):
    """Also at exactly half a turn, where a person stands upright before a camera."""

    def at(vector):
        q = jaxlie.SO3.exp(vector)
        # The vector that the branch is of.
        base = log_of(q)
        by_step = jax.jacfwd(lambda d: log_of(compose(q, jaxlie.SO3.exp(d))))
        by_matrix = jax.jacrev(lambda d: log(q.as_matrix() @ exp(d)))
        zero = jnp.zeros(3, dtype)
        return inverse_right_jacobian(base), by_step(zero), by_matrix(zero)

    vectors = jnp.asarray(angle * AXES, dtype)
    expected, by_step, by_matrix = jax.jit(jax.vmap(at))(vectors)
    atol = 1e-8 if dtype == jnp.float64 else 2e-3
    np.testing.assert_allclose(by_step, expected, atol=atol)
    np.testing.assert_allclose(by_matrix, expected, atol=atol)


def test_there_and_back_is_the_identity_with_its_derivative():
    upright = jnp.diag(jnp.array([1.0, -1.0, -1.0]))
    turned = lambda step: upright @ exp(step)
    zero = jnp.zeros(3)
    expected = jax.jacfwd(turned)(zero)
    found = jax.jacfwd(lambda step: exp(log(turned(step))))(zero)
    np.testing.assert_allclose(found, expected, atol=1e-12)


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
