"""An iterated extended Kalman filter of one person's body, frame after frame.

The state is that of a fit (`costs.Fit`): root orientation, pelvis, posture. It is
predicted by a constant velocity of the root and the posture's first-order
autoregression, and updated by the keypoints of one frame and the lifted posture, with a
few Gauss--Newton steps (Bell and Cathey, The iterated Kalman filter update as a
Gauss-Newton method, 1993). The shape is given. Every frame costs the same.
"""

import dataclasses
from collections import deque

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import PeopleFit
from bodyslam_jax.geometry import so3
from bodyslam_jax.people.costs import Fit, Scene, linearise
from bodyslam_jax.people.fit import make_scene
from bodyslam_jax.people.frame_fit import first_fit
from bodyslam_jax.people.keypoint_errors import (
    CORRELATION_TIME,
    MIN_KEYPOINTS,
    in_pixels,
    keypoint_sigma,
    pixels_per_metre,
)
from bodyslam_jax.people.lift import (
    ASSETS,
    NUM_SIDE_FRAMES,
    SPACING_S,
    Lifter,
    lift,
    load_lifter,
)
from bodyslam_jax.people.skeleton import NUM_SHAPE
from bodyslam_jax.types import Intrinsics, Keypoints

_NUM_FIRST_STEPS, _NUM_STEPS = 15, 3
_ROOT_SIGMA = np.array([0.5, 0.5, 0.5, 0.5, 0.5, 2.0])
"""Uncertainty of the root before the first frame, rad and m."""
_TURN_SIGMA_RAD, _MOVE_SIGMA_M, _DEPTH_SIGMA_M = 0.05, 0.02, 0.02
"""Standard deviation of the deviation from a constant velocity of the root in a frame
of 1/30 s: rad, m across the view, m along it."""
_INNOVATION_FACTOR = 4.0
"""Factor on the posture prior's innovations, as in the fit of all frames."""
_VELOCITY_DECAY_S = 0.3
"""Time constant with which an unmeasured velocity decays, s."""
_CAUSAL_FACTOR = 1.5
"""Factor on the lifted posture's standard deviations: the network expects half a second
that is still to come, and gets the last frame repeated instead."""
_HISTORY_FRAMES = 2 * NUM_SIDE_FRAMES + 1
_MIN_GAP_S = 1e-3
"""Least time between two updates, s."""
_MAX_HISTORY_S = 3.0
"""Time for which keypoints are kept, for a filter that begins again, s."""
_ANCHOR_ROOT_SIGMA = np.array([0.1, 0.1, 0.1, 0.03, 0.03, 0.08])
"""Standard deviations of a root from a window's newest frames, rad and m."""
_ANCHOR_POSTURE_SIGMA = 0.4
"""Standard deviation of a posture from these frames, in those of the prior's
components."""


class Belief(eqx.Module):
    """The mean and covariance of a body's state."""

    fit: Fit
    turning: Float[Array, " 3"]
    """Angular velocity of the root in C, rad/s."""
    velocity: Float[Array, " 3"]
    """Velocity of the pelvis in C, m/s."""
    covariance: Float[Array, "n n"]
    """Covariance of root and posture, in the step of `Fit.moved`."""


@dataclasses.dataclass(frozen=True)
class Body:
    """A person in one frame."""

    T_CH: Float[np.ndarray, "4 4"]
    """Root in the camera frame, m."""
    body_pose: Float[np.ndarray, "23 3"]
    """θ, rad."""


