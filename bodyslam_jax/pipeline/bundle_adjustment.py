"""Bundle adjustment of all frames and landmarks, and of a guessed focal length.

A guessed focal length is a variable with a wide prior around the guess. Inconsistency
between parallax and rotation determines it. Distortion is not estimated here.
"""

import dataclasses
import logging

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from bodyslam_jax import graph, initialisation, sfm, solver
from bodyslam_jax.config import Config, Structure
from bodyslam_jax.geometry.camera import project_rows
from bodyslam_jax.types import Intrinsics, SfmResult, Tracks

log = logging.getLogger(__name__)

HELD_FOCAL_SIGMA = 1e-6
"""Relative sigma of a prior that holds the focal length constant."""

_MAX_FOCAL_CHANGE = 0.005
"""Relative change of the focal length above which the priors of landmarks, which were
triangulated with the previous one, are dropped."""
_ASPECT_SIGMA = 1e-4
"""Sigma of the difference of fx and fy, relative to the focal length."""
_FOCAL_PRIOR_SIGMA, _CENTRE_PRIOR_SIGMA = 0.5, 0.2
"""Standard deviations of focal length and principal point, relative to the focal
length, of priors that only prevent self-calibration from diverging."""
_MAX_RESIDUAL_SIGMAS = 10.0
"""Residual, in sigmas, above which an observation is an outlier."""


def adjust(
    cameras: SfmResult, sigma: float, config: Config, guess: Intrinsics | None
) -> SfmResult:
    """Adjusts cameras and map, and determines inliers and pixel noise again.

    Args:
        sigma: standard deviation of the observations, px.
        guess: the intrinsics that the focal length's prior is centred on; `None` holds
            all intrinsics constant.
    """
    state = _first_state(cameras)
    free = guess is not None and config.structure.focal_sigma > HELD_FOCAL_SIGMA
    factors = _factors(cameras, sigma, config, free)
    problem = _problem(factors, state, config.structure, guess)
    # Covariances are of factors in double precision: one program is enough.
    mixed = None if guess is None else False
    solution = solver.solve(problem, state, mixed_precision=mixed)
    before = float(solution.first_cost)
    log.info("bundle adjustment: cost %.4g -> %.4g", before, float(solution.cost))
    state = solution.state
    focal_sigma = float("nan")
    prior_information = cameras.prior_information
    if abs(float(state.intrinsics[0]) / cameras.focal - 1) > _MAX_FOCAL_CHANGE:
        prior_information = np.zeros_like(prior_information)
    if guess is not None:
        covariance = solver.marginals(problem, state).intrinsics
        focal_sigma = float(np.sqrt(config.structure.focal_runs * covariance[0, 0]))
    error = np.linalg.norm(_pixel_errors(cameras.tracks, state), axis=-1)
    keep = cameras.keep
    noise = (
        clipped_sigma(np.median(error[keep]) / sfm.ERROR_PER_SIGMA)
        if keep.any()
        else 1.0
    )
    return dataclasses.replace(
        cameras,
        T_WC=np.asarray(state.cameras),
        landmarks=np.asarray(state.landmarks),
        intrinsics=np.asarray(state.intrinsics),
        focal_sigma=focal_sigma,
        keep=keep & (error < _MAX_RESIDUAL_SIGMAS * noise),
        prior_information=prior_information,
        pixel_sigma=noise,
        costs=(before, float(solution.cost)),
    )


def self_calibrated(
    cameras: SfmResult, config: Config
) -> Float[np.ndarray, "3 2"] | None:
    """Estimates fx, cx and cy from the tracks alone, each with its standard deviation,
    px.

    They are variables near the intrinsics of `cameras`, with a wide prior whose
    information is subtracted from the result. Returns `None` if there are no tracks or
    they do not determine the intrinsics.
    """
    if not cameras.keep.any():
        return None
    state, sigma = _first_state(cameras), cameras.pixel_sigma
    intrinsics = np.asarray(cameras.intrinsics, float)
    focal, runs = float(intrinsics[0]), config.structure.focal_runs
    prior = np.full(len(intrinsics), HELD_FOCAL_SIGMA * focal)
    prior[:2] = _FOCAL_PRIOR_SIGMA * focal / np.sqrt(runs)
    prior[2:4] = _CENTRE_PRIOR_SIGMA * focal / np.sqrt(runs)
    problem = _with_free_intrinsics(
        _factors(cameras, sigma, config, free=True), state, intrinsics, prior
    )
    solution = solver.solve(problem, state)
    at = [0, 2, 3]
    covariance = runs * np.asarray(solver.marginals(problem, solution.state).intrinsics)
    information = np.linalg.inv(covariance[np.ix_(at, at)])
    moved = np.asarray(solution.state.intrinsics)[at] - intrinsics[at]
    moment = information @ moved
    # fy is tied to fx, so that its prior is a second one on fx.
    information -= np.diag(np.array([2.0, 1.0, 1.0]) * prior[at] ** -2.0) / runs
    strength = np.linalg.eigvalsh(information)
    if not np.isfinite(moment).all() or strength[0] <= 1e-6 * strength[-1]:
        return None
    own = np.linalg.inv(information)
    return np.stack([intrinsics[at] + own @ moment, np.sqrt(np.diag(own))], axis=1)


