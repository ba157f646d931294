"""Compiler options belong to whole programs only."""

import jax
import jax.numpy as jnp
import numpy as np

from bodyslam_jax.graph.tracing import is_alone
from bodyslam_jax.solver import compilation


def test_only_a_whole_program_is_compiled_with_options_of_its_own():
    seen = []
    assert is_alone()
    jax.vmap(lambda x: seen.append(is_alone()) or x)(jnp.zeros(2))
    jax.jit(lambda: seen.append(is_alone()) or jnp.zeros(()))()
    assert seen == [True, False]


def test_a_program_compiled_with_options_gives_the_same():
    square = lambda x, power=2: jnp.sum(jnp.sin(x) ** power)
    x = jnp.linspace(0.0, 1.0, 7)
    assert np.allclose(compilation.compiled(square)(x, power=3), square(x, 3))


def test_options_that_xla_does_not_know_are_left_out(monkeypatch):
    monkeypatch.setattr(compilation, "_OPTIONS", {"no_such_option": True})
    compilation.quick_options.cache_clear()
    assert compilation.quick_options() is None
    monkeypatch.undo()
    compilation.quick_options.cache_clear()
