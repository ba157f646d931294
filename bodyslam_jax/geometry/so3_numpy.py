"""The rotation group SO(3) in NumPy, for stages that run once per clip.

The module has the functions of `so3` under the same names, based on SciPy's `Rotation`,
which is used nowhere else. It is separate so that reading files and structure from
motion do not import JAX. Rotation vectors are in rad, quaternions in order x y z w.
"""

import numpy as np
from jaxtyping import Float, Real
from scipy.spatial.transform import Rotation, Slerp


def exp(vector: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """Converts rotation vectors to matrices."""
    return _of_vector(vector).as_matrix().reshape(*vector.shape, 3)


def log(rotation: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b 3"]:
    """Converts rotation matrices to rotation vectors, at most π long.

    A matrix that is not exactly orthogonal is replaced by the nearest rotation; one
    that is not finite gives NaN.

    **Raises:** `ValueError` for matrices whose determinant is not positive.
    """
    flat = rotation.reshape(-1, 3, 3)
    finite = np.asarray(np.isfinite(flat).all(axis=(1, 2)))[:, None]
    safe = np.where(finite[..., None], flat, np.eye(3))
    vector = np.where(finite, Rotation.from_matrix(safe).as_rotvec(), np.nan)
    return vector.reshape(rotation.shape[:-1])


def compose(
    first: Float[np.ndarray, "*b 3"], second: Float[np.ndarray, "*b 3"]
) -> Float[np.ndarray, "*b 3"]:
    """Returns `Log(Exp(first) Exp(second))`, with `second` in the rotated frame."""
    product = _of_vector(first) * _of_vector(second)
    return product.as_rotvec().reshape(second.shape)


def between(
    first: Float[np.ndarray, "*b 3"], second: Float[np.ndarray, "*b 3"]
) -> Float[np.ndarray, "*b 3"]:
    """Returns `Log(Exp(first)ᵀ Exp(second))`, the rotation from `first` to `second` in
    the frame of `first`; at most π long."""
    return compose(-first, second)


def interpolate(
    start: Float[np.ndarray, "*b 3 3"],
    end: Float[np.ndarray, "*b 3 3"],
    share: Float[np.ndarray, "*b"],
) -> Float[np.ndarray, "*b 3 3"]:
    """Interpolates along the geodesic from `start` (share 0) to `end` (share 1)."""
    whole = log(np.swapaxes(start, -1, -2) @ end)
    return start @ exp(share[..., None] * whole)


def interpolate_path(
    times: Real[np.ndarray, " n"],
    rotations: Float[np.ndarray, "n 3 3"],
    at: Real[np.ndarray, " t"],
) -> Float[np.ndarray, "t 3 3"]:
    """Interpolates matrices at the times `at`, which lie within increasing `times`
    (n >= 2)."""
    return Slerp(times, Rotation.from_matrix(rotations))(at).as_matrix()


def nearest(matrix: Float[np.ndarray, "*b 3 3"]) -> Float[np.ndarray, "*b 3 3"]:
    """Returns the rotation that is nearest to a matrix, such as one with rounding
    errors."""
    U, _, Vt = np.linalg.svd(matrix)
    return U @ Vt


def from_quaternion(xyzw: Float[np.ndarray, "*b 4"]) -> Float[np.ndarray, "*b 3 3"]:
    """Converts quaternions of any length but 0 to rotation matrices."""
    rotation = Rotation.from_quat(xyzw.reshape(-1, 4))
    return rotation.as_matrix().reshape(*xyzw.shape[:-1], 3, 3)


def quaternion(vector: Float[np.ndarray, "*b 3"]) -> Float[np.ndarray, "*b 4"]:
    """Converts rotation vectors to unit quaternions."""
    return _of_vector(vector).as_quat().reshape(*vector.shape[:-1], 4)


def euler(vector: Float[np.ndarray, "*b 3"], order: str) -> Float[np.ndarray, "*b 3"]:
    """Converts rotation vectors to intrinsic Euler angles (rad), in an order such as
    `ZXY`."""
    return _of_vector(vector).as_euler(order).reshape(vector.shape)


def optical_axis_to_ray(xy: Float[np.ndarray, "*b 2"]) -> Float[np.ndarray, "*b 3"]:
    """Returns the rotation vector of the smallest rotation from +z to a ray (x, y,
    1)."""
    tangent = np.linalg.norm(xy, axis=-1, keepdims=True)
    axis = np.stack([-xy[..., 1], xy[..., 0], np.zeros(xy.shape[:-1])], axis=-1)
    return np.arctan(tangent) * axis / np.where(tangent > 0, tangent, 1.0)


def _of_vector(vector: np.ndarray) -> Rotation:
    """Converts rotation vectors to SciPy's rotations."""
    # A copy, as SciPy rejects read-only arrays such as those from JAX.
    return Rotation.from_rotvec(np.array(vector.reshape(-1, 3)))
