"""Error terms of the factor graph, in the order of Section 3.6 of the paper.

Henning et al., BodySLAM, ECCV 2022. What they have in common is in `_abstract.py`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from bodyslam_jax.body import KEYPOINT_NAMES, BodyModel, local_keypoints
from bodyslam_jax.camera import project
from bodyslam_jax.graph._abstract import (
    AbstractFactor,
    AbstractFrameFactor,
    Frame,
    Limbs,
    Shared,
    Touch,
)
from bodyslam_jax.graph._displacement import before, displacements
from bodyslam_jax.graph._keypoint_curvature import keypoint_curvature
from bodyslam_jax.graph._keypoint_jacobian import (
    keypoint_jacobian,
    turning_joints,
)
from bodyslam_jax.graph._robust import AbstractLoss, Squared, squared_norm
from bodyslam_jax.graph._state import State, compose, inverse_right_jacobian
from bodyslam_jax.motion import leg_length


class Reprojection(AbstractFactor):
    """Static landmarks seen by the moving camera: `u(T_WC^-1 l) - z`.

    Both are in the unscaled map, so the scale s does not enter.
    """

    frame: Int[Array, " m"]
    landmark: Int[Array, " m"]
    pixel: Float[Array, "m 2"]
    sigma: Float[Array, " m"]
    """Standard deviation of each pixel coordinate, px."""
    loss: AbstractLoss

    def residual(self, state: State) -> Float[Array, "m 2"]:
        camera = state.cameras[self.frame]
        offset = state.landmarks[self.landmark] - camera[:, :3, 3]
        # Fused sums: a product for each observation would be far too small.
        p_C = sum(camera[:, j, :3] * offset[:, j, None] for j in range(3))
        return (project(state.intrinsics, p_C) - self.pixel) / self.sigma[:, None]


class JointReprojection(AbstractFrameFactor):
    """Keypoints of the person: `u(T_CH p_H(θ, β)) - z`."""

    body: BodyModel
    pixel: Float[Array, "h t j 2"]
    sigma: Float[Array, "h t j"]
    """px; `inf` where there is no keypoint."""
    loss: AbstractLoss
    bias: float | Float[Array, ""] = 0.0
    """Share of the detector's own idea of hips, neck and shoulders, 1."""
    layout: str = eqx.field(static=True, default="body25")
    of_people = True
    frame_fields = ("pixel", "sigma")

    @property
    def touches(self) -> tuple[Touch, ...]:
        return ("root", 0), ("pose", 0), ("shape", 0), ("intrinsics", 0)

    @property
    def limbs(self) -> Limbs:
        count = len(KEYPOINT_NAMES[self.layout])
        return tuple(
            turning_joints(self.body, self.layout, (point,)) for point in range(count)
        )

    def data(self):
        return self.pixel, self.sigma

    def residual(self, state: State) -> Float[Array, "h t j 2"]:
        shape = state.shapes[:, None]
        p_H = local_keypoints(self.body, state.poses, shape, self.layout, self.bias)
        root = state.roots
        p_C = p_H @ root[..., :3, :3].swapaxes(-1, -2) + root[..., None, :3, 3]
        return (project(state.intrinsics, p_C) - self.pixel) / self.sigma[..., None]

    def local(self, data, window, shared):
        return self.jacobian(data, window, shared)[0]

    def jacobian(self, data, window, shared):
        pixel, sigma = data
        (frame,) = window
        C_CH = frame.root[:3, :3]
        p_H, by_pose, by_shape = keypoint_jacobian(
            self.body, frame.pose, shared.shape, self.layout, self.bias
        )
        p_C = p_H @ C_CH.T + frame.root[:3, 3]
        seen, push = jax.linearize(lambda p: project(shared.intrinsics, p), p_C)
        basis = jnp.eye(3, dtype=p_C.dtype)
        by_C = jnp.stack([push(jnp.broadcast_to(e, p_C.shape)) for e in basis], -1)
        by_C = by_C / sigma[:, None, None]
        by_H = by_C @ C_CH
        by_intrinsics = jax.jacfwd(lambda i: project(i, p_C))(shared.intrinsics)
        # p_C = C Exp(ω) p_H + r: dp_C/dω = -C [p_H]x, row by row the cross product.
        turn = jnp.cross(p_H[:, None, :], by_H)
        return (seen - pixel) / sigma[:, None], {
            ("root", 0): jnp.concatenate([turn, by_C], axis=-1),
            # Fused products: a matrix product for each keypoint would be too small.
            ("pose", 0): sum(
                (by_H[..., i, None] * by_pose[i][:, None] for i in (1, 2)),
                by_H[..., 0, None] * by_pose[0][:, None],
            ),
            ("shape", 0): by_H @ by_shape,
            ("intrinsics", 0): by_intrinsics / sigma[:, None, None],
        }

    def curvature(
        self, state: State
    ) -> tuple[Float[Array, "h t 72 72"], Float[Array, "h t 72 10"]]:
        """What `J^T J` leaves out of the cost's second derivatives, `Σ w r^T ∂²r`: by
        turns of the root, then of the joints (rad), and by those and shape.

        Weights of the loss are held, as the solver holds them. What perspective bends
        is left out as well, a share of the error over the body's size in the image.
        """

        def one(data, window, shared, _):
            residual, parts = self.jacobian(data, window, shared)
            (frame,) = window
            weight = self.loss.weight(squared_norm(residual))[:, None]
            by_C = parts["root", 0][..., 3:]
            pull = jnp.sum((weight * residual)[..., None] * by_C, axis=1)
            return keypoint_curvature(
                *(self.body, frame.pose, shared.shape, self.layout, self.bias),
                pull @ frame.root[:3, :3],
            )

        return self.map_frames(one, state)


