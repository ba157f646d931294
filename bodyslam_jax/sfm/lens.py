"""Self-calibration from the tracks: pixel aspect ratio, distortion, zoom over time.

The reconstruction assumes one ordinary camera: square pixels, little distortion, one
focal length. Other camera models are fitted by bundle adjustment of some of its frames,
with the ratio of the focal lengths, one radial coefficient and a piecewise linear focal
length as additional parameters, and compared by how well they predict tracks that had
no part in the fit: tracks are divided into blocks, neighbours in the image and in time,
and each block is predicted by cameras and lens of the others (K-fold cross-validation).

Errors of tracks are correlated between neighbours and over time. So standard deviations
are those of the jackknife over blocks (Efron & Stein, Ann. Stat. 1981), and the
logarithm of a likelihood ratio is multiplied by the share of independent observations
that they imply (magnitude adjustment of a composite likelihood; Varin, Reid & Firth,
Stat. Sinica 2011).
"""

import dataclasses

import numpy as np
from jaxtyping import Float, Int

from bodyslam_jax.geometry.arrays import sum_by
from bodyslam_jax.sfm.bundle import Scene, Views
from bodyslam_jax.sfm.lens_fit import (
    NUM_TIME_PIECES,
    LensFit,
    LensViews,
    Spread,
    Unknowns,
)

MIN_SIGMA_PX = 0.2
"""Least standard deviation of an observation, px: trackers are not more precise."""
OTHER_FOCAL_MODEL = ("focal",)
"""The ordinary camera with another focal length than a calibration's. Deviations from a
calibration are compared with it, as they would otherwise win by a free focal length."""
_SINGLE_DEVIATIONS = ("aspect", "radial", "zoom")
"""Deviations from an ordinary camera."""
_DEVIATION_PAIRS = (("aspect", "radial"), ("radial", "zoom"))
"""Deviations that are considered together, if one of them is more probable than not."""
_MAX_FRAMES, _MAX_POINTS = 26, 300
"""Largest numbers of frames and points that are adjusted."""
_MIN_POINTS = 40
_FRAMES_PER_KNOT = 15
"""Number of frames between two knots of the zoom."""
_MAX_KNOTS = 8
_MAX_FITS = 3
_MIN_REFIT_DECREASE = 0.01
"""Largest number of fits of the ordinary camera, and least relative decrease of the
cost for another one."""
_NUM_BISECTIONS = 4
"""Number of times that blocks of tracks are halved: 16 blocks of about 19 tracks."""


@dataclasses.dataclass(frozen=True)
class LensPrior:
    """Standard deviations of a camera's parameters a priori."""

    focal: tuple[float, float]
    """Standard deviations of the logarithm of the focal length, for an ordinary camera
    and for a deviating one."""
    aspect: tuple[float, float]
    """Standard deviations of the logarithm of fx / fy, likewise."""
    radial: tuple[float, float]
    """Standard deviations of k1, likewise."""
    zoom: tuple[float, float]
    """Standard deviations of the logarithm of the ratio of the focal length at a knot
    to that of the first frame, likewise."""
    readout: float
    """Standard deviation of the delay of the last row after the first
    (rolling shutter), in frames."""
    runs: float
    """Number of observations that count as one, as errors of a track are correlated."""
    odds: tuple[tuple[str, float], ...]
    """Prior odds of each deviation."""

    def information(self, model: tuple[str, ...], knots: int) -> np.ndarray:
        """Returns the prior information on focal length, aspect, k1, readout and the
        zoom's knots, in units of the cost."""
        pick = lambda name: getattr(self, name)[name in model]
        focal = self.focal[bool(model)]
        sigma = [focal, pick("aspect"), pick("radial"), self.readout]
        sigma += [pick("zoom")] * knots
        return self.runs / np.square(sigma)

    def log_odds(self, model: tuple[str, ...]) -> float:
        """Returns the logarithm of a model's prior odds over the ordinary camera."""
        return float(sum(np.log(odds) for name, odds in self.odds if name in model))


@dataclasses.dataclass(frozen=True)
class Lens:
    """A camera model fitted to the tracks, and the evidence for it."""

    model: tuple[str, ...]
    """The deviations that it allows: aspect, radial, zoom; none for an ordinary camera;
    `OTHER_FOCAL_MODEL` where a calibration is probably wrong."""
    evidence: float
    """Logarithm of the likelihood ratio to an ordinary camera by held-out tracks, or to
    `OTHER_FOCAL_MODEL` where that is more probable."""
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
    """Standard deviation of the largest change of `zoom`."""
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
    """Returns the ordinary camera and its alternatives, each with its evidence; empty
    if there are too few observations.

    Args:
        scene: cameras and points to begin with.
        registered: frames whose camera is known.
        pixel: size of a pixel at depth 1.
        rows: height of the image at depth 1.
    """
    chosen = _choose(scene, LensViews.of(views, rows), registered)
    if chosen is None:
        return ()
    frames, start, views = chosen
    count, basis = _knots(frames)
    start = dataclasses.replace(start, lens=np.zeros(4 + count))
    least = MIN_SIGMA_PX * pixel
    fit = LensFit(views, basis, _blocks(views, len(start.points)), least)
    every = _basis(np.arange(len(registered)), int(frames[0]), int(frames[-1]), count)
    found: tuple[Lens, ...] = ()
    for _ in range(_MAX_FITS):
        found, solutions = _compared(fit, start, prior, every)
        if all(lens.log_odds < 0 for lens in found[1:]):
            break
        start = _lower(fit, solutions, prior.information((), count))
        if start is None:
            break
    return found


