"""Self-calibration from the tracks: pixel aspect ratio, distortion, zoom over time.

The reconstruction assumes one ordinary camera: square pixels, little distortion, one
focal length. Other camera models are fitted by bundle adjustment of some of its frames,
with the ratio of the focal lengths, one radial coefficient and a piecewise linear focal
length as additional parameters, and compared by how well they predict tracks that had
no part in the fit: tracks are divided into blocks, neighbours in the image and in time,
and each block is predicted by cameras and lens of the others (K-fold cross-validation).

Errors of tracks are common to neighbours and last in time. So standard deviations are
those of the jackknife over blocks (Efron & Stein, Ann. Stat. 1981), and the logarithm
of a likelihood ratio counts for the share of independent observations that they imply
(magnitude adjustment of a composite likelihood; Varin, Reid & Firth, Stat. Sinica
2011).
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.grouped_sums import sum_by
from bodyslam_jax.sfm.bundle import Scene, Views

OTHER_FOCAL = ("focal",)
"""The ordinary camera with another focal length than a calibration's: what a deviation
is compared with there, which would otherwise win by freeing the focal length."""
_SINGLE = ("aspect", "radial", "zoom")
"""Deviations from an ordinary camera."""
_PAIRS = (("aspect", "radial"), ("radial", "zoom"))
"""Those that are considered together, if one of them is more probable than not."""
_MOST_FRAMES, _MOST_POINTS = 26, 300
_FEWEST_POINTS = 40
_FRAMES_A_KNOT = 15
_MOST_KNOTS = 8
_CAUCHY = 2.0
"""Scale of the loss, in standard deviations of an observation."""
_ITERATIONS, _LEAST_DECREASE, _SMALL = 150, 1e-5, 3
"""Most iterations, and the relative decrease in cost that ends them if it is as small
so often in a row: focal length and distortion go along a curved valley."""
_DAMPING = 1e-6
"""Initial damping, relative to the diagonal: what a camera's model leaves to be fitted
has little curvature of its own."""
_RESTARTS = 3
_MUCH_LOWER = 0.01
"""Times that the ordinary camera is fitted, and the share by which the cost must fall
for another."""
_BISECTIONS = 4
"""Blocks of tracks are halved so often: 16 blocks of about 19 tracks."""
_CONSTANT = 4
"""Parameters of the lens that do not change over time: focal length, aspect, k1 and
readout; those of the zoom follow."""
_TIMES = 6
"""Pieces of the video whose frames are left out in turn."""


@dataclasses.dataclass(frozen=True)
class LensPrior:
    """Standard deviations of a camera's parameters before the video was seen."""

    focal: tuple[float, float]
    """Of the logarithm of the focal length, of an ordinary camera and of one that
    deviates."""
    aspect: tuple[float, float]
    """Of the logarithm of fx / fy, the same."""
    radial: tuple[float, float]
    """Of k1, the same."""
    zoom: tuple[float, float]
    """Of the logarithm of the focal length at a knot over that of the first frame."""
    readout: float
    """Of the delay of the last row after the first (rolling shutter), in frames."""
    runs: float
    """Observations that count as one, because errors within a track are correlated."""
    odds: tuple[tuple[str, float], ...]
    """Prior odds of each deviation."""

    def information(self, model: tuple[str, ...], knots: int) -> np.ndarray:
        """Of focal length, aspect, k1 and the zoom's knots, in terms of the cost."""
        pick = lambda name: getattr(self, name)[name in model]
        focal = self.focal[bool(model)]
        sigma = [focal, pick("aspect"), pick("radial"), self.readout]
        sigma += [pick("zoom")] * knots
        return self.runs / np.square(sigma)

    def log_odds(self, model: tuple[str, ...]) -> float:
        """Logarithm of a model's prior odds over the ordinary camera."""
        return float(sum(np.log(odds) for name, odds in self.odds if name in model))


@dataclasses.dataclass(frozen=True)
class Lens:
    """A camera model fitted to the tracks, and the evidence for it."""

    model: tuple[str, ...]
    """Which deviations it allows: aspect, radial, zoom; none for an ordinary camera;
    `OTHER_FOCAL` where a calibration is thought to be wrong."""
    evidence: float
    """Logarithm of the likelihood ratio to an ordinary camera, by held-out tracks; to
    that of `OTHER_FOCAL` where that is more probable."""
    log_odds: float
    """Logarithm of the posterior odds."""
    focal: float
    """Logarithm of the focal length, relative to the assumed camera."""
    focal_sigma: float
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
    readout: float
    """Delay of the last row after the first, frames."""

    @property
    def zoom_range(self) -> float:
        return float(np.ptp(self.zoom)) if len(self.zoom) else 0.0