class HumanMotion(AbstractFrameFactor):
    """The pelvis moves as the motion model predicts.

    `e_k = C_WH_{k-1}^T (r_WH_k - r_WH_{k-1}) - r̃_k` with `r_WH = s r'_WC + C_WC r_CH`,
    so that it is linear in s. With a correlation ρ the model's errors in successive
    frames are not taken for independent: the residual is `e_k - ρ e_{k-1}` over its
    own standard deviation.

    With a `body`, lengths are in lengths of the leg, whose steps the model predicts.
    Otherwise a smaller person in a smaller world has smaller errors in metres, and the
    estimate shrinks.
    """

    translation: Float[Array, "h t 3"]
    """r̃: predicted displacement from k-1 to k, in H_{k-1}, m (with `body`: legs)."""
    whitening: Float[Array, "h t 3 3"]
    """`W` with `W^T W` the inverse of the covariance (m^-1); 0 where not predicted."""
    correlation: Float[Array, "h t"]
    """ρ between the errors of k-1 and k; 0 where k-1 has no prediction."""
    loss: AbstractLoss = Squared()
    correlated: bool = eqx.field(static=True, default=True)
    """Whether any correlation is used; if not, a term spans two frames, not three."""
    body: BodyModel | None = None
    of_people = True
    frame_fields = ("translation", "whitening", "correlation")

    @property
    def touches(self) -> tuple[Touch, ...]:
        lags = range(3 if self.correlated else 2)
        return (
            *(("camera", lag) for lag in lags),
            *(("root", lag) for lag in lags),
            ("scale", 0),
            *((("shape", 0),) if self.body is not None else ()),
        )

    def data(self):
        previous = jnp.concatenate(
            [jnp.zeros_like(self.translation[:, :1]), self.translation[:, :-1]], axis=1
        )
        return self.translation, previous, self.whitening, self.correlation

    def local(self, data, window, shared):
        translation, previous, whitening, correlation = data
        leg = unit_length(self.body, shared)
        error = displacement(window[1], window[0], shared.scale) / leg - translation
        if self.correlated:
            last = displacement(window[2], window[1], shared.scale) / leg - previous
            error = (error - correlation * last) / jnp.sqrt(1 - correlation**2)
        return whitening @ error

    def jacobians(self, state):
        d, parts = displacements(state)
        jac = jnp.concatenate(list(parts.values()), axis=-1)
        leg = jnp.ones_like(state.shapes[:, :1])
        if self.body is not None:
            one = jax.value_and_grad(lambda b: leg_length(self.body, b))
            leg, by_shape = jax.vmap(one)(state.shapes)
            leg = leg[:, None]
            by_shape = -d[..., None] * (by_shape / leg**2)[:, None, None]
            jac = jnp.concatenate([jac / leg[..., None, None], by_shape], axis=-1)
        error = d / leg[..., None] - self.translation
        whitening, last = self.whitening, jnp.zeros_like(jac)
        if self.correlated:
            rho = self.correlation[..., None]
            error = error - rho * before(error)
            whitening = whitening / jnp.sqrt(1 - rho**2)[..., None]
            last = -rho[..., None] * before(jac)
        now, last = whitening @ jac, whitening @ last
        six = lambda x, i: x[..., 6 * i : 6 * i + 6]
        touches: dict[Touch, Array] = {("scale", 0): (now + last)[..., 24:25]}
        for i, name in enumerate(("camera", "root")):
            touches[name, 0] = six(now, 2 * i)
            touches[name, 1] = six(now, 2 * i + 1) + six(last, 2 * i)
            if self.correlated:
                touches[name, 2] = six(last, 2 * i + 1)
        if self.body is not None:
            touches["shape", 0] = (now + last)[..., 25:]
        return (whitening @ error[..., None])[..., 0], touches


