"""Bundle adjustment of some frames with a lens: focal length, aspect, distortion, zoom.

The unknowns are cameras, points and the parameters of a lens: the logarithms of the
focal length and of fx / fy, one radial coefficient, the delay of a rolling shutter, and
a piecewise linear focal length. `LensFit` estimates them, and their change when blocks
of tracks are left out, by which `sfm.lens` compares models.
"""

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.arrays import sum_by
from bodyslam_jax.sfm.bundle import ERROR_PER_SIGMA, Views

_CAUCHY_SCALE = 2.0
"""Scale of the loss, in standard deviations of an observation."""
_MAX_ITERATIONS, _MIN_DECREASE, _NUM_SMALL_DECREASES = 150, 1e-5, 3
"""Largest number of iterations, and relative decrease of the cost below which they end
if it occurs so often in a row: focal length and distortion follow a curved valley."""
_INITIAL_DAMPING = 1e-6
"""Initial damping, relative to the diagonal: it is small, as the cost has little
curvature along the lens's parameters."""
_NUM_CONSTANT_PARAMETERS = 4
"""Number of parameters of the lens that are constant over time: focal length, aspect,
k1 and readout; those of the zoom follow."""
NUM_TIME_PIECES = 6
"""Number of pieces of the video whose frames are left out in turn."""


@dataclasses.dataclass(frozen=True)
class LensViews(Views):
    """Observations, with their displacement by a rolling shutter."""

    slant: Float[np.ndarray, "m 2"]
    """Displacement by a readout that lasts a frame, at depth 1."""

    def __getitem__(self, index: np.ndarray) -> "LensViews":
        return LensViews(
            self.frame[index], self.landmark[index], self.xy[index], self.slant[index]
        )

    @staticmethod
    def of(views: Views, rows: float) -> "LensViews":
        """Computes `slant`: each point's motion in a frame times its row's delay after
        the middle row, of an image that is `rows` high at depth 1."""
        order = np.lexsort((views.frame, views.landmark))
        xy, frame = views.xy[order], views.frame[order]
        same = np.diff(views.landmark[order]) == 0
        step = np.diff(xy, axis=0) / np.maximum(np.diff(frame), 1)[:, None]
        step = step * same[:, None]
        zero, none = np.zeros((1, 2)), np.zeros(1, bool)
        before, after = np.concatenate([zero, step]), np.concatenate([step, zero])
        sides = np.concatenate([none, same]).astype(int)
        sides += np.concatenate([same, none])
        flow = np.empty_like(xy)
        flow[order] = (before + after) / np.maximum(sides, 1)[:, None]
        slant = flow * views.xy[:, 1:] / rows
        return LensViews(views.frame, views.landmark, views.xy, slant)


@dataclasses.dataclass(frozen=True)
class Unknowns:
    """Cameras, points and lens of `LensFit`."""

    R: Float[np.ndarray, "k 3 3"]
    centre: Float[np.ndarray, "k 3"]
    points: Float[np.ndarray, "l 3"]
    lens: Float[np.ndarray, " g"]
    """Logarithms of focal length and aspect, k1, readout (frames), and the logarithm of
    the zoom at each knot."""

    def moved(
        self, cameras: np.ndarray, points: np.ndarray, lens: np.ndarray
    ) -> "Unknowns":
        return Unknowns(
            so3.exp(cameras[:, :3]) @ self.R,
            self.centre + cameras[:, 3:],
            self.points + points,
            self.lens + lens,
        )

    def with_points(self, points: np.ndarray) -> "Unknowns":
        return dataclasses.replace(self, points=points)


@dataclasses.dataclass(frozen=True)
class Spread:
    """Covariance of the lens, and solutions without single blocks of tracks."""

    naive: Float[np.ndarray, "g g"]
    """Covariance of the lens if all observations were independent."""
    covariance: Float[np.ndarray, "g g"]
    """Covariance of the lens by the jackknife."""
    without: tuple[Unknowns, ...]
    """The solution without each block."""