def _first_state(cameras: SfmResult) -> graph.State:
    """Returns the state of cameras and landmarks, without people."""
    nobody = initialisation.no_people(len(cameras.T_WC))
    return initialisation.first_state(
        cameras.T_WC, cameras.landmarks, nobody, cameras.intrinsics
    )


def _factors(
    cameras: SfmResult, sigma: float, config: Config, free: bool
) -> list[graph.Factor]:
    """Returns the factors of cameras and map; `free` is True if intrinsics are
    variables."""
    # The noise set for the joint graph is not that of the observations.
    weights = dataclasses.replace(config.weights, pixel_sigma=None)
    factor = initialisation.map_factor(cameras.tracks, cameras.keep, sigma, weights)
    prior = initialisation.revisit_factor(
        cameras.prior_mean, cameras.prior_information, sigma
    )
    if free:
        # Prior means were triangulated with the focal length that is now a variable.
        prior = dataclasses.replace(prior, whitening=0 * prior.whitening)
    path = initialisation.path_factors(cameras.path, cameras.path_known)
    return [factor, prior, *path]


def clipped_sigma(sigma: float) -> float:
    """Clips a measured noise, px, to the range that the graph allows."""
    low, high = initialisation.PIXEL_SIGMA_RANGE
    return float(np.clip(sigma, low, high))


def _pixel_errors(tracks: Tracks, state: graph.State) -> Float[np.ndarray, "m 2"]:
    """Returns the reprojection errors of the landmarks, predicted minus observed,
    px."""
    T_WC = np.asarray(state.cameras)[tracks.frame]
    offset = np.asarray(state.landmarks)[tracks.landmark] - T_WC[:, :3, 3]
    p_C = np.einsum("mji,mj->mi", T_WC[:, :3, :3], offset)
    return project_rows(state.intrinsics, p_C) - tracks.uv


def _problem(
    factors: list[graph.Factor],
    state: graph.State,
    structure: Structure,
    guess: Intrinsics | None,
) -> graph.Problem:
    """Returns the problem, with the focal length as a variable if a guess is given."""
    if guess is None:
        return graph.make_problem(factors, state, common_sizes=True)
    params = np.asarray(guess.params, float)
    focal = params[0]
    # Errors of a track are temporally correlated, so that `focal_runs` observations
    # count as one. Multiplying the prior's information by that number has the same
    # effect on the focal length as dividing that of the observations.
    sigma = np.full(len(params), HELD_FOCAL_SIGMA * focal)
    error = guess.focal_sigma or structure.focal_sigma * focal
    sigma[:2] = min(error, structure.focal_sigma * focal) / np.sqrt(
        structure.focal_runs
    )
    return _with_free_intrinsics(factors, state, params, sigma)


def _with_free_intrinsics(
    factors: list[graph.Factor],
    state: graph.State,
    params: Float[np.ndarray, " i"],
    sigma: Float[np.ndarray, " i"],
) -> graph.Problem:
    """Returns the problem with intrinsics as variables near `params`, px, and with
    their aspect ratio held."""
    focal = float(params[0])
    factors = [
        *factors,
        graph.IntrinsicsPrior(jnp.asarray(params)[None], jnp.asarray(sigma)[None]),
        graph.AspectRatioPrior(
            jnp.asarray([_ASPECT_SIGMA * focal]), ratio=float(focal / params[1])
        ),
    ]
    return graph.make_problem(factors, state, free_intrinsics=True, common_sizes=True)