class Posture(AbstractFrameFactor):
    """Each joint's rotation against a measured or predicted one.

    `e_k = Log(C̃_k^T C(θ_k))`, the geodesic form of the paper's `θ_k - θ̃_k`. Errors of a
    regressor last: with a correlation ρ the residual is the innovation
    `(e_k - ρ e_{k-1}) / (σ sqrt(1 - ρ²))`, and `e_k / σ` where a run of frames begins.
    """

    rotation: Float[Array, "h t 23 3"]
    """θ̃, axis-angle, rad"""
    sigma: Float[Array, "h t 23"]
    """Stationary standard deviation per axis, rad; `inf` where not measured."""
    correlation: Float[Array, "h t"]
    """ρ between the errors of k-1 and k; 0 at the start of a run."""
    loss: AbstractLoss = Squared()
    correlated: bool = eqx.field(static=True, default=True)
    predicted: bool = eqx.field(static=True, default=False)
    """Whether θ̃ is the motion model's prediction (the paper), not a regressor's."""
    of_people = True
    frame_fields = ("rotation", "sigma", "correlation")
    per_joint = True

    @property
    def touches(self) -> tuple[Touch, ...]:
        return (("pose", 0), ("pose", 1)) if self.correlated else (("pose", 0),)

    def data(self):
        t = self.rotation.shape[1]
        previous = self.rotation[:, jnp.maximum(jnp.arange(t) - 1, 0)]
        return self.rotation, previous, self.sigma, self.correlation

    def local(self, data, window, shared):
        rotation, previous, sigma, correlation = data
        error = rotation_between(rotation, window[0].pose)
        if self.correlated:
            last = rotation_between(previous, window[1].pose)
            error = (error - correlation * last) / jnp.sqrt(1 - correlation**2)
        return error / sigma[:, None]

    def residual(self, state: State) -> Float[Array, "h t 23 3"]:
        return self._innovation(rotation_between(self.rotation, state.poses))[0]

    def jacobians(self, state):
        error = rotation_between(self.rotation, state.poses)
        residual, now, earlier = self._innovation(error)
        by_error = inverse_right_jacobian(error)
        parts: dict[Touch, Array] = {("pose", 0): now[..., None] * by_error}
        if self.correlated:
            parts["pose", 1] = earlier[..., None] * before(by_error)
        return residual, parts

    def _innovation(self, error):
        """The residual, and what it takes of this frame's error and the last one's."""
        rho = self.correlation[..., None, None]
        now = 1 / (self.sigma[..., None] * jnp.sqrt(1 - rho**2))
        earlier = -rho * now
        if not self.correlated:
            return error / self.sigma[..., None], 1 / self.sigma[..., None], earlier
        return now * error + earlier * before(error), now, earlier