def _compared(
    fit: LensFit, start: Unknowns, prior: LensPrior, every: np.ndarray
) -> tuple[tuple[Lens, ...], list[Unknowns]]:
    """Fits and compares the ordinary camera and its alternatives."""
    num = len(start.lens) - 4
    plain = fit.solve(start, prior.information((), num))
    spread = fit.jackknife(plain, prior.information((), num))
    if spread is None:
        return (), []
    found = [_lens((), plain, spread, (0.0, 0.0), every)]
    solutions = [plain]
    simplest = _Simplest.of(fit, (), plain, spread, 0.0)
    models = (*((name,) for name in _SINGLE_DEVIATIONS), *_DEVIATION_PAIRS)
    if prior.focal[0] < prior.focal[1]:
        models = (OTHER_FOCAL_MODEL, *models)
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
        if model == OTHER_FOCAL_MODEL and odds > 0:
            simplest = _Simplest.of(fit, model, x, own, odds)
    return tuple(found), solutions


def _lower(
    fit: LensFit, solutions: list[Unknowns], information: np.ndarray
) -> Unknowns | None:
    """Returns a better fit of the ordinary camera, starting from its alternatives, or
    `None`.

    Depth and focal length trade off against each other, so that the ordinary camera has
    several minima; a model that only left a poor one is no better explanation.
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
        if new < (1 - _MIN_REFIT_DECREASE) * cost:
            cost, best = new, again
    return best


def _choose(
    scene: Scene, views: LensViews, registered: np.ndarray
) -> tuple[np.ndarray, Unknowns, LensViews] | None:
    """Chooses frames spread over the video, and the points seen in most of them; `None`
    if there are too few."""
    frames = np.flatnonzero(registered)
    if len(frames) < 6:
        return None
    few = np.linspace(0, len(frames) - 1, min(_MAX_FRAMES, len(frames)))
    frames = frames[np.unique(few.round().astype(int))]
    views = views[np.flatnonzero(np.isin(views.frame, frames))]
    count = np.bincount(views.landmark, minlength=len(scene.points))
    points = np.argsort(-count, kind="stable")[:_MAX_POINTS]
    points = np.sort(points[count[points] >= 3])
    if len(points) < _MIN_POINTS:
        return None
    views = views[np.flatnonzero(np.isin(views.landmark, points))]
    views = LensViews(
        np.searchsorted(frames, views.frame),
        np.searchsorted(points, views.landmark),
        views.xy,
        views.slant,
    )
    start = Unknowns(
        scene.R_CW[frames], scene.centre[frames], scene.points[points], np.zeros(0)
    )
    return frames, start, views


def _blocks(views: LensViews, count: int) -> Int[np.ndarray, " l"]:
    """Returns the block of each track: neighbours in the image and in time, by
    bisection along the coordinate (u, v, time) of largest spread."""
    seen = np.column_stack([views.xy, views.frame])
    number = np.bincount(views.landmark, minlength=count)[:, None]
    mean = sum_by(views.landmark, seen, count) / np.maximum(number, 1)
    mean = mean / np.maximum(mean.std(axis=0), 1e-12)
    block = np.zeros(count, np.int64)
    for _ in range(_NUM_BISECTIONS):
        for b in range(int(block.max()) + 1):
            own = np.flatnonzero(block == b)
            widest = int(np.argmax(mean[own].std(axis=0)))
            order = own[np.argsort(mean[own, widest], kind="stable")]
            block[order] = 2 * b + (np.arange(len(own)) >= len(own) / 2) + 1000
        block -= 1000
    return block


def _knots(frames: Int[np.ndarray, " k"]) -> tuple[int, np.ndarray]:
    span = int(frames[-1] - frames[0])
    count = int(np.clip(span // _FRAMES_PER_KNOT, 1, _MAX_KNOTS))
    return count, _basis(frames, int(frames[0]), int(frames[-1]), count)


def _basis(frames: np.ndarray, first: int, last: int, count: int) -> np.ndarray:
    """Returns piecewise linear functions, 0 in the first frame: (frames, count)."""
    at = np.clip((frames - first) / max(last - first, 1), 0, 1) * count
    return np.maximum(0, 1 - np.abs(at[:, None] - np.arange(1, count + 1)))


@dataclasses.dataclass(frozen=True)
class _Simplest:
    """The ordinary camera that deviations are compared with: the assumed one, or one of
    another focal length where a calibration is probably wrong."""

    model: tuple[str, ...]
    x: Unknowns
    sigma: float
    held_out: np.ndarray
    log_odds: float

    @staticmethod
    def of(
        fit: LensFit, model: tuple[str, ...], x: Unknowns, spread: Spread, odds: float
    ) -> "_Simplest":
        sigma = fit.sigma(x)
        return _Simplest(model, x, sigma, fit.held_out(spread, sigma), odds)


def _free(model: tuple[str, ...], num: int) -> np.ndarray:
    """Returns the parameters by which a model differs from the ordinary camera."""
    places = {"focal": [0], "aspect": [1], "radial": [2], "zoom": list(range(4, num))}
    return np.array([i for name in model for i in places[name]])


def _evidence(model: tuple[str, ...], gain: np.ndarray, spread: Spread) -> float:
    """Returns the logarithm of the likelihood ratio, from the gain of each held-out
    block as if all observations were independent.

    The jackknife's variance is itself estimated, from as many pieces as there are
    blocks: with it, a normal likelihood becomes Student's.
    """
    free, freedom = _free(model, len(spread.naive)), len(gain) + NUM_TIME_PIECES - 2
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
    x: Unknowns,
    spread: Spread,
) -> float:
    """Returns the logarithm of the ratio of prior densities at the two solutions, times
    that of the posteriors' volumes about them (Laplace's approximation)."""
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
    x: Unknowns,
    spread: Spread,
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
