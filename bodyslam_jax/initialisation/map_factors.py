"""Factors of cameras and landmarks, from structure from motion and a given path."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import graph
from bodyslam_jax.config import PATH_SIGMA, GraphWeights
from bodyslam_jax.geometry.lengths import put
from bodyslam_jax.types import Tracks

PIXEL_SIGMA_RANGE = (0.3, 3.0)
"""Plausible noise of tracks, px; a measured value outside this range indicates a wrong
model, and is clipped."""


def landmark_sigma(measured: float, weights: GraphWeights) -> float:
    """Returns the standard deviation of landmark observations in the joint graph, px:
    `weights.pixel_sigma` if set, else the noise `measured` by bundle adjustment."""
    return measured if weights.pixel_sigma is None else weights.pixel_sigma


def map_factor(
    tracks: Tracks, keep: Bool[np.ndarray, " m"], sigma: float, weights: GraphWeights
) -> graph.Reprojection:
    """Returns the reprojection factor of static landmarks; observations that are not in
    `keep` have no weight.

    `sigma` is the noise of the tracks as measured by bundle adjustment, px.
    """
    sigma = landmark_sigma(sigma, weights)
    return graph.Reprojection(
        frame=put(tracks.frame, np.int32),
        landmark=put(tracks.landmark, np.int32),
        pixel=put(tracks.uv, float),
        sigma=put(np.where(keep, sigma, np.inf)),
        loss=graph.Cauchy(jnp.asarray(weights.landmark_loss)),
    )


def revisit_factor(
    prior_mean: Float[np.ndarray, "l 3"],
    prior_information: Float[np.ndarray, "l 3 3"],
    sigma: float,
) -> graph.LandmarkPrior:
    """Returns a prior on each landmark from other observations of the same point.

    Args:
        prior_mean: positions, in units of the map (`sfm.loop_closure`).
        prior_information: their inverse covariances for pixel noise of 1 px.
        sigma: the pixel noise, px.
    """
    size, axes = np.linalg.eigh(prior_information)
    whitening = np.sqrt(np.maximum(size, 0.0))[..., None] * np.swapaxes(axes, 1, 2)
    return graph.LandmarkPrior(
        position=jnp.asarray(prior_mean, float),
        whitening=jnp.asarray(whitening / sigma),
    )


def path_factors(
    path: Float[np.ndarray, "t 4 4"] | None,
    given: Bool[np.ndarray, " t"] | None,
    scale: float = float("nan"),
) -> list[graph.Factor]:
    """Returns priors on camera poses, and on the scale, from a given camera path.

    Args:
        path: poses T'_WC in units of the map; without it there are no factors.
        given: the frames in which the path has a pose.
        scale: metres per unit of the map if the path is in metres, else NaN.
    """
    if path is None or given is None:
        return []
    sigma = np.repeat(np.where(given, PATH_SIGMA, np.inf)[:, None], 6, axis=1)
    factors: list[graph.Factor] = []
    factors.append(graph.CameraPrior(jnp.asarray(path), jnp.asarray(sigma)))
    if np.isfinite(scale):
        once = np.full(len(given), np.inf)
        once[0] = PATH_SIGMA * scale
        of_map = jnp.full(len(given), scale)
        factors.append(graph.ScalePrior(of_map, jnp.asarray(once)))
    return factors