class LensFit:
    """Bundle adjustment with a lens; the first camera is held."""

    def __init__(
        self, views: LensViews, basis: np.ndarray, block: np.ndarray, least: float
    ):
        self.views, self.basis, self.least = views, basis, least
        self.parts: list[tuple[np.ndarray, LensViews]] = []
        """The points of each block, and its observations."""
        for b in range(int(block.max()) + 1):
            points = np.flatnonzero(block == b)
            own = views[np.flatnonzero(block[views.landmark] == b)]
            landmark = np.searchsorted(points, own.landmark)
            self.parts.append((points, dataclasses.replace(own, landmark=landmark)))

    def sigma(self, x: Unknowns) -> float:
        """Returns the robust standard deviation of an observation, at depth 1."""
        error = float(np.median(_errors(self.views, self.basis, x)))
        return max(error / ERROR_PER_SIGMA, self.least)

    def cost(self, x: Unknowns, sigma: float, information: np.ndarray) -> float:
        """Returns twice the negative log-posterior, up to a constant."""
        loss = _cost(self.views, self.basis, x, sigma).sum()
        return float(loss + (information * x.lens**2).sum())

    def solve(self, x: Unknowns, information: np.ndarray) -> Unknowns:
        """Returns the most probable unknowns, by Levenberg--Marquardt."""
        damping, small = _INITIAL_DAMPING, 0
        for _ in range(_MAX_ITERATIONS):
            sigma = self.sigma(x)
            system = _linearise(self.views, self.basis, x, sigma)
            cost = self.cost(x, sigma, information)
            better = None
            for _ in range(5):
                step = _step(system, damping, information, x.lens)
                if step is not None:
                    trial = x.moved(*step)
                    new = self.cost(trial, sigma, information)
                    if new < cost:
                        better = trial, new
                        break
                damping *= 10
            if better is None:
                break
            (x, new), damping = better, max(damping / 10, 1e-9)
            small = small + 1 if cost - new < _MIN_DECREASE * cost else 0
            if small == _NUM_SMALL_DECREASES:
                break
        return x

    def jackknife(self, x: Unknowns, information: np.ndarray) -> Spread | None:
        """Returns the solutions without one block each, by one Gauss--Newton step from
        `x`, and the covariance; `None` if a system is singular.

        Errors of neighbouring tracks are common to a block; those of all tracks at a
        time (shutter, blur, a map that bends) to a piece of the video. The covariance
        is the sum of both. Without a piece its zoom is unknown, so that the covariance
        of a zoom is that over blocks alone.
        """
        sigma, num, count = self.sigma(x), len(x.lens), len(x.R)
        reduced = []
        for points, views in self.parts:
            part = x.with_points(x.points[points])
            reduced.append(_reduce(_linearise(views, self.basis, part, sigma)))
        S = np.sum([s for s, _ in reduced], axis=0)
        rhs = np.sum([r for _, r in reduced], axis=0)
        systems = [(S - s, rhs - r) for s, r in reduced]
        for frames in np.array_split(np.arange(count), NUM_TIME_PIECES):
            rest = self.views[np.flatnonzero(~np.isin(self.views.frame, frames))]
            often = np.bincount(rest.landmark, minlength=len(x.points)) >= 2
            rest = rest[np.flatnonzero(often[rest.landmark])]
            points, landmark = np.unique(rest.landmark, return_inverse=True)
            rest = dataclasses.replace(rest, landmark=landmark)
            part = x.with_points(x.points[points])
            systems.append(_reduce(_linearise(rest, self.basis, part, sigma)))
        naive = _inverse(S, information)
        steps = []
        for system in systems:
            step = _newton(*system, information, x.lens)
            if step is None or naive is None:
                return None
            steps.append(step)
        if naive is None:
            return None
        without = []
        for step in steps[: len(reduced)]:
            cameras = np.concatenate([np.zeros((1, 6)), step[:-num].reshape(-1, 6)])
            without.append(x.moved(cameras, np.zeros_like(x.points), step[-num:]))
        lenses = np.array([step[-num:] for step in steps])
        covariance = _jackknife(lenses[: len(reduced)])
        constant = np.arange(num) < _NUM_CONSTANT_PARAMETERS
        covariance = covariance + constant[:, None] * constant * _jackknife(
            lenses[len(reduced) :]
        )
        return Spread(naive, covariance, tuple(without))

    def held_out(self, spread: Spread, sigma: float) -> np.ndarray:
        """Returns the cost of each block's observations by cameras and lens of the
        others."""
        costs = []
        for (points, views), x in zip(self.parts, spread.without, strict=True):
            x = _located(views, self.basis, x.with_points(x.points[points]), sigma)
            costs.append(_cost(views, self.basis, x, sigma).sum())
        return np.array(costs)


