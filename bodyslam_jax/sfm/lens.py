"""Self-calibration from the tracks: pixel aspect ratio, distortion, zoom over time.

The reconstruction assumes one pinhole camera. This module tests the assumption by
bundle adjustment of some of its frames with the ratio of the focal lengths, one radial
coefficient and a piecewise linear focal length as additional parameters. Their
covariance allows for errors that are correlated within a track: the sandwich estimator
for clustered errors (Liang & Zeger, Biometrika 1986).
"""

import copy
import dataclasses

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.grouped_sums import sum_by
from bodyslam_jax.sfm.bundle import Scene, Views

_MOST_FRAMES, _MOST_POINTS = 26, 300
_FEWEST_POINTS = 40
_FRAMES_A_KNOT = 15
_MOST_KNOTS = 8
_FOCAL, _ASPECT, _RADIAL, _KNOT = 0.2, 0.4, 0.5, 0.5
"""Prior standard deviations: logarithms of focal length and aspect, k1, log zoom."""
_CAUCHY = 2.0
"""Scale of the loss, in standard deviations of an observation."""
_ITERATIONS = 45
_DOUBT = 3.0
"""Significance from which the deviations are tested one by one."""
_SHARE = 0.75
"""Share of the total decrease in cost from which a single deviation suffices."""
_HELD = 1e12
"""Information on parameters that are held constant."""


@dataclasses.dataclass(frozen=True)
class Lens:
    """Deviations from one pinhole camera with square pixels, with their errors."""

    aspect: float
    """Logarithm of `fx / fy`, relative to the assumed camera."""
    aspect_sigma: float
    radial: float
    """k1, of directions at depth 1."""
    radial_sigma: float
    zoom: Float[np.ndarray, " t"]
    """Logarithm of the focal length in each frame, 0 in the first that is known."""
    zoom_sigma: float
    """Of the largest change."""
    focal: float
    """Logarithm of the focal length, relative to the assumed camera."""
    gain: float
    """Relative decrease of the median error."""

    @property
    def zoom_range(self) -> float:
        return float(np.ptp(self.zoom)) if len(self.zoom) else 0.0


def examine_lens(
    scene: Scene,
    views: Views,
    registered: np.ndarray,
    *,
    pixel: float,
) -> Lens | None:
    """The most probable lens given `views`; `None` if there are too few observations.

    Args:
        scene: cameras and points to begin with.
        registered: frames whose camera is known.
        pixel: size of a pixel at depth 1: errors are thought no smaller than a fifth.
    """
    frames = np.flatnonzero(registered)
    if len(frames) < 6:
        return None
    few = np.linspace(0, len(frames) - 1, min(_MOST_FRAMES, len(frames)))
    frames = frames[np.unique(few.round().astype(int))]
    views = views[np.flatnonzero(np.isin(views.frame, frames))]
    count = np.bincount(views.landmark, minlength=len(scene.points))
    points = np.argsort(-count, kind="stable")[:_MOST_POINTS]
    points = np.sort(points[count[points] >= 3])
    if len(points) < _FEWEST_POINTS:
        return None
    views = views[np.flatnonzero(np.isin(views.landmark, points))]
    fit = _Fit(
        Views(
            np.searchsorted(frames, views.frame),
            np.searchsorted(points, views.landmark),
            views.xy,
        ),
        _knots(frames),
    )
    start = _Unknowns(
        scene.R_CW[frames],
        scene.centre[frames],
        scene.points[points],
        np.zeros(3 + fit.basis.shape[1]),
    )
    # For a fair comparison the plain camera is adjusted as long as the full model.
    plain, plain_error, _ = fit.solve(start, pixel / 5, free=False)
    focal, _, _ = fit.alone(slice(0, 1)).solve(plain, pixel / 5, free=True)
    found, error, spread = fit.solve(focal, pixel / 5, free=True)
    if spread is None:
        return None
    if (np.abs(found.lens[1:]) > _DOUBT * np.sqrt(np.diag(spread))[1:]).any():
        # If a single deviation suffices the others stay at zero.
        sigma = max(error / 1.18, pixel / 5)
        gain = fit.cost(focal, sigma) - fit.cost(found, sigma)
        singles = []
        for which in (slice(1, 2), slice(2, 3), slice(3, None)):
            one, *rest = fit.alone(which).solve(focal, pixel / 5, free=True)
            singles.append((fit.cost(focal, sigma) - fit.cost(one, sigma), one, *rest))
        best = max(singles, key=lambda single: single[0])
        if best[0] > _SHARE * gain and best[3] is not None:
            _, found, error, spread = best
    ends = int(frames[0]), int(frames[-1])
    basis = _basis(np.arange(len(registered)), *ends, fit.knots)
    zoom = basis @ found.lens[3:]
    shown = fit.basis @ found.lens[3:]
    low, high = int(np.argmin(shown)), int(np.argmax(shown))
    change = np.concatenate([np.zeros(3), fit.basis[high] - fit.basis[low]])
    sigma = np.sqrt(np.diag(spread))
    return Lens(
        aspect=float(found.lens[1]),
        aspect_sigma=float(sigma[1]),
        radial=float(found.lens[2]),
        radial_sigma=float(sigma[2]),
        zoom=zoom,
        zoom_sigma=float(np.sqrt(max(change @ spread @ change, 0.0))),
        focal=float(found.lens[0]),
        gain=1 - error / max(plain_error, 1e-12),
    )


