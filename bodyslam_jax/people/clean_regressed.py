"""Cleans regressed bodies for initialisation.

Regressors process single images: depth jitters by centimetres per frame, front and back
are confused in some frames, frames are missing, β varies. Postures are not smoothed:
that would shorten the steps of a walk, from which the scale is estimated.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import solveh_banded

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import PeopleFit
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.arrays import SIGMA_OF_MEDIAN
from bodyslam_jax.geometry.camera import project
from bodyslam_jax.geometry.lengths import padded_length
from bodyslam_jax.geometry.whittaker import curvature_bands
from bodyslam_jax.people.costs import MIN_DEPTH_M, robust
from bodyslam_jax.people.hypotheses import find_turned
from bodyslam_jax.people.keypoint_errors import (
    ROBUST_SCALE,
    in_pixels,
    keypoint_sigma,
    pixels_per_metre,
)
from bodyslam_jax.people.person_state import (
    DEPTH_JITTER_M,
    POSITION_JITTER_M,
    PersonState,
    bodies_from_roots,
    roots_from_bodies,
)
from bodyslam_jax.people.skeleton import (
    NUM_SHAPE,
    Skeleton,
    make_skeleton,
    place_points,
)
from bodyslam_jax.types import Bodies, Intrinsics, Keypoints

_RELATIVE_DEPTH_SIGMA = 0.05
"""Relative standard deviation of a regressor's depth."""
_HALF_TURN = np.diag([-1.0, 1.0, -1.0])
"""Rotation by π about H's y axis."""
_PLACING_STEPS = 10
_REGRESSOR_SHAPE_GAIN = 1.2
"""Regressed shapes are shrunk towards the mean, by a factor of 0.5 to 0.8 with an error
of 0.3; this gain is about the best linear estimate."""


def prepare_bodies(
    bodies: Bodies,
    keypoints: Keypoints | None,
    intrinsics: Intrinsics,
    body: BodyModel,
    fps: float,
    settings: PeopleFit = PeopleFit(),
) -> Bodies:
    """Returns bodies with one shape per person, corrected front-back confusions, filled
    short gaps, and smooth depth.

    The pelvis is fitted to the keypoints, if any, with the posture held fixed and the
    regressor's depth as a measurement. Person h of `bodies` is person h of `keypoints`.
    """
    roots = roots_from_bodies(bodies, body)
    definition = "unknown" if keypoints is None else keypoints.definition
    skeleton = make_skeleton(body, 0.0, definition)
    prepared = PersonState(
        present=roots.present.copy(),
        T_CH=roots.T_CH.copy(),
        body_pose=roots.body_pose.copy(),
        shape=_shape_gain(bodies, settings) * roots.shape,
    )
    for h in range(len(roots.present)):
        T_CH = prepared.T_CH[h]
        valid = roots.present[h] & (T_CH[:, 2, 3] > MIN_DEPTH_M)
        prepared.present[h] = valid
        where = np.flatnonzero(valid)
        if not len(where):
            continue
        uv = np.zeros((len(where), 25, 2))
        sigma = np.full((len(where), 25), np.inf)
        if keypoints is not None and h < len(keypoints.uv):
            uv = keypoints.uv[h, where]
            sigma = keypoint_sigma(keypoints, intrinsics, h)[where]
        if np.isfinite(sigma).any():
            sigma = in_pixels(sigma, pixels_per_metre(uv, sigma, fps))
        orientation, position = _place_person(
            skeleton, intrinsics, prepared, h, where, uv, sigma, fps
        )
        T_CH[where, :3, :3] = orientation
        T_CH[where, :3, 3] = position
        _fill_gaps(prepared, h, settings.max_gap * fps)
        T_CH[~prepared.present[h]] = np.eye(4)
    return bodies_from_roots(prepared, body)


def _shape_gain(bodies: Bodies, settings: PeopleFit) -> float:
    if settings.regressor_shape_gain is not None:
        return settings.regressor_shape_gain
    return _REGRESSOR_SHAPE_GAIN if bodies.shapes_regressed else 1.0


def _spread(values: np.ndarray) -> float:
    """Returns the standard deviation about zero, robustly from the median."""
    return SIGMA_OF_MEDIAN * float(np.median(np.abs(values)))


