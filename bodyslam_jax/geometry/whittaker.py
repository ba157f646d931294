"""A low-pass filter for postures and paths of people, as used in gait laboratories.

Regressed bodies have noise of their own in each frame, and the graph couples postures
of successive frames only through the AR(1) errors of the regressor: stronger smoothing
within the estimation would reduce the swing of the legs, from which the scale is
estimated. So noise is filtered afterwards. Whittaker's smoother minimises
`|x - y|² + λ |D² x|²` over each run of frames; its gain at frequency f is
`1 / (1 + λ (2 - 2 cos(2π f / fps))²)`: it has no lag, preserves constant speed, and
halves amplitudes at the cutoff.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import solveh_banded

from bodyslam_jax.geometry import so3_numpy as so3


def low_pass(
    values: Float[np.ndarray, " t *channels"],
    present: Bool[np.ndarray, " t"],
    fps: float,
    cutoff: float,
) -> Float[np.ndarray, " t *channels"]:
    """Smooths every channel over each run of frames that are `present`.

    `cutoff` is in Hz; if it is at least `fps` / 2, values are returned unchanged, and
    so are runs of fewer than three frames.
    """
    out = values.astype(float).copy()
    if cutoff >= fps / 2:
        return out
    weight = (2 - 2 * np.cos(2 * np.pi * cutoff / fps)) ** -2
    edges = np.flatnonzero(np.diff(present.astype(int), prepend=0, append=0))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        n = int(stop - start)
        if n < 3:
            continue
        bands = weight * curvature_bands(n)
        bands[2] += 1.0
        flat = out[start:stop].reshape(n, -1)
        out[start:stop] = solveh_banded(bands, flat).reshape(out[start:stop].shape)
    return out


def curvature_bands(n: int) -> Float[np.ndarray, "3 n"]:
    """Returns the upper bands of `D²ᵀ D²`, for `n` values in a row."""
    second = np.array([1.0, -2.0, 1.0])
    bands = np.zeros((3, n))
    for a in range(3):
        for b in range(a, 3):
            bands[2 - (b - a), b : n - 2 + b] += second[a] * second[b]
    return bands


def low_pass_rotations(
    angles: Float[np.ndarray, "t *j 3"],
    present: Bool[np.ndarray, " t"],
    fps: float,
    cutoff: float,
) -> Float[np.ndarray, "t *j 3"]:
    """Smooths rotation vectors (rad) by applying `low_pass` to their quaternions.

    Signs of quaternions are chosen for continuity between frames, so that rotations may
    pass through π. `cutoff` is in Hz.
    """
    shape = angles.shape
    q = so3.quaternion(angles).reshape(len(angles), -1, 4)
    same = np.sign((q[1:] * q[:-1]).sum(-1))
    sign = np.cumprod(np.where(same < 0, -1.0, 1.0), axis=0)
    q[1:] *= sign[..., None]
    smooth = low_pass(q, present, fps, cutoff).reshape(-1, 4)
    found = so3.log(so3.from_quaternion(smooth)).reshape(shape)
    keep = present.reshape(-1, *(1,) * (angles.ndim - 1))
    return np.where(keep, found, angles)