class PersonFilter:
    """The belief about one person, and the keypoints of the last second."""

    def __init__(
        self,
        intrinsics: Intrinsics,
        body: BodyModel,
        fps: float,
        settings: PeopleFit = PeopleFit(),
        definition: str = "unknown",
    ) -> None:
        self.intrinsics, self.fps = intrinsics, fps
        self.scene = make_scene(intrinsics, body, fps, settings, definition)
        self.lifter = load_lifter(ASSETS[settings.lifter])
        self.recent: deque[tuple[float, np.ndarray, np.ndarray]] = deque()
        self.belief: Belief | None = None
        self.time = 0.0

    def update(
        self,
        time: float,
        points: Float[np.ndarray, "25 3"],
        shape: Float[np.ndarray, " 10"],
    ) -> Body | None:
        """Returns the body at `time` (s), by keypoints (u px, v px, confidence) and a
        shape; `None` with fewer keypoints than a first frame needs."""
        uv, sigma = self._measured(points)
        self.recent.append((time, uv, sigma))
        while time - self.recent[0][0] > _MAX_HISTORY_S:
            self.recent.popleft()
        return self._step(time, uv, sigma, shape)

    def predicted(self, time: float) -> Body | None:
        """Returns the body at a `time` (s) after the last frame, whose keypoints nobody
        looked for; `None` before the first frame. The belief stays as it is."""
        if self.belief is None:
            return None
        gap = jnp.asarray(max(time - self.time, 0.0), self.scene.intrinsics.dtype)
        fps = jnp.asarray(self.fps, gap.dtype)
        return _as_body(*_ahead(self.scene, self.belief, gap, fps))

    def anchor(self, time: float, body: Body, shape: Float[np.ndarray, " 10"]) -> None:
        """Begins again at an earlier time, with a body that a window has solved, and
        filters the keypoints since then once more, at the lifting network's rate."""
        if self.belief is None or time < self.recent[0][0] - SPACING_S:
            return
        dtype = self.scene.intrinsics.dtype
        prior = self.scene.prior
        angles = body.body_pose[:21].reshape(63) - np.asarray(prior.mean)
        latent = np.linalg.lstsq(np.asarray(prior.basis), angles, rcond=None)[0]
        fit = Fit(
            jnp.asarray(body.T_CH[:3, :3], dtype),
            jnp.asarray(body.T_CH[:3, 3], dtype),
            jnp.asarray(latent, dtype),
        )
        sigma = np.concatenate(
            [_ANCHOR_ROOT_SIGMA, np.full(len(latent), _ANCHOR_POSTURE_SIGMA)]
        )
        self.belief = dataclasses.replace(
            self.belief, fit=fit, covariance=jnp.asarray(np.diag(sigma**2), dtype)
        )
        newest = self.recent[-1][0]
        self.time = time
        for at, uv, known in list(self.recent):
            if at - self.time >= SPACING_S - 1e-6 or (
                at == newest and at - self.time > _MIN_GAP_S
            ):
                self._step(at, uv, known, shape)

    def _step(
        self,
        time: float,
        uv: Float[np.ndarray, "25 2"],
        sigma: Float[np.ndarray, " 25"],
        shape: Float[np.ndarray, " 10"],
    ) -> Body | None:
        enough = np.isfinite(sigma).sum() >= MIN_KEYPOINTS
        if self.belief is None and not enough:
            return None
        dtype = self.scene.intrinsics.dtype
        history = self._history(time)
        depth = None if self.belief is None else float(self.belief.fit.position[2])
        if depth is None:
            scale = pixels_per_metre(uv[None], sigma[None], self.fps)
        else:
            scale = np.array([float(self.intrinsics.params[0]) / depth])
        alike = max(1.0, CORRELATION_TIME * self.fps)
        pixels = in_pixels(sigma[None], scale)[0] * alike**0.5
        full = np.concatenate([shape, np.zeros(NUM_SHAPE - 10)])
        number = lambda x: jnp.asarray(x, dtype)
        given = (
            *(number(x) for x in history),
            *(number(x) for x in (uv, pixels, full)),
        )
        first = self.belief is None
        gap = 1 / self.fps if first else max(time - self.time, _MIN_GAP_S)
        belief = self.belief or _blank(self.scene)
        self.belief = _updated(
            self.scene,
            self.lifter,
            belief,
            jnp.asarray(first),
            number(gap),
            number(self.fps),
            jnp.asarray(_NUM_FIRST_STEPS if first else _NUM_STEPS),
            *given,
        )
        self.time = time
        if not np.isfinite(np.asarray(self.belief.covariance)).all():
            # Keypoints of no body; the next frame begins anew.
            self.belief = None
            return None
        return self.body()

    def body(self) -> Body:
        """Returns the mean of the belief.

        **Raises:** `ValueError` before the first frame.
        """
        if self.belief is None:
            raise ValueError("belief: none before the first frame.")
        fit = self.belief.fit
        return _as_body(fit, _decode(self.scene, fit.latent))

    def _measured(
        self, points: Float[np.ndarray, "25 3"]
    ) -> tuple[Float[np.ndarray, "25 2"], Float[np.ndarray, " 25"]]:
        found = Keypoints(points[None, None, :, :2], points[None, None, :, 2])
        return points[:, :2], keypoint_sigma(found, self.intrinsics, 0)[0]

    def _history(
        self, time: float
    ) -> tuple[Float[np.ndarray, "w 25 2"], Float[np.ndarray, "w 25"]]:
        """Returns the keypoints of the last second, `SPACING_S` apart, the newest
        last."""
        times = np.array([r[0] for r in self.recent if r[0] <= time])
        wanted = time - SPACING_S * np.arange(_HISTORY_FRAMES - 1, -1, -1)
        near = np.abs(times[None] - wanted[:, None]).argmin(axis=1)
        uv, sigma = (np.stack([self.recent[k][i] for k in near]) for i in (1, 2))
        return uv, sigma


def _as_body(fit: Fit, pose: Float[Array, "23 3"]) -> Body:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.asarray(fit.orientation), np.asarray(fit.position)
    return Body(T, np.asarray(pose, float))


def _blank(scene: Scene) -> Belief:
    k = scene.prior.basis.shape[1]
    dtype = scene.intrinsics.dtype
    fit = Fit(
        jnp.eye(3, dtype=dtype), jnp.array([0, 0, 3.0], dtype), jnp.zeros(k, dtype)
    )
    sigma = np.concatenate([_ROOT_SIGMA, np.ones(k)])
    still = jnp.zeros(3, dtype)
    return Belief(fit, still, still, jnp.asarray(np.diag(sigma**2), dtype))