def _place_person(
    skeleton: Skeleton,
    intrinsics: Intrinsics,
    roots: PersonState,
    person: int,
    where: np.ndarray,
    uv: np.ndarray,
    sigma: np.ndarray,
    fps: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Returns orientation and pelvis position in C for the frames `where`, with
    front-back flips and jitter removed."""
    dtype = skeleton.offset.dtype
    T_CH = roots.T_CH[person, where]
    both = np.stack([T_CH[:, :3, :3], T_CH[:, :3, :3] @ _HALF_TURN], axis=1)
    angles = roots.body_pose[person, where, :21].reshape(-1, 63)
    depth_sigma = _RELATIVE_DEPTH_SIGMA * T_CH[:, 2, 3]
    rows = (both, angles, T_CH[:, :3, 3], uv, sigma, depth_sigma)
    length = padded_length(len(where)) - len(where)
    padded = [
        jnp.asarray(np.concatenate([a, np.repeat(a[-1:], length, axis=0)]), dtype)
        for a in rows
    ]
    shape = jnp.zeros(NUM_SHAPE, dtype).at[:10].set(roots.shape[person])
    camera = jnp.asarray(intrinsics.params, dtype)
    scale = jnp.asarray(ROBUST_SCALE, dtype)
    found = _place_bodies(skeleton, camera, shape, scale, *padded)
    position, predicted, joints = (np.asarray(a[: len(where)], float) for a in found)
    turned = find_turned(joints, where / fps, predicted, uv, sigma, ROBUST_SCALE)
    each, state = np.arange(len(where)), turned.astype(int)
    return both[each, state], _smooth(position[each, state], where, fps)


@eqx.filter_jit
def _place_bodies(
    skeleton: Skeleton,
    intrinsics: Float[Array, " i"],
    shape: Float[Array, " s"],
    scale: Float[Array, ""],
    orientation: Float[Array, "t 2 3 3"],
    angles: Float[Array, "t 63"],
    position: Float[Array, "t 3"],
    uv: Float[Array, "t 25 2"],
    sigma: Float[Array, "t 25"],
    depth_sigma: Float[Array, " t"],
) -> tuple[Float[Array, "t 2 3"], Float[Array, "t 2 25 2"], Float[Array, "t 2 24 3"]]:
    """Estimates the pelvis of each frame for both orientations, by robust
    Gauss--Newton.

    **Returns:** positions in C, keypoints of the body there, px, and joints about the
    pelvis in C.
    """

    def one(R, points, start, uv, sigma, depth_sigma):
        rotated = points @ R.T
        # Without keypoints only the regressor's own position is known.
        across = jnp.where(jnp.any(sigma < jnp.inf), 3.0, 0.01).astype(start.dtype)
        prior_sigma = jnp.stack([across, across, depth_sigma])

        def residuals(p):
            predicted = project(intrinsics, rotated + p)
            return (predicted - uv) / sigma[:, None]

        def step(_, p):
            r, jac = residuals(p), jax.jacfwd(residuals)(p)
            _, weight = robust(jnp.sum(r**2, -1), scale)
            weighted = jac * weight[:, None, None]
            prior = 1 / prior_sigma**2
            hessian = jnp.einsum("kci,kcj->ij", weighted, jac) + jnp.diag(prior)
            gradient = jnp.einsum("kci,kc->i", weighted, r) + prior * (p - start)
            moved = p - jnp.linalg.solve(hessian, gradient)
            return moved.at[2].max(MIN_DEPTH_M)

        p = jax.lax.fori_loop(0, _PLACING_STEPS, step, start)
        return p, project(intrinsics, rotated + p)

    def frame(R, angles, *rest):
        joints, points = place_points(skeleton, angles, shape)
        position, predicted = jax.vmap(lambda R: one(R, points, *rest))(R)
        return position, predicted, jax.vmap(lambda R: joints @ R.T)(R)

    return jax.vmap(frame)(orientation, angles, position, uv, sigma, depth_sigma)


def _smooth(
    position: Float[np.ndarray, "m 3"],
    where: np.ndarray,
    fps: float,
) -> Float[np.ndarray, "m 3"]:
    """Returns the positions with direction and depth robustly smoothed, at the frames
    `where`."""
    depth = position[:, 2]
    mean_depth = float(np.median(depth))
    # From 30 fps, where the jitters are stated: a random acceleration.
    slow = (30 / fps) ** 1.5
    across = POSITION_JITTER_M * slow / mean_depth
    coordinates = np.column_stack([position[:, :2] / depth[:, None], depth])
    jitter = (across, across, DEPTH_JITTER_M * slow)
    x, y, z = (
        _smooth_curve(values, where, sigma)
        for values, sigma in zip(coordinates.T, jitter)
    )
    return np.column_stack([x * z, y * z, z])


def _smooth_curve(
    values: Float[np.ndarray, " m"], where: np.ndarray, jitter: float
) -> Float[np.ndarray, " m"]:
    """Applies Whittaker's smoother with Student weights: second differences have the
    standard deviation `jitter`.

    The measurement noise is estimated from the values' second differences; its variance
    is multiplied by 10 for errors that are correlated over about ten frames.
    """
    if len(values) < 5:
        return values
    total = where[-1] - where[0] + 1
    index = where - where[0]
    noise = max(_spread(np.diff(values, 2)) / np.sqrt(6), 0.1 * jitter)
    sigma = noise * np.sqrt(10.0)
    stiffness = curvature_bands(int(total)) / jitter**2
    filled = np.interp(np.arange(total), index, values)
    weight = np.zeros(total)
    weight[index] = sigma**-2
    smooth = filled
    for _ in range(10):
        banded = stiffness.copy()
        banded[2] += weight + 1e-9 * sigma**-2
        smooth = solveh_banded(banded, (weight + 1e-9 * sigma**-2) * filled)
        error = (values - smooth[index]) / sigma
        weight[index] = sigma**-2 / (1 + error**2 / 4)
    return smooth[index]


def _fill_gaps(roots: PersonState, person: int, longest: float) -> None:
    """Interpolates gaps of up to `longest` frames, in place."""
    where = np.flatnonzero(roots.present[person])
    T_CH, pose = roots.T_CH[person], roots.body_pose[person]
    for a, b in zip(where[:-1], where[1:]):
        if not 1 < b - a <= longest + 1:
            continue
        share = np.arange(1, b - a) / (b - a)
        gap = slice(a + 1, b)
        from_, to = np.broadcast_to(T_CH[[a, b], None, :3, :3], (2, len(share), 3, 3))
        T_CH[gap, :3, :3] = so3.interpolate(from_, to, share)
        T_CH[gap, :3, 3] = T_CH[a, :3, 3] + share[:, None] * (
            T_CH[b, :3, 3] - T_CH[a, :3, 3]
        )
        size = (2, len(share), 23, 3, 3)
        from_, to = np.broadcast_to(so3.exp(pose[[a, b]])[:, None], size)
        joint_share = np.repeat(share[:, None], 23, axis=1)
        pose[gap] = so3.log(so3.interpolate(from_, to, joint_share))
        roots.present[person, gap] = True
