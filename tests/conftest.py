"""What every test stands on: 64-bit, strict promotion, no silent recompiles."""

import jax
import pytest

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