def _newton(S, rhs, information, lens) -> np.ndarray | None:
    """Returns the step to the minimum of reduced normal equations with the lens's
    prior; `None` if they are singular."""
    num, rhs = len(lens), rhs.copy()
    rhs[-num:] += information * lens
    try:
        return -cho_solve(cho_factor(_regular(S, information)), rhs)
    except (LinAlgError, ValueError):
        return None


def _regular(S: np.ndarray, information: np.ndarray) -> np.ndarray:
    S, lens = S.copy(), np.arange(len(S) - len(information), len(S))
    S[lens, lens] += information
    S[np.diag_indices(len(S))] += 1e-10 * np.diag(S) + 1e-12 * np.trace(S)
    return S


def _inverse(S: np.ndarray, information: np.ndarray) -> np.ndarray | None:
    """Returns the covariance of the lens by reduced normal equations, `None`
    if they are singular."""
    unit = np.eye(len(S))[:, -len(information) :]
    try:
        return cho_solve(cho_factor(_regular(S, information)), unit)[-unit.shape[1] :]
    except (LinAlgError, ValueError):
        return None


def _jackknife(left_out: Float[np.ndarray, "b g"]) -> Float[np.ndarray, "g g"]:
    """Returns the covariance of an estimate from those without
    one of `b` pieces each."""
    away = left_out - left_out.mean(axis=0)
    return (len(away) - 1) / len(away) * away.T @ away


def _located(
    views: LensViews, basis: np.ndarray, x: Unknowns, sigma: float
) -> Unknowns:
    """Fits each point by itself, with cameras and lens held."""
    num = len(x.points)
    cost = sum_by(views.landmark, _cost(views, basis, x, sigma), num)
    damping = np.full(num, 1e-4)
    for _ in range(8):
        V, g = _points_system(views, basis, x, sigma)
        V = V + damping[:, None, None] * np.eye(3) * np.diagonal(V, 0, 1, 2)[:, None]
        V = V + 1e-9 * np.trace(V, axis1=1, axis2=2).mean() * np.eye(3)
        trial = x.with_points(x.points - np.linalg.solve(V, g[..., None])[..., 0])
        new = sum_by(views.landmark, _cost(views, basis, trial, sigma), num)
        better = new < cost
        x = x.with_points(np.where(better[:, None], trial.points, x.points))
        cost = np.where(better, new, cost)
        damping = np.where(better, damping / 10, damping * 10)
    return x


def _predict(v: LensViews, basis: np.ndarray, x: Unknowns):
    offset = x.points[v.landmark] - x.centre[v.frame]
    p_C = np.einsum("mij,mj->mi", x.R[v.frame], offset)
    front = p_C[:, 2] > 1e-6
    z = np.where(front, p_C[:, 2], 1.0)
    q = p_C[:, :2] / z[:, None]
    # Held beyond 63 degrees from the axis, where the polynomial would run away.
    r2 = np.minimum((q**2).sum(axis=-1), 4.0)
    zoom = x.lens[0] + basis[v.frame] @ x.lens[4:]
    half = 0.5 * x.lens[1] * np.array([1.0, -1.0])
    size = np.exp(zoom[:, None] + half)
    radial = 1 + x.lens[2] * r2
    predicted = size * q * radial[:, None]
    return p_C, front, z, q, r2, size, predicted, radial