def examine_lens(
    scene: Scene,
    views: Views,
    registered: np.ndarray,
    *,
    pixel: float,
    rows: float,
    prior: LensPrior,
) -> tuple[Lens, ...]:
    """The ordinary camera and its alternatives, each with its evidence; empty if there
    are too few observations.

    Args:
        scene: cameras and points to begin with.
        registered: frames whose camera is known.
        pixel: size of a pixel at depth 1: errors are thought no smaller than a fifth.
        rows: height of the image at depth 1.
    """
    chosen = _choose(scene, _Views.of(views, rows), registered)
    if chosen is None:
        return ()
    frames, start, views = chosen
    count, basis = _knots(frames)
    start = dataclasses.replace(start, lens=np.zeros(4 + count))
    fit = _Fit(views, basis, _blocks(views, len(start.points)), pixel / 5)
    every = _basis(np.arange(len(registered)), int(frames[0]), int(frames[-1]), count)
    found: tuple[Lens, ...] = ()
    for _ in range(_RESTARTS):
        found, solutions = _compared(fit, start, prior, every)
        if all(lens.log_odds < 0 for lens in found[1:]):
            break
        start = _lower(fit, solutions, prior.information((), count))
        if start is None:
            break
    return found


def _compared(
    fit: "_Fit", start: "_Unknowns", prior: LensPrior, every: np.ndarray
) -> tuple[tuple[Lens, ...], list["_Unknowns"]]:
    """The ordinary camera and its alternatives, fitted and compared."""
    num = len(start.lens) - 4
    plain = fit.solve(start, prior.information((), num))
    spread = fit.jackknife(plain, prior.information((), num))
    if spread is None:
        return (), []
    found = [_lens((), plain, spread, (0.0, 0.0), every)]
    solutions = [plain]
    simplest = _Simplest.of(fit, (), plain, spread, 0.0)
    models = (*((name,) for name in _SINGLE), *_PAIRS)
    if prior.focal[0] < prior.focal[1]:
        models = (OTHER_FOCAL, *models)
    for model in models:
        likely = [lens.log_odds > 0 and lens.model[0] in model for lens in found[1:]]
        if len(model) > 1 and not any(likely):
            continue
        x = fit.solve(simplest.x, prior.information(model, num))
        own = fit.jackknife(x, prior.information(model, num))
        if own is None:
            continue
        gain = (simplest.held_out - fit.held_out(own, simplest.sigma)) / 2
        evidence = _evidence(model, gain, own) + _occam(model, prior, simplest, x, own)
        odds = simplest.log_odds + evidence + prior.log_odds(model)
        found.append(_lens(model, x, own, (evidence, odds), every))
        solutions.append(x)
        if model == OTHER_FOCAL and odds > 0:
            simplest = _Simplest.of(fit, model, x, own, odds)
    return tuple(found), solutions


def _lower(
    fit: "_Fit", solutions: list["_Unknowns"], information: np.ndarray
) -> "_Unknowns | None":
    """A better fit of the ordinary camera, from the solutions of its alternatives.

    Depth and focal length trade off against each other, so that the ordinary camera has
    several minima; another model that only led out of a poor one explains nothing.
    """
    if not solutions:
        return None
    plain = solutions[0]
    sigma = fit.sigma(plain)
    cost = fit.cost(plain, sigma, information)
    best = None
    for x in solutions[1:]:
        lens = np.zeros_like(x.lens)
        lens[[0, 3]] = x.lens[[0, 3]]
        again = fit.solve(dataclasses.replace(x, lens=lens), information)
        new = fit.cost(again, sigma, information)
        if new < (1 - _MUCH_LOWER) * cost:
            cost, best = new, again
    return best


def _choose(
    scene: Scene, views: "_Views", registered: np.ndarray
) -> tuple[np.ndarray, "_Unknowns", "_Views"] | None:
    """Frames spread over the video, and what is seen in most of them."""
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
    views = _Views(
        np.searchsorted(frames, views.frame),
        np.searchsorted(points, views.landmark),
        views.xy,
        views.slant,
    )
    start = _Unknowns(
        scene.R_CW[frames], scene.centre[frames], scene.points[points], np.zeros(0)
    )
    return frames, start, views


