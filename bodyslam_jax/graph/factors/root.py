"""Error terms of where people are and which way they face, beyond the paper."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from bodyslam_jax.body import BodyModel
from bodyslam_jax.geometry.so3 import log
from bodyslam_jax.graph.factor import FrameFactor, Key
from bodyslam_jax.graph.factors.human_motion import unit_length
from bodyslam_jax.graph.losses import Loss, Squared
from bodyslam_jax.graph.whitening import innovation


class RootSmoothness(FrameFactor):
    """The pelvis keeps its velocity in the world: `(r_k - 2 r_{k-1} + r_{k-2}) / σ`.

    `r = s r'_WC + C_WC r_CH` is in m, or with a `body` in lengths of the leg, as for
    `HumanMotion`.
    """

    sigma: Float[Array, "h t"]
    """m, or legs, per frame squared; `inf` where a frame of the three is missing."""
    loss: Loss = Squared()
    body: BodyModel | None = None
    of_people = True
    time_fields = ("sigma",)
    padding = {"sigma": jnp.inf}

    @property
    def keys(self) -> tuple[Key, ...]:
        return (
            *(("camera", lag) for lag in range(3)),
            *(("root", lag) for lag in range(3)),
            ("scale", 0),
            *((("shape", 0),) if self.body is not None else ()),
        )

    def data(self):
        return self.sigma

    def frame_residual(self, data, window, shared):
        now, before, first = (
            shared.scale * f.camera[:3, 3] + f.camera[:3, :3] @ f.root[:3, 3]
            for f in window
        )
        return (now - 2 * before + first) / unit_length(self.body, shared) / data


class AngularAccelerationPrior(FrameFactor):
    """The person keeps turning in the world as before.

    `(Log(C_{k-1}^T C_k) - Log(C_{k-2}^T C_{k-1})) / σ` of C = C_WC C_CH: the turn from
    k-1 to k, in rad per frame, against the one before it.
    """

    sigma: Float[Array, "h t"]
    """rad per frame squared; `inf` where a frame of the three is missing."""
    loss: Loss = Squared()
    of_people = True
    time_fields = ("sigma",)
    padding = {"sigma": jnp.inf}

    @property
    def keys(self) -> tuple[Key, ...]:
        return tuple((name, lag) for name in ("camera", "root") for lag in range(3))

    def data(self):
        return self.sigma

    def frame_residual(self, data, window, shared):
        now, before, first = (f.camera[:3, :3] @ f.root[:3, :3] for f in window)
        return (log(before.T @ now) - log(first.T @ before)) / data


class RootOrientation(FrameFactor):
    """Regressed orientation of the person in the camera, `Log(C̃_CH^T C_CH)`, with
    errors that last as those of `BodyPosePrior` do."""

    orientation: Float[Array, "h t 3 3"]
    """C̃_CH"""
    sigma: Float[Array, "h t"]
    """Stationary standard deviation per axis, rad; `inf` where not measured."""
    correlation: Float[Array, "h t"]
    """ρ between the errors of k-1 and k; 0 at the start of a run."""
    loss: Loss = Squared()
    of_people = True
    time_fields = ("orientation", "sigma", "correlation")
    padding = {"sigma": jnp.inf, "correlation": 0.0}

    @property
    def keys(self) -> tuple[Key, ...]:
        return ("root", 0), ("root", 1)

    def data(self):
        previous = jnp.roll(self.orientation, 1, axis=1)
        return self.orientation, previous, self.sigma, self.correlation

    def frame_residual(self, data, window, shared):
        measured, previous, sigma, correlation = data
        error = log(measured.T @ window[0].root[:3, :3])
        before = log(previous.T @ window[1].root[:3, :3])
        return innovation(error, before, correlation) / sigma


class RootPositionPrior(FrameFactor):
    """Regressed place of the person in the camera, where no keypoints tell it better.

    `(x - x̃ z/z̃) / z̃` and the same of y, its direction, and `z/z̃ - 1`, its depth; with
    errors that last as those of `BodyPosePrior` do. Linear, so that nothing happens at
    z = 0.
    """

    place: Float[Array, "h t 3"]
    """r̃_CH, m; z̃ above 0 where measured."""
    sigma: Float[Array, "h t 2"]
    """Stationary standard deviations of direction and depth, of the distance; `inf`
    where not measured."""
    correlation: Float[Array, "h t"]
    """ρ between the errors of k-1 and k; 0 at the start of a run."""
    loss: Loss = Squared()
    of_people = True
    time_fields = ("place", "sigma", "correlation")
    padding = {"sigma": jnp.inf, "correlation": 0.0}

    @property
    def keys(self) -> tuple[Key, ...]:
        return ("root", 0), ("root", 1)

    def data(self):
        # What is missing may lie anywhere, also where there is no direction: at 0.
        known = jnp.isfinite(self.sigma).any(axis=-1, keepdims=True)
        place = jnp.where(known, self.place, 1.0)
        return place, jnp.roll(place, 1, axis=1), self.sigma, self.correlation

    def frame_residual(self, data, window, shared):
        measured, previous, sigma, correlation = data
        error = _away(measured, window[0].root[:3, 3])
        before = _away(previous, window[1].root[:3, 3])
        across, depth = sigma
        spread = jnp.stack([across, across, depth])
        return innovation(error, before, correlation) / spread


def _away(measured: Float[Array, " 3"], place: Float[Array, " 3"]) -> Array:
    """Error of direction and of depth, of the measured distance."""
    share = place / measured[2]
    direction = share[:2] - measured[:2] / measured[2] * share[2]
    return jnp.append(direction, share[2] - 1)


class UprightPrior(FrameFactor):
    """The person stands up: y of the root frame, in the world, along a known up.

    `(C_WC C_CH e_y - u) / σ`: the length of the difference is the angle that the trunk
    leans by, in rad while that is small.
    """

    up: Float[Array, " 3"]
    """u, a unit vector in the world."""
    sigma: Float[Array, "h t"]
    """rad; `inf` where the person is not there."""
    loss: Loss = Squared()
    of_people = True
    time_fields = ("sigma",)
    padding = {"sigma": jnp.inf}

    @property
    def keys(self) -> tuple[Key, ...]:
        return ("camera", 0), ("root", 0)

    def data(self):
        return self.sigma

    def frame_residual(self, data, window, shared):
        (frame,) = window
        person = frame.camera[:3, :3] @ frame.root[:3, 1]
        return (person - self.up) / data