def _errors(views: LensViews, basis: np.ndarray, x: Unknowns) -> np.ndarray:
    _, front, *_, predicted, _ = _predict(views, basis, x)
    predicted = predicted + x.lens[3] * views.slant
    error = np.linalg.norm(predicted - views.xy, axis=-1)
    return np.where(front, np.minimum(error, 10.0), 10.0)


def _cost(views: LensViews, basis: np.ndarray, x: Unknowns, sigma: float) -> np.ndarray:
    """Returns twice the negative log-likelihood of each observation (Cauchy loss)."""
    error = _errors(views, basis, x) / sigma / _CAUCHY_SCALE
    return _CAUCHY_SCALE**2 * np.log1p(error**2)


def _jacobians(v: LensViews, basis: np.ndarray, x: Unknowns, sigma: float):
    """Returns whitened residuals and their derivatives by camera, point and lens."""
    p_C, front, z, q, r2, size, predicted, radial = _predict(v, basis, x)
    r = (predicted + x.lens[3] * v.slant - v.xy) / sigma
    weight = front / (1 + (r**2).sum(axis=-1) / _CAUCHY_SCALE**2)
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
    G[..., 3] = v.slant
    G[..., 4:] = predicted[..., None] * basis[v.frame][:, None]
    G *= root / sigma
    return A, B, G, r * root[..., 0]


def _points_system(views: LensViews, basis: np.ndarray, x: Unknowns, sigma: float):
    """Returns the normal equations of each point alone."""
    _, B, _, r = _jacobians(views, basis, x, sigma)
    num = len(x.points)
    V = sum_by(views.landmark, np.einsum("mki,mkj->mij", B, B), num)
    return V, sum_by(views.landmark, np.einsum("mki,mk->mi", B, r), num)


def _linearise(v: LensViews, basis: np.ndarray, x: Unknowns, sigma: float):
    """Returns the normal equations of cameras with lens, points, and between them."""
    A, B, G, r = _jacobians(v, basis, x, sigma)
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
    return U, V, M, np.concatenate([g_c, g_g]), g_p


def _reduce(system, damping: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Returns the normal equations of cameras and lens, with points eliminated."""
    U, V, M, g, g_p = system
    flat = M.reshape(-1, len(U))
    V = V * (1 + damping * np.eye(3))
    Y = np.linalg.solve(V, np.concatenate([M, g_p[..., None]], axis=-1))
    S = U - flat.T @ Y[..., :-1].reshape(-1, len(U))
    return S, g - flat.T @ Y[..., -1].ravel()


def _step(system, damping: float, information: np.ndarray, lens: np.ndarray):
    """Returns the damped step of cameras, points and lens; `None` if it is singular."""
    U, V, M, _, g_p = system
    width, num = len(U), len(lens)
    S, rhs = _reduce(system, damping)
    S[np.diag_indices(width)] += damping * np.diag(U) + 1e-12 * np.trace(U)
    rhs[-num:] += information * lens
    S[np.arange(width - num, width), np.arange(width - num, width)] += information
    try:
        step = -cho_solve(cho_factor(S), rhs)
    except (LinAlgError, ValueError):
        return None
    V = V * (1 + damping * np.eye(3))
    points = -np.linalg.solve(V, (g_p + M @ step)[..., None])[..., 0]
    cameras = np.concatenate([np.zeros((1, 6)), step[:-num].reshape(-1, 6)])
    return cameras, points, step[-num:]
