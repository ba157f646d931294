"""The initial scale in closed form: from motion, the ground, and a given path."""

import dataclasses
from collections.abc import Collection

import jax
import jax.numpy as jnp
import numpy as np

from bodyslam_jax import graph, motion
from bodyslam_jax.config import PATH_SIGMA
from bodyslam_jax.initialisation.ground import heights_of_camera, scales
from bodyslam_jax.types import ScaleStart


def scale_start(
    state: graph.State,
    prediction: motion.Prediction,
    contact: graph.GroundContact | None,
    *,
    shared_error: float = 0.0,
    path: float = float("nan"),
    without: Collection[int] = (),
) -> ScaleStart:
    """Estimates the scale from motion and, if given, from the ground and a metric path.

    Args:
        contact: factor of ground contact; `None` without ground.
        shared_error: relative error common to all predicted displacements.
        path: m per unit of the map according to the camera path; NaN without one.
        without: people (rows) whose motion is not used.
    """
    start = _motion_scale(state, prediction, without)
    if np.isfinite(path):
        start = dataclasses.replace(start, path=path, path_error=PATH_SIGMA * path)
    error = float(np.hypot(start.motion_error, shared_error * start.motion))
    start = dataclasses.replace(start, motion_error=error)
    if contact is None:
        return start
    information = np.asarray(contact.sigma) ** -2.0
    # By person, as those who stand at one height tell more than those who climb.
    someone = information.any(axis=1)
    mean = lambda values: float(
        np.average(
            [
                np.median(x[told > 0])
                for x, told in zip(values[someone], information[someone], strict=True)
            ],
            weights=information[someone].sum(axis=1),
        )
    )
    ground = mean(scales(contact, state))
    # Error of the ground in m, over the camera's height above it in units.
    metres = float(information.sum()) ** -0.5
    error = metres / mean(heights_of_camera(contact, state))
    # Who climbs has little weight beside somebody who stands on the ground.
    climbing = np.asarray(contact.height).any(axis=1) & someone
    return dataclasses.replace(
        start,
        ground=ground,
        ground_error=error,
        climbing=bool(information[climbing].sum() > information[~climbing].sum()),
    )


def _motion_scale(
    state: graph.State, prediction: motion.Prediction, without: Collection[int]
) -> ScaleStart:
    """Averages over people the robust regression of predicted on observed
    displacements, weighted by information."""
    C_WC, r_WC = state.cameras[:, :3, :3], state.cameras[:, :3, 3]
    C_WH = C_WC @ state.roots[..., :3, :3]
    offset = jnp.einsum("tij,htj->hti", C_WC, state.roots[..., :3, 3])
    found = []
    for h in range(len(state.roots)):
        if h in without:
            continue
        one = jax.tree.map(lambda x: x[h], prediction)
        found.append(motion.scale_from_motion(one, C_WH[h], r_WC, offset[h]))
    usable = [f for f in found if np.isfinite(f.value) and f.value > 0]
    if not usable:
        return ScaleStart()
    errors = np.array([f.standard_error for f in usable])
    errors = np.where(
        np.isfinite(errors), errors, 0.5 * np.array([f.value for f in usable])
    )
    weight = 1 / np.maximum(errors, 1e-6) ** 2
    value = float(np.sum(weight * [f.value for f in usable]) / weight.sum())
    return ScaleStart(value, float(weight.sum() ** -0.5))
