"""Programs that run once are compiled with less effort, and say the same."""

import jax
import jax.numpy as jnp
import numpy as np

from bodyslam_jax import compilation
from bodyslam_jax.compilation import is_alone, jit_once


def test_only_a_whole_program_is_compiled_with_options_of_its_own():
    seen = []
    assert is_alone()
    jax.vmap(lambda x: seen.append(is_alone()) or x)(jnp.zeros(2))
    jax.jit(lambda: seen.append(is_alone()) or jnp.zeros(()))()
    assert seen == [True, False]


def test_code_as_it_comes_says_the_same_alone_mapped_derived_and_within_a_program():
    square = lambda x, power=2: jnp.sum(jnp.sin(x) ** power)
    once = jit_once(square)
    x = jnp.linspace(0.0, 1.0, 7)
    assert np.allclose(once(x), square(x), rtol=1e-14)
    assert np.allclose(once(x, power=3), square(x, 3), rtol=1e-14)
    assert np.allclose(jax.jit(once)(x), square(x), rtol=1e-14)
    assert np.allclose(jax.vmap(once)(x[:, None]), jnp.sin(x) ** 2, rtol=1e-14)
    assert np.allclose(jax.grad(once)(x), jax.grad(square)(x), rtol=1e-14)
    assert np.allclose(jax.jit(jax.grad(once))(x), jax.grad(square)(x), rtol=1e-14)


def test_options_that_xla_does_not_know_are_left_out():
    assert compilation._if_known({"no_such_option": True}) is None
    assert compilation._if_known({"xla_backend_optimization_level": 0}) is not None
