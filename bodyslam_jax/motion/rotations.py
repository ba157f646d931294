"""Rotation vectors and matrices, through jaxlie.

Products are of matrices: jaxlie's own of quaternions mix integers with floats, which
strict promotion refuses.
"""

import jaxlie
from jax import Array
from jaxtyping import Float

from bodyslam_jax.geometry.so3 import log


def matrix(angles: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """The rotation by `|angles|` rad about `angles`."""
    return jaxlie.SO3.exp(angles).as_matrix()


def vector(matrices: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3"]:
    """The shortest rotation vector of a rotation, rad."""
    return log(matrices)


def turned(
    angles: Float[Array, "*#b 3"], further: Float[Array, "*#b 3"]
) -> Float[Array, "*b 3"]:
    """A rotation followed by another one in its own frame."""
    return vector(matrix(angles) @ matrix(further))


def change(
    start: Float[Array, "*#b 3"], end: Float[Array, "*#b 3"]
) -> Float[Array, "*b 3"]:
    """The rotation that leads from one to another, in the frame of the first."""
    return vector(transposed(matrix(start)) @ matrix(end))


def transposed(matrices: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3 3"]:
    """The inverse rotation."""
    return matrices.swapaxes(-1, -2)
