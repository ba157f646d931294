"""Uncertainty of places: people's pelvis joints and the height of the camera, in W.

The first camera and up fix the world W of a result: x and z of a place are relative to
that camera and to the direction in which it looks, y is the height above the floor. The
errors of a place are therefore errors relative to the first camera and to the floor:

- the marginal covariance of the joint problem, with the hidden variance of people's
  size (`JointEstimate.root_covariance`), and what contradicting cues add to the scale's
  (`scale_uncertainty.reported_sigma`), which moves places along the line from the first
  camera;
- the focal length, which moves places along the view;
- up: a tilt by δ moves a place across by δ times its height relative to the camera, and
  up or down by δ times its horizontal distance from where the feet stand, whose height
  is the floor's;
- the error of the pelvis within the body (`measured.joint_sigma`), which no frame
  averages out, as it is mostly of definitions and proportions.

All terms are variances that are added (the delta method), as their causes are
independent. Errors of one clip are mostly common to all of its frames.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from bodyslam_jax.body.skeleton import ANKLES, FEET, PELVIS
from bodyslam_jax.ground.stances import find_stances, toes_standing
from bodyslam_jax.types import JointEstimate, Result

_AXES = 3
"""Coordinates over which the squared error of a joint is spread."""
_LEVEL = [0, 2]
"""Horizontal axes of W."""


@dataclasses.dataclass(frozen=True)
class PlaceUncertainty:
    """Standard deviations of places in the world W of a result."""

    root_sigma: Float[np.ndarray, "h t 3"]
    """Standard deviations of the coordinates of each pelvis joint in W, m; 0 where the
    person is absent."""
    camera_height: float
    """Standard deviation of the height of the first camera above the floor, m; NaN
    without people."""


def place_uncertainty(
    joint: JointEstimate,
    result: Result,
    joint_sigma: Float[np.ndarray, "h t 24"],
    sizes: Float[np.ndarray, " h"],
    *,
    scale_sigma: float,
    up_sigma: float,
    focal_sigma: float,
) -> PlaceUncertainty | None:
    """Returns the standard deviations of the places of a result; `None` where the
    covariance was not computed, or nothing determines the scale or up.

    Args:
        joint: the optimum of which `result` is the metric, upright version.
        joint_sigma: expected error of joints within the body, m.
        sizes: relative standard deviation of the stature of each person.
        scale_sigma: standard deviation of the scale as reported, m per unit of the map;
            0 with a camera that does not move, whose height is as sure as the size of
            people.
        up_sigma: standard deviation of the vertical, rad.
        focal_sigma: relative standard deviation of the focal length.
    """
    covariance = joint.root_covariance
    if covariance is None or not np.isfinite([scale_sigma, up_sigma]).all():
        return None
    present = result.present
    pelvis = result.joints[:, :, PELVIS]
    eye = result.T_WC[0, :3, 3]
    floor = _middle_of_stances(joint, result)
    to = pelvis - eye
    turn = result.T_WC[0, :3, :3] @ joint.cameras[0, :3, :3].T
    variance = np.einsum("ab,htbc,ac->hta", turn, covariance, turn)
    # With a camera that does not move, the covariance has no scale: NaN, no more of it.
    more = np.nan_to_num(scale_sigma**2 - joint.scale_sigma**2) / result.scale**2
    variance += max(more, 0.0) * to**2
    view = result.T_WC[:, :3, 2]
    along = np.einsum("hta,ta->ht", to, view)[..., None] * view
    variance += (focal_sigma * along) ** 2
    variance[..., _LEVEL] += (up_sigma * to[..., 1:2]) ** 2
    # Feet define the floor: of the height above it the legs' length and posture err.
    ankles = (joint_sigma[..., list(ANKLES)] ** 2).mean(axis=-1)
    tilted = lambda at: up_sigma * np.linalg.norm((at - floor)[..., _LEVEL], axis=-1)
    legs = sizes[:, None] * pelvis[..., 1]
    variance[..., 1] = legs**2 + tilted(pelvis) ** 2 + ankles / _AXES
    variance += joint_sigma[..., PELVIS, None] ** 2 / _AXES
    size = scale_sigma / result.scale
    if not size and present.any():
        size = np.nanmin(sizes)
    return PlaceUncertainty(
        root_sigma=np.where(present[..., None], np.sqrt(variance), 0.0),
        camera_height=float(np.hypot(size * eye[1], tilted(eye))),
    )


def _middle_of_stances(joint: JointEstimate, result: Result) -> Float[np.ndarray, " 3"]:
    """Returns the median place of standing feet, of all feet if none stand, m; NaN
    without people."""
    feet = result.joints[:, :, list(FEET)]
    standing = toes_standing(joint.contacts)
    stances = find_stances(feet, result.present, result.fps, standing)
    places = np.concatenate([np.zeros((0, 3)), *stances])
    if not len(places):
        places = feet[result.present].reshape(-1, 3)
    return np.median(places, axis=0) if len(places) else np.full(3, np.nan)
