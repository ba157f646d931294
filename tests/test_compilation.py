"""Compiler options belong to whole programs only."""

import jax
import jax.monitoring
import jax.numpy as jnp
import numpy as np
import pytest

from bodyslam_jax import evaluation, pipeline, simulation
from bodyslam_jax.config import Config, Simulation
from bodyslam_jax.geometry.lengths import is_alone
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
    for known in ({"xla_llvm_disable_expensive_passes": True}, {}):
        options = {"no_such_option": True, **known}
        monkeypatch.setattr(compilation, "_XLA_CPU_OPTIONS", options)
        compilation.quick_options.cache_clear()
        assert compilation.quick_options() == (known or None)
    monkeypatch.undo()
    compilation.quick_options.cache_clear()


@pytest.fixture
def compilations():
    """What JAX compiles from here on: the name of each program, and the time, s."""
    found: list[tuple[str, float]] = []

    def listen(event, seconds, **about):
        if event.endswith("backend_compile_duration"):
            found.append((str(about.get("fun_name")), seconds))

    jax.config.update("jax_enable_compilation_cache", False)
    jax.monitoring.register_event_duration_secs_listener(listen)
    yield found
    jax.monitoring.unregister_event_duration_listener(listen)
    jax.config.update("jax_enable_compilation_cache", True)


@pytest.mark.slow
def test_a_second_clip_of_another_length_compiles_nothing_that_takes_long(
    compilations,
):
    """The whole flow: from measurements to a result and its errors."""

    def run(frames):
        compilations.clear()
        simulated = simulation.simulate(Simulation(sequence="M2", length=frames))
        sequence = simulation.as_sequence(simulated)
        result = pipeline.run(sequence, Config())
        evaluation.evaluate(result, simulation.as_truth(simulated))
        return max(compilations, key=lambda found: found[1])

    name, longest = run(70)
    assert name == "jit(_run)"
    # Of what takes 20 s on a quiet machine, 1 s: the machine may be busy.
    name, seconds = run(97)
    assert seconds < max(1.0, 0.05 * longest), name