def _knots(frames: Int[np.ndarray, " k"]) -> tuple[int, np.ndarray]:
    span = int(frames[-1] - frames[0])
    count = int(np.clip(span // _FRAMES_A_KNOT, 1, _MOST_KNOTS))
    return count, _basis(frames, int(frames[0]), int(frames[-1]), count)


def _basis(frames: np.ndarray, first: int, last: int, count: int) -> np.ndarray:
    """Piecewise linear functions that are 0 in the first frame: (frames, count)."""
    at = np.clip((frames - first) / max(last - first, 1), 0, 1) * count
    return np.maximum(0, 1 - np.abs(at[:, None] - np.arange(1, count + 1)))


@dataclasses.dataclass(frozen=True)
class _Unknowns:
    R: Float[np.ndarray, "k 3 3"]
    centre: Float[np.ndarray, "k 3"]
    points: Float[np.ndarray, "l 3"]
    lens: Float[np.ndarray, " g"]
    """Focal length, aspect, radial, and the zoom at each knot."""

    def moved(self, cameras: np.ndarray, points: np.ndarray, lens: np.ndarray):
        return _Unknowns(
            so3.exp(cameras[:, :3]) @ self.R,
            self.centre + cameras[:, 3:],
            self.points + points,
            self.lens + lens,
        )


class _Fit:
    """Bundle adjustment with a lens; the first camera is held."""

    def __init__(self, views: Views, knots: tuple[int, np.ndarray]):
        self.views = views
        self.knots, self.basis = knots
        sigma = [_FOCAL, _ASPECT, _RADIAL] + [_KNOT] * self.knots
        self.information = 1 / np.square(sigma)

    def alone(self, which: slice) -> "_Fit":
        """With the focal length and only some of the rest free."""
        other = copy.copy(self)
        held = np.full(len(self.information), _HELD)
        held[0], held[which] = self.information[0], self.information[which]
        other.information = held
        return other

    def solve(
        self, x: _Unknowns, least: float, *, free: bool
    ) -> tuple[_Unknowns, float, np.ndarray | None]:
        """The best unknowns, the median error and the covariance of the lens."""
        damping = 1e-4
        for _ in range(_ITERATIONS):
            sigma = max(float(np.median(self._errors(x))) / 1.18, least)
            system = self._linearise(x, sigma)
            cost = self.cost(x, sigma)
            better = None
            for _ in range(5):
                step = self._step(system, damping, x, free)
                if step is not None:
                    trial = x.moved(*step)
                    new = self.cost(trial, sigma)
                    if new < cost:
                        better = trial, new
                        break
                damping *= 10
            if better is None:
                break
            (x, new), damping = better, max(damping / 10, 1e-9)
            if cost - new < 2e-5 * cost:
                break
        error = float(np.median(self._errors(x)))
        if not free:
            return x, error, None
        sigma = max(error / 1.18, least)
        return x, error, self._covariance(self._linearise(x, sigma), x)

    def _predict(self, x: _Unknowns):
        v = self.views
        offset = x.points[v.landmark] - x.centre[v.frame]
        p_C = np.einsum("mij,mj->mi", x.R[v.frame], offset)
        front = p_C[:, 2] > 1e-6
        z = np.where(front, p_C[:, 2], 1.0)
        q = p_C[:, :2] / z[:, None]
        r2 = np.minimum((q**2).sum(axis=-1), 4.0)
        zoom = x.lens[0] + self.basis[v.frame] @ x.lens[3:]
        half = 0.5 * x.lens[1] * np.array([1.0, -1.0])
        size = np.exp(zoom[:, None] + half)
        radial = 1 + x.lens[2] * r2
        return p_C, front, z, q, r2, size, size * q * radial[:, None], radial

    def _errors(self, x: _Unknowns) -> np.ndarray:
        _, front, *_, predicted, _ = self._predict(x)
        error = np.linalg.norm(predicted - self.views.xy, axis=-1)
        return np.where(front, error, 10.0)

    def cost(self, x: _Unknowns, sigma: float) -> float:
        error = np.minimum(self._errors(x), 10.0) / sigma / _CAUCHY
        loss = _CAUCHY**2 * np.log1p(error**2).sum()
        return float(loss + (self.information * x.lens**2).sum())

    def _linearise(self, x: _Unknowns, sigma: float):
        v = self.views
        p_C, front, z, q, r2, size, predicted, radial = self._predict(x)
        r = (predicted - v.xy) / sigma
        weight = front / (1 + (r**2).sum(axis=-1) / _CAUCHY**2)
        root = np.sqrt(weight)[:, None, None]
        D = np.zeros((len(z), 2, 2))
        D[:, 0, 0] = D[:, 1, 1] = radial
        D += 2 * x.lens[2] * q[:, :, None] * q[:, None]
        D *= size[:, :, None]
        pi = np.zeros((len(z), 2, 3))
        pi[:, 0, 0] = pi[:, 1, 1] = 1 / z
        pi[:, :, 2] = -q / z[:, None]
        pi = D @ pi * root / sigma
        B = pi @ x.R[v.frame]
        cross = np.zeros((len(z), 3, 3))
        a, b, c = p_C.T
        cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = c, -b, a
        cross[:, 1, 0], cross[:, 2, 0], cross[:, 2, 1] = -c, b, -a
        A = np.concatenate([pi @ cross, -B], axis=-1)
        G = np.empty((len(z), 2, len(x.lens)))
        G[..., 0] = predicted
        G[..., 1] = 0.5 * predicted * np.array([1.0, -1.0])
        G[..., 2] = size * q * r2[:, None]
        G[..., 3:] = predicted[..., None] * self.basis[v.frame][:, None]
        G *= root / sigma
        r = r * root[..., 0]
        k, l = len(x.R), len(x.points)
        V = sum_by(v.landmark, np.einsum("mki,mkj->mij", B, B), l)
        V += 1e-9 * np.trace(V, axis1=1, axis2=2).mean() * np.eye(3)
        W = np.zeros((l, 3, k, 6))
        W[v.landmark, :, v.frame] = np.einsum("mki,mkj->mij", B, A)
        M = np.concatenate(
            [
                W[:, :, 1:].reshape(l, 3, -1),
                sum_by(v.landmark, np.einsum("mki,mkj->mij", B, G), l),
            ],
            axis=-1,
        )
        size_c, width = 6 * (k - 1), M.shape[-1]
        U = np.zeros((width, width))
        blocks = sum_by(v.frame, np.einsum("mki,mkj->mij", A, A), k)
        cross_cg = sum_by(v.frame, np.einsum("mki,mkj->mij", A, G), k)
        for i in range(1, k):
            at = slice(6 * i - 6, 6 * i)
            U[at, at] = blocks[i]
            U[at, size_c:], U[size_c:, at] = cross_cg[i], cross_cg[i].T
        U[size_c:, size_c:] = np.einsum("mki,mkj->ij", G, G)
        g_c = sum_by(v.frame, np.einsum("mki,mk->mi", A, r), k)[1:].ravel()
        g_g = np.einsum("mki,mk->i", G, r)
        g_p = sum_by(v.landmark, np.einsum("mki,mk->mi", B, r), l)
        return U, V, M, np.concatenate([g_c, g_g]), g_p, (A, B, G, r)

    def _step(self, system, damping: float, x: _Unknowns, free: bool):
        U, V, M, g, g_p, _ = system
        width, num = len(U), len(x.lens)
        V_inverse = np.linalg.inv(V * (1 + damping * np.eye(3)))
        Y = V_inverse @ M
        flat = M.reshape(-1, width)
        S = U - flat.T @ Y.reshape(-1, width)
        S[np.diag_indices(width)] += damping * np.diag(U) + 1e-12 * np.trace(U)
        rhs = g - flat.T @ np.einsum("lij,lj->li", V_inverse, g_p).ravel()
        rhs[-num:] += self.information * x.lens
        S[np.arange(width - num, width), np.arange(width - num, width)] += (
            self.information
        )
        if not free:
            S, rhs = S[:-num, :-num], rhs[:-num]
        try:
            step = -cho_solve(cho_factor(S), rhs)
        except (LinAlgError, ValueError):
            return None
        if not free:
            step = np.concatenate([step, np.zeros(num)])
        points = -np.einsum("lij,lj->li", V_inverse, g_p) - Y @ step
        cameras = np.concatenate([np.zeros((1, 6)), step[:-num].reshape(-1, 6)])
        return cameras, points, step[-num:]

    def _covariance(self, system, x: _Unknowns) -> np.ndarray | None:
        U, V, M, _, _, (A, B, G, r) = system
        v, width, num = self.views, len(U), len(x.lens)
        Y = np.linalg.inv(V) @ M
        S = U - M.reshape(-1, width).T @ Y.reshape(-1, width)
        S[np.diag_indices(width)] += 1e-10 * np.diag(U)
        S[np.arange(width - num, width), np.arange(width - num, width)] += (
            self.information
        )
        # Rows of the inverse that the lens needs, then the scores of each track.
        unit = np.zeros((width, num))
        unit[-num:] = np.eye(num)
        try:
            rows = cho_solve(cho_factor(S), unit)
        except (LinAlgError, ValueError):
            return None
        of_camera = np.concatenate([np.zeros((6, num)), rows[:-num]]).reshape(
            -1, 6, num
        )
        through = np.einsum("mki,mij->mkj", A, of_camera[v.frame]) + G @ rows[-num:]
        through -= B @ (Y @ rows)[v.landmark]
        scores = sum_by(v.landmark, np.einsum("mkj,mk->mj", through, r), len(x.points))
        clusters = len(x.points)
        spread = scores.T @ scores * clusters / max(clusters - num, 1)
        return spread + rows[-num:]