@eqx.filter_jit
def _decode(scene: Scene, latent: Float[Array, " k"]) -> Float[Array, "23 3"]:
    return scene.prior.decode(latent)


@eqx.filter_jit
def _ahead(
    scene: Scene, belief: Belief, gap: Float[Array, ""], fps: Float[Array, ""]
) -> tuple[Fit, Float[Array, "23 3"]]:
    fit, _ = _predicted(scene, belief, gap, fps)
    return fit, scene.prior.decode(fit.latent)


@eqx.filter_jit
def _updated(
    scene: Scene,
    lifter: Lifter,
    belief: Belief,
    first: Array,
    gap: Float[Array, ""],
    fps: Float[Array, ""],
    steps: Int[Array, ""],
    recent_uv: Float[Array, "w 25 2"],
    recent_sigma: Float[Array, "w 25"],
    uv: Float[Array, "25 2"],
    sigma: Float[Array, " 25"],
    shape: Float[Array, " s"],
) -> Belief:
    rate = jnp.asarray(1 / SPACING_S, uv.dtype)
    given = scene.intrinsics, recent_uv, recent_sigma, rate
    guessed, usable = lift(lifter, *given)
    last = jax.tree.map(lambda a: a[-1], guessed)
    lifted = last.widened(
        jnp.where(usable[-1], _CAUSAL_FACTOR, jnp.inf).astype(uv.dtype)
    )
    started = first_fit(scene, uv, sigma, last)
    predicted, covariance = _predicted(scene, belief, gap, fps)
    choose = lambda a, b: jnp.where(first, a, b)
    predicted = jax.tree.map(choose, started, predicted)
    covariance = choose(belief.covariance, covariance)
    size = len(covariance)
    information = jnp.linalg.inv(covariance)
    # Before the first frame the posture's prior is about its mean.
    centre = choose(jnp.zeros_like(predicted.latent), predicted.latent)

    def equations(fit: Fit) -> tuple[Array, Array]:
        normal = linearise(scene, fit, shape, uv, sigma, lifted)
        turn = so3.log(fit.orientation @ predicted.orientation.T)
        moved = fit.position - predicted.position
        away = jnp.concatenate([turn, moved, fit.latent - centre])
        return normal.hessian + information, normal.gradient + information @ away

    def step(_: Array, fit: Fit) -> Fit:
        hessian, gradient = equations(fit)
        little = 1e-3 * jnp.diag(jnp.diagonal(hessian))
        factor = jax.scipy.linalg.cho_factor(hessian + little)
        move = -jax.scipy.linalg.cho_solve(factor, gradient)
        # No turn of more than half a radian at once.
        largest = jnp.max(jnp.abs(move[:3]))
        return fit.moved(move * jnp.minimum(1.0, 0.5 / jnp.maximum(largest, 1e-9)))

    fit = jax.lax.fori_loop(0, steps, step, predicted)
    hessian, _ = equations(fit)
    spread = jnp.linalg.inv(hessian + 1e-6 * jnp.eye(size, dtype=hessian.dtype))
    turned = so3.log(fit.orientation @ belief.fit.orientation.T) / gap
    moved = (fit.position - belief.fit.position) / gap
    share = jnp.minimum(1.0, gap / (_VELOCITY_DECAY_S / 3))
    mean = lambda new, old: choose(jnp.zeros_like(old), old + share * (new - old))
    return Belief(
        fit,
        mean(turned, belief.turning),
        mean(moved, belief.velocity),
        (spread + spread.T) / 2,
    )


def _predicted(
    scene: Scene, belief: Belief, gap: Float[Array, ""], fps: Float[Array, ""]
) -> tuple[Fit, Float[Array, "n n"]]:
    frames = gap * fps
    fading = jnp.exp(-gap / _VELOCITY_DECAY_S)
    travel = _VELOCITY_DECAY_S * (1 - fading)
    a1, a2 = scene.prior.autoregression.T
    lag = jnp.clip(a1 / (1 - a2), 0.0, 0.999) ** frames
    fit = belief.fit
    moved = Fit(
        so3.exp(belief.turning * travel) @ fit.orientation,
        fit.position + belief.velocity * travel,
        lag * fit.latent,
    )
    depth = jnp.maximum(moved.position[2], 0.3)
    moved = eqx.tree_at(lambda f: f.position, moved, moved.position.at[2].set(depth))
    root = jnp.array(
        [_TURN_SIGMA_RAD] * 3 + [_MOVE_SIGMA_M] * 2 + [_DEPTH_SIGMA_M], gap.dtype
    )
    ticks = gap * 30.0
    noise = jnp.concatenate([root**2 * ticks, _INNOVATION_FACTOR * (1 - lag**2)])
    keep = jnp.concatenate([jnp.ones(6, gap.dtype), lag])
    covariance = keep[:, None] * belief.covariance * keep + jnp.diag(noise)
    return moved, covariance
