"""Cost of one posed body against the keypoints of one frame, and its linearisation.

The unknowns of a frame are a small rotation δ (left, in C) of the root orientation, the
pelvis position p_C and the latent posture z: `6 + k` numbers, followed by the 10 of
shape β that all frames share. The robust cost is that of Geman and McClure,
`ρ(s) = s / (1 + s / c²)` of the squared whitened distance s, as in SMPLify (Bogo et
al., 2016), which measures it in pixels.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from bodyslam_jax.geometry import so3
from bodyslam_jax.geometry.camera import project
from bodyslam_jax.people.posture_prior import PosturePrior
from bodyslam_jax.people.skeleton import Skeleton, place_points, pose_points

KEYPOINT_SIGMA = np.array(
    # Nose, neck, then shoulder, elbow, wrist of the right and of the left.
    [0.025, 0.050, 0.030, 0.025, 0.025, 0.030, 0.025, 0.025]
    # Middle of the hips, then hip, knee, ankle of the right and of the left.
    + [0.050, 0.050, 0.028, 0.028, 0.050, 0.028, 0.028]
    # Eyes, ears; big toe, small toe, heel of the left and of the right.
    + [0.025, 0.025, 0.030, 0.030, 0.040, 0.040, 0.035, 0.040, 0.040, 0.035]
)
"""Error of BODY_25 keypoints on the body, m: 0.4 of COCO's annotators' σ_k for an
adult, twice that at hips and neck, which every detector puts elsewhere (OpenPose
outside and below SMPL's, MediaPipe inside); heads differ by more than annotators."""

MIN_DEPTH_M = 0.3
"""Least distance from the camera at which a person is fitted."""


class Fit(eqx.Module):
    """Pose of one body in one frame (or, with a leading axis, in each of many)."""

    orientation: Float[Array, "*b 3 3"]
    """R_CH."""
    position: Float[Array, "*b 3"]
    """Position of the pelvis joint in C, m."""
    latent: Float[Array, "*b k"]
    """Posture, in standard deviations of the prior's components."""

    def moved(self, step: Float[Array, "*b n"]) -> "Fit":
        """Returns the pose after a step: a rotation (left, rad), a translation (m), and
        a change of the latent posture. The depth is kept above `MIN_DEPTH_M`."""
        turn = so3.exp(step[..., :3])
        position = self.position + step[..., 3:6]
        depth = jnp.maximum(position[..., 2:], MIN_DEPTH_M)
        return Fit(
            turn @ self.orientation,
            jnp.concatenate([position[..., :2], depth], -1),
            self.latent + step[..., 6:],
        )


class Lifted(eqx.Module):
    """Posture predicted from the keypoints around a frame (`lift`), with its
    uncertainty."""

    orientation: Float[Array, "*b 3 3"]
    """R_CH."""
    latent: Float[Array, "*b k"]
    latent_sigma: Float[Array, "*b k"]
    """Standard deviation of each component, in units of the prior's."""
    turn_sigma: Float[Array, "*b"]
    """Standard deviation of the orientation, rad per axis."""

    def widened(self, factor: Float[Array, "*b"]) -> "Lifted":
        """Returns the posture with its standard deviations multiplied by `factor`."""
        return Lifted(
            self.orientation,
            self.latent,
            self.latent_sigma * factor[..., None],
            self.turn_sigma * factor,
        )


class Scene(eqx.Module):
    """Data that all frames and all initial values share."""

    skeleton: Skeleton
    prior: PosturePrior
    intrinsics: Float[Array, " i"]
    robust_scale: Float[Array, ""]
    """Scale c of the robust loss on keypoints, in standard deviations."""
    limit_sigma: Float[Array, ""]
    """Standard deviation of the soft limits of joint angles, rad."""
    upright_weight: Float[Array, ""]
    """Weight 1/σ² of the body axis' lean out of the image plane (sine)."""
    lift_scale: Float[Array, ""]
    """Scale c of the robust loss on the lifted posture, in standard deviations of one
    component."""


class Normal(eqx.Module):
    """Gauss--Newton normal equations of one frame."""

    hessian: Float[Array, "*b n n"]
    cross: Float[Array, "*b n s"]
    """Block between the frame's unknowns and the shape."""
    shape_hessian: Float[Array, "*b s s"]
    gradient: Float[Array, "*b n"]
    shape_gradient: Float[Array, "*b s"]
    cost: Float[Array, "*b"]


def cost(
    scene: Scene,
    fit: Fit,
    shape: Float[Array, " s"],
    uv: Float[Array, "25 2"],
    sigma: Float[Array, " 25"],
    lifted: Lifted,
) -> Float[Array, ""]:
    """Returns the cost of one frame: robust keypoints, soft joint limits, upright prior
    and lifted posture.

    The prior on posture is excluded: it is temporal in a chain and static in a single
    frame.
    """
    angles = scene.prior.angles(fit.latent)
    _, local = place_points(scene.skeleton, angles, shape)
    p_C = local @ fit.orientation.T + fit.position
    residual = (project(scene.intrinsics, p_C) - uv) / sigma[:, None]
    beyond = _beyond_limits(scene, angles) / scene.limit_sigma
    unlike = jnp.sum(_unlike(fit.orientation, fit.latent, lifted) ** 2)
    return 0.5 * (
        jnp.sum(robust(jnp.sum(residual**2, -1), scene.robust_scale)[0])
        + robust(unlike, _lift_scale(scene, lifted))[0]
        + jnp.sum(beyond**2)
        + scene.upright_weight * fit.orientation[2, 1] ** 2
    )


def linearise(
    scene: Scene,
    fit: Fit,
    shape: Float[Array, " s"],
    uv: Float[Array, "25 2"],
    sigma: Float[Array, " 25"],
    lifted: Lifted,
) -> Normal:
    """Returns `cost` with its first and (Gauss--Newton) second derivatives."""
    size = 6 + fit.latent.shape[-1]
    angles = scene.prior.angles(fit.latent)
    points = pose_points(scene.skeleton, angles, shape)
    rotated = points.keypoints @ fit.orientation.T
    p_C = rotated + fit.position
    view = jax.vmap(jax.jacfwd(lambda p: project(scene.intrinsics, p)))(p_C)
    view = view / sigma[:, None, None]
    residual = (project(scene.intrinsics, p_C) - uv) / sigma[:, None]
    value, weight = robust(jnp.sum(residual**2, -1), scene.robust_scale)

    # Derivatives of pixels by rotation (δ x p moves p), translation, posture, shape.
    eye = jnp.eye(3, dtype=p_C.dtype)
    turned = jnp.swapaxes(jnp.cross(eye[None], rotated[:, None]), -1, -2)
    view_H = view @ fit.orientation
    by_angle = jnp.einsum("kcx,kjx->kcj", view_H, points.by_angle.reshape(25, 63, 3))
    columns = [view @ turned, view, by_angle @ scene.prior.basis]
    columns.append(view_H @ points.by_shape)
    jac = jnp.concatenate(columns, axis=-1).reshape(50, -1)
    weighted = (jac * jnp.repeat(weight, 2)[:, None]).T
    full = weighted @ jac
    gradient = weighted @ residual.reshape(-1)
    hessian, gradient_own = full[:size, :size], gradient[:size]

    beyond = _beyond_limits(scene, angles) / scene.limit_sigma
    active = (beyond != 0).astype(beyond.dtype) / scene.limit_sigma
    limits = scene.prior.basis * active[:, None]
    hessian = hessian.at[6:, 6:].add(limits.T @ limits)
    gradient_own = gradient_own.at[6:].add(limits.T @ beyond)

    unlike = _unlike(fit.orientation, fit.latent, lifted)
    by_own = _unlike_by_own(lifted)
    unlikely, trust = robust(jnp.sum(unlike**2), _lift_scale(scene, lifted))
    hessian = hessian + trust * by_own.T @ by_own
    gradient_own = gradient_own + trust * by_own.T @ unlike

    lean = fit.orientation[2, 1]
    # d(Exp(δ) R)[2, 1] = δ x (R e_y), third component.
    axis = jnp.stack([fit.orientation[1, 1], -fit.orientation[0, 1], 0 * lean])
    hessian = hessian.at[:3, :3].add(scene.upright_weight * jnp.outer(axis, axis))
    gradient_own = gradient_own.at[:3].add(scene.upright_weight * lean * axis)
    total = 0.5 * (
        jnp.sum(value) + unlikely + jnp.sum(beyond**2) + scene.upright_weight * lean**2
    )
    return Normal(
        hessian,
        full[:size, size:],
        full[size:, size:],
        gradient_own,
        gradient[size:],
        total,
    )


def robust(
    squared: Float[Array, "*b"], scale: Float[Array, ""]
) -> tuple[Float[Array, "*b"], Float[Array, "*b"]]:
    """Returns Geman and McClure's ρ of squared whitened distances, and its
    derivative."""
    ratio = 1 + squared / scale**2
    return squared / ratio, 1 / ratio**2


def _lift_scale(scene: Scene, lifted: Lifted) -> Float[Array, ""]:
    return scene.lift_scale * (3 + lifted.latent.shape[-1]) ** 0.5


def _unlike(
    orientation: Float[Array, "3 3"], latent: Float[Array, " k"], lifted: Lifted
) -> Float[Array, " d"]:
    """Returns the difference of a body from the lifted one, in standard deviations; 0
    where these are infinite."""
    turn = so3.log(orientation @ lifted.orientation.T) / lifted.turn_sigma
    return jnp.concatenate([turn, (latent - lifted.latent) / lifted.latent_sigma])


def _unlike_by_own(lifted: Lifted) -> Float[Array, "d n"]:
    """Returns the derivatives of `_unlike` with respect to the frame's unknowns.

    The derivative of a rotation's logarithm is approximated by the identity. The exact
    one maps the logarithm to itself, so the gradient of its square is exact.
    """
    count = lifted.latent.shape[-1]
    by_turn = jnp.eye(3, dtype=lifted.latent.dtype) / lifted.turn_sigma
    rows = [
        jnp.pad(by_turn, ((0, 0), (0, 3 + count))),
        jnp.pad(jnp.diag(1 / lifted.latent_sigma), ((0, 0), (6, 0))),
    ]
    return jnp.concatenate(rows)


def _beyond_limits(scene: Scene, angles: Float[Array, " 63"]) -> Float[Array, " 63"]:
    below, above = scene.prior.lower - angles, angles - scene.prior.upper
    return jnp.maximum(above, 0) - jnp.maximum(below, 0)