class Shape(AbstractFrameFactor):
    """Regressed shape: `β - β̃_k`. Regressors err alike in all frames of a video: one
    measurement, in one frame, says as much as it knows."""

    shape: Float[Array, "h t 10"]
    """β̃"""
    sigma: Float[Array, "h t 10"]
    """`inf` where not measured."""
    loss: AbstractLoss = Squared()
    of_people = True
    frame_fields = ("shape", "sigma")

    @property
    def touches(self) -> tuple[Touch, ...]:
        return (("shape", 0),)

    def data(self):
        return self.shape, self.sigma

    def local(self, data, window, shared):
        shape, sigma = data
        return (shared.shape - shape) / sigma


class OrientationChange(AbstractFrameFactor):
    """The person turns as the motion model predicts: `Log(C̃^T C_WH_{k-1}^T C_WH_k)`.

    The paper's model predicts it; its cost leaves it out.
    """

    rotation: Float[Array, "h t 3"]
    """Rotation vector from H_{k-1} to H_k, rad."""
    sigma: Float[Array, "h t"]
    """Per axis, rad; `inf` where not predicted."""
    loss: AbstractLoss = Squared()
    of_people = True
    frame_fields = ("rotation", "sigma")

    @property
    def touches(self) -> tuple[Touch, ...]:
        return ("camera", 0), ("camera", 1), ("root", 0), ("root", 1)

    def data(self):
        return self.rotation, self.sigma

    def local(self, data, window, shared):
        rotation, sigma = data
        now, before = (f.camera[:3, :3] @ f.root[:3, :3] for f in window)
        predicted = jaxlie.SO3.exp(rotation).as_matrix()
        return _log(predicted.T @ before.T @ now) / sigma


def displacement(before: Frame, now: Frame, scale: Array) -> Float[Array, " 3"]:
    """`C_WH_{k-1}^T (r_WH_k - r_WH_{k-1})`, m."""
    moved = scale * (now.camera[:3, 3] - before.camera[:3, 3])
    moved = moved + now.camera[:3, :3] @ now.root[:3, 3]
    moved = moved - before.camera[:3, :3] @ before.root[:3, 3]
    return before.root[:3, :3].T @ (before.camera[:3, :3].T @ moved)


def unit_length(body: BodyModel | None, shared: Shared) -> Float[Array, ""]:
    """The length of the person's leg, m; 1 m without a body."""
    if body is None or shared.shape is None:
        return jnp.ones_like(shared.scale)
    return leg_length(body, shared.shape)


def rotation_between(
    first: Float[Array, "*b 3"], second: Float[Array, "*b 3"]
) -> Float[Array, "*b 3"]:
    """`Log(Exp(first)^T Exp(second))`, at most pi long."""
    return compose(jaxlie.SO3.exp(-first), jaxlie.SO3.exp(second)).log()


def _log(rotation: Float[Array, "*b 3 3"]) -> Float[Array, "*b 3"]:
    return jaxlie.SO3.from_matrix(rotation).log()


@jax.jit
def runs(
    present: Bool[Array, "h t"], correlation: float | Float[Array, ""]
) -> Float[Array, "h t"]:
    """ρ where this frame and the one before are measured, 0 at the start of a run."""
    before = jnp.concatenate([jnp.zeros_like(present[:, :1]), present[:, :-1]], axis=1)
    return jnp.where(present & before, correlation, 0.0)


def whitening_of(
    covariance: Float[Array, "*b 3 3"], valid: Bool[Array, "*b"]
) -> Float[Array, "*b 3 3"]:
    """`W` with `W^T W` the inverse of the covariance; 0 where not valid."""
    eye = jnp.eye(3, dtype=covariance.dtype)
    safe = jnp.where(valid[..., None, None], covariance, eye)
    lower = jnp.linalg.cholesky(safe)
    inverse = jax.scipy.linalg.solve_triangular(
        lower, jnp.broadcast_to(eye, safe.shape), lower=True
    )
    return jnp.where(valid[..., None, None], inverse, 0.0)
