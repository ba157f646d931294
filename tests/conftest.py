"""What every test stands on: 64-bit, strict promotion, no silent recompiles."""

import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")


@pytest.fixture
def key() -> jax.Array:
    """A fixed random key; a test that wants another one says why."""
    return jax.random.key(0)