def _blocks(views: "_Views", count: int) -> Int[np.ndarray, " l"]:
    """The block of each track: neighbours in the image and in time, by bisection at the
    median of the widest of the three."""
    seen = np.column_stack([views.xy, views.frame])
    number = np.bincount(views.landmark, minlength=count)[:, None]
    mean = sum_by(views.landmark, seen, count) / np.maximum(number, 1)
    mean = mean / np.maximum(mean.std(axis=0), 1e-12)
    block = np.zeros(count, np.int64)
    for _ in range(_BISECTIONS):
        for b in range(int(block.max()) + 1):
            own = np.flatnonzero(block == b)
            widest = int(np.argmax(mean[own].std(axis=0)))
            order = own[np.argsort(mean[own, widest], kind="stable")]
            block[order] = 2 * b + (np.arange(len(own)) >= len(own) / 2) + 1000
        block -= 1000
    return block


def _knots(frames: Int[np.ndarray, " k"]) -> tuple[int, np.ndarray]:
    span = int(frames[-1] - frames[0])
    count = int(np.clip(span // _FRAMES_A_KNOT, 1, _MOST_KNOTS))
    return count, _basis(frames, int(frames[0]), int(frames[-1]), count)


def _basis(frames: np.ndarray, first: int, last: int, count: int) -> np.ndarray:
    """Piecewise linear functions that are 0 in the first frame: (frames, count)."""
    at = np.clip((frames - first) / max(last - first, 1), 0, 1) * count
    return np.maximum(0, 1 - np.abs(at[:, None] - np.arange(1, count + 1)))


@dataclasses.dataclass(frozen=True)
class _Views(Views):
    """Observations, and how a rolling shutter shifts them."""

    slant: Float[np.ndarray, "m 2"]
    """Displacement by a readout that lasts a frame, at depth 1."""

    def __getitem__(self, index: np.ndarray) -> "_Views":
        return _Views(
            self.frame[index], self.landmark[index], self.xy[index], self.slant[index]
        )

    @staticmethod
    def of(views: Views, rows: float) -> "_Views":
        """Each point's motion in a frame times its row's delay after the middle row, of
        an image that is `rows` high at depth 1."""
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
        return _Views(views.frame, views.landmark, views.xy, slant)


@dataclasses.dataclass(frozen=True)
class _Unknowns:
    R: Float[np.ndarray, "k 3 3"]
    centre: Float[np.ndarray, "k 3"]
    points: Float[np.ndarray, "l 3"]
    lens: Float[np.ndarray, " g"]
    """Focal length, aspect, radial, and the zoom at each knot."""

    def moved(
        self, cameras: np.ndarray, points: np.ndarray, lens: np.ndarray
    ) -> "_Unknowns":
        return _Unknowns(
            so3.exp(cameras[:, :3]) @ self.R,
            self.centre + cameras[:, 3:],
            self.points + points,
            self.lens + lens,
        )

    def with_points(self, points: np.ndarray) -> "_Unknowns":
        return dataclasses.replace(self, points=points)


@dataclasses.dataclass(frozen=True)
class _Spread:
    """How a solution changes when blocks of tracks are left out."""

    naive: Float[np.ndarray, "g g"]
    """Covariance of the lens if all observations were independent."""
    covariance: Float[np.ndarray, "g g"]
    """The same by the jackknife."""
    without: tuple[_Unknowns, ...]
    """The solution without each block."""


class _Fit:
    """Bundle adjustment with a lens; the first camera is held."""

    def __init__(
        self, views: _Views, basis: np.ndarray, block: np.ndarray, least: float
    ):
        self.views, self.basis, self.least = views, basis, least
        self.parts: list[tuple[np.ndarray, _Views]] = []
        """The points of each block, and its observations."""
        for b in range(int(block.max()) + 1):
            points = np.flatnonzero(block == b)
            own = views[np.flatnonzero(block[views.landmark] == b)]
            landmark = np.searchsorted(points, own.landmark)
            self.parts.append((points, dataclasses.replace(own, landmark=landmark)))

    def sigma(self, x: _Unknowns) -> float:
        """Robust standard deviation of an observation, at depth 1."""
        return max(
            float(np.median(_errors(self.views, self.basis, x))) / 1.18, self.least
        )

    def cost(self, x: _Unknowns, sigma: float, information: np.ndarray) -> float:
        """Twice the negative log-posterior, up to a constant."""
        loss = _cost(self.views, self.basis, x, sigma).sum()
        return float(loss + (information * x.lens**2).sum())

    def solve(self, x: _Unknowns, information: np.ndarray) -> _Unknowns:
        """The most probable unknowns, by Levenberg--Marquardt."""
        damping, small = _DAMPING, 0
        for _ in range(_ITERATIONS):
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
            small = small + 1 if cost - new < _LEAST_DECREASE * cost else 0
            if small == _SMALL:
                break
        return x

    def jackknife(self, x: _Unknowns, information: np.ndarray) -> _Spread | None:
        """Solutions without one block each, by one Gauss--Newton step from `x`.

        Errors of neighbouring tracks are common to a block; those of all tracks at a
        time (shutter, blur, a map that bends) to a piece of the video. The covariance
        is the sum of both; without a piece its zoom is not known, so that of a zoom is
        the first alone.
        """
        sigma, num, count = self.sigma(x), len(x.lens), len(x.R)
        reduced = []
        for points, views in self.parts:
            part = x.with_points(x.points[points])
            reduced.append(_reduce(_linearise(views, self.basis, part, sigma)))
        S = np.sum([s for s, _ in reduced], axis=0)
        rhs = np.sum([r for _, r in reduced], axis=0)
        systems = [(S - s, rhs - r) for s, r in reduced]
        for frames in np.array_split(np.arange(count), _TIMES):
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
        constant = np.arange(num) < _CONSTANT
        covariance = covariance + constant[:, None] * constant * _jackknife(
            lenses[len(reduced) :]
        )
        return _Spread(naive, covariance, tuple(without))

    def held_out(self, spread: _Spread, sigma: float) -> np.ndarray:
        """Cost of each block's observations by cameras and lens of the others."""
        costs = []
        for (points, views), x in zip(self.parts, spread.without, strict=True):
            x = _located(views, self.basis, x.with_points(x.points[points]), sigma)
            costs.append(_cost(views, self.basis, x, sigma).sum())
        return np.array(costs)


@dataclasses.dataclass(frozen=True)
class _Simplest:
    """The ordinary camera that deviations are compared with: the assumed one, or that
    of another focal length where a calibration is thought to be wrong."""

    model: tuple[str, ...]
    x: _Unknowns
    sigma: float
    held_out: np.ndarray
    log_odds: float

    @staticmethod
    def of(
        fit: _Fit, model: tuple[str, ...], x: _Unknowns, spread: _Spread, odds: float
    ) -> "_Simplest":
        sigma = fit.sigma(x)
        return _Simplest(model, x, sigma, fit.held_out(spread, sigma), odds)


def _free(model: tuple[str, ...], num: int) -> np.ndarray:
    """Indices of the parameters by which a model differs from the ordinary camera."""
    places = {"focal": [0], "aspect": [1], "radial": [2], "zoom": list(range(4, num))}
    return np.array([i for name in model for i in places[name]])


def _evidence(model: tuple[str, ...], gain: np.ndarray, spread: _Spread) -> float:
    """Logarithm of the likelihood ratio from that of each held-out block, as if all
    observations were independent.

    The jackknife's variance is itself estimated, from as many pieces as there are
    blocks: with it, a normal likelihood becomes Student's.
    """
    free, freedom = _free(model, len(spread.naive)), len(gain) + _TIMES - 2
    inside = np.ix_(free, free)
    runs = np.trace(np.linalg.solve(spread.naive[inside], spread.covariance[inside]))
    runs = max(float(runs) / len(free), 1.0)
    t2 = 2 * gain.sum() / runs
    size = (freedom + len(free)) / 2 * np.log1p(abs(t2) / freedom)
    return float(np.sign(t2) * size)


def _occam(
    model: tuple[str, ...],
    prior: LensPrior,
    simplest: _Simplest,
    x: _Unknowns,
    spread: _Spread,
) -> float:
    """Logarithm of the ratio of prior densities at the two solutions, and of the
    volumes of the posteriors about them (Laplace's approximation)."""
    free, num = np.union1d(_free(model, len(x.lens)), [0]), len(x.lens) - 4
    data = np.linalg.pinv(spread.covariance[np.ix_(free, free)], hermitian=True)
    parts = []
    for y, allowed in ((simplest.x, simplest.model), (x, model)):
        own = prior.information(allowed, num)[free] / prior.runs
        density = 0.5 * (np.log(own) - own * y.lens[free] ** 2).sum()
        parts.append(density - 0.5 * np.linalg.slogdet(data + np.diag(own))[1])
    return float(parts[1] - parts[0])


def _lens(
    model: tuple[str, ...],
    x: _Unknowns,
    spread: _Spread,
    evidence: tuple[float, float],
    basis: Float[np.ndarray, "t g"],
) -> Lens:
    zoom = basis @ x.lens[4:]
    low, high = int(np.argmin(zoom)), int(np.argmax(zoom))
    change = np.concatenate([np.zeros(4), basis[high] - basis[low]])
    sigma = np.sqrt(np.diag(spread.covariance))
    return Lens(
        model=model,
        evidence=evidence[0],
        log_odds=evidence[1],
        focal=float(x.lens[0]),
        focal_sigma=float(sigma[0]),
        aspect=float(x.lens[1]),
        aspect_sigma=float(sigma[1]),
        radial=float(x.lens[2]),
        radial_sigma=float(sigma[2]),
        zoom=zoom,
        zoom_sigma=float(np.sqrt(max(change @ spread.covariance @ change, 0.0))),
        readout=float(x.lens[3]),
    )


def _newton(S, rhs, information, lens) -> np.ndarray | None:
    """The step to the minimum of reduced normal equations with the lens' prior."""
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
    """Covariance of the lens by reduced normal equations."""
    unit = np.eye(len(S))[:, -len(information) :]
    try:
        return cho_solve(cho_factor(_regular(S, information)), unit)[-unit.shape[1] :]
    except (LinAlgError, ValueError):
        return None


def _jackknife(left_out: Float[np.ndarray, "b g"]) -> Float[np.ndarray, "g g"]:
    """Covariance of an estimate from those without one of `b` pieces each."""
    away = left_out - left_out.mean(axis=0)
    return (len(away) - 1) / len(away) * away.T @ away


def _located(views: _Views, basis: np.ndarray, x: _Unknowns, sigma: float) -> _Unknowns:
    """The points that fit best with cameras and lens held, each by itself."""
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


def _predict(v: _Views, basis: np.ndarray, x: _Unknowns):
    offset = x.points[v.landmark] - x.centre[v.frame]
    p_C = np.einsum("mij,mj->mi", x.R[v.frame], offset)
    front = p_C[:, 2] > 1e-6
    z = np.where(front, p_C[:, 2], 1.0)
    q = p_C[:, :2] / z[:, None]
    r2 = np.minimum((q**2).sum(axis=-1), 4.0)
    zoom = x.lens[0] + basis[v.frame] @ x.lens[4:]
    half = 0.5 * x.lens[1] * np.array([1.0, -1.0])
    size = np.exp(zoom[:, None] + half)
    radial = 1 + x.lens[2] * r2
    predicted = size * q * radial[:, None]
    return p_C, front, z, q, r2, size, predicted, radial


def _errors(views: _Views, basis: np.ndarray, x: _Unknowns) -> np.ndarray:
    _, front, *_, predicted, _ = _predict(views, basis, x)
    predicted = predicted + x.lens[3] * views.slant
    error = np.linalg.norm(predicted - views.xy, axis=-1)
    return np.where(front, np.minimum(error, 10.0), 10.0)


def _cost(views: _Views, basis: np.ndarray, x: _Unknowns, sigma: float) -> np.ndarray:
    """Twice the negative log-likelihood of each observation (Cauchy's loss)."""
    error = _errors(views, basis, x) / sigma / _CAUCHY
    return _CAUCHY**2 * np.log1p(error**2)


def _jacobians(v: _Views, basis: np.ndarray, x: _Unknowns, sigma: float):
    """Whitened residuals and their derivatives by camera, point and lens."""
    p_C, front, z, q, r2, size, predicted, radial = _predict(v, basis, x)
    r = (predicted + x.lens[3] * v.slant - v.xy) / sigma
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
    G[..., 3] = v.slant
    G[..., 4:] = predicted[..., None] * basis[v.frame][:, None]
    G *= root / sigma
    return A, B, G, r * root[..., 0]


def _points_system(views: _Views, basis: np.ndarray, x: _Unknowns, sigma: float):
    """Normal equations of each point alone."""
    _, B, _, r = _jacobians(views, basis, x, sigma)
    num = len(x.points)
    V = sum_by(views.landmark, np.einsum("mki,mkj->mij", B, B), num)
    return V, sum_by(views.landmark, np.einsum("mki,mk->mi", B, r), num)


def _linearise(v: _Views, basis: np.ndarray, x: _Unknowns, sigma: float):
    """Normal equations: of cameras and lens, of points, and between them."""
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
    """Normal equations of cameras and lens with the points eliminated."""
    U, V, M, g, g_p = system
    flat = M.reshape(-1, len(U))
    V = V * (1 + damping * np.eye(3))
    Y = np.linalg.solve(V, np.concatenate([M, g_p[..., None]], axis=-1))
    S = U - flat.T @ Y[..., :-1].reshape(-1, len(U))
    return S, g - flat.T @ Y[..., -1].ravel()


def _step(system, damping: float, information: np.ndarray, lens: np.ndarray):
    """The damped step of cameras, points and lens; `None` if it is not determined."""
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
