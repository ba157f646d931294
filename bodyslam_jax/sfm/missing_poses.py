"""Camera poses of frames that were not located, between those that were."""

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.geometry import so3_numpy as so3


def fill_missing_poses(
    T_WC: Float[np.ndarray, "t 4 4"], valid: Bool[np.ndarray, " t"]
) -> Float[np.ndarray, "t 4 4"]:
    """Interpolates missing poses between neighbours, held before the first and after
    the last."""
    at = np.flatnonzero(valid)
    if not len(at) or valid.all():
        return T_WC
    filled = T_WC.copy()
    time = np.clip(np.arange(len(T_WC)), at[0], at[-1])
    if len(at) == 1:
        filled[:] = T_WC[at[0]]
        return filled
    filled[:, :3, :3] = so3.interpolate_path(at, T_WC[at, :3, :3], time)
    for axis in range(3):
        filled[:, axis, 3] = np.interp(time, at, T_WC[at, axis, 3])
    filled[at] = T_WC[at]
    return filled
