"""What every test stands on: 64-bit, strict promotion, no silent recompiles."""

import os

import jax
import jaxlib.version
import pytest

if jaxlib.version.__version__.startswith("0.10."):
    # As the package compiles its own large programs: compiling is what most tests wait
    # for, and takes two thirds of the time so. Of a version that does not know it, the
    # flag would end the program.
    flags = ("--xla_cpu_use_fusion_emitters=false", os.environ.get("XLA_FLAGS", ""))
    os.environ["XLA_FLAGS"] = " ".join(flags)

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture
def key() -> jax.Array:
    """A fixed random key; a test that wants another one says why."""
    return jax.random.key(0)


@pytest.fixture(scope="module")
def quick_compilation():
    """For modules whose programs run once: compiling is what takes their time."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)
