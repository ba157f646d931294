"""Fits bodies to keypoints alone, in the manner of SMPLify, over a whole clip.

Bogo et al., Keep it SMPL, ECCV 2016, fits each image independently. Here that is done
for every few frames (`frame_fit`), then all frames of a person are fitted together,
with one shape and a prior on human motion (`trajectory_fit`). **The metric scale comes
from the prior on stature**: with β near the mean the depth is that of an adult of
average size, so depths have the relative error of the stature, 4 to 6 % (1 σ) for
adults, and that of the focal length.
"""

import logging

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.ndimage import median_filter

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import PeopleFit
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.lengths import lengthened, padded_length
from bodyslam_jax.people.costs import Fit, Lifted, Scene
from bodyslam_jax.people.frame_fit import fit_frames
from bodyslam_jax.people.keypoint_errors import (
    CORRELATION_TIME,
    ROBUST_SCALE,
    find_present,
    has_enough,
    in_pixels,
    keypoint_sigma,
    pixels_per_metre,
)
from bodyslam_jax.people.lift import ASSETS, lift, load_lifter
from bodyslam_jax.people.person_state import (
    DEPTH_JITTER_M,
    POSITION_JITTER_M,
    PersonState,
    bodies_from_roots,
)
from bodyslam_jax.people.posture_prior import PosturePrior, load_posture_prior
from bodyslam_jax.people.skeleton import NUM_SHAPE, make_skeleton
from bodyslam_jax.people.trajectory_fit import Chain, ChainProblem, Ties, solve_chain
from bodyslam_jax.types import Bodies, Intrinsics, Keypoints

log = logging.getLogger(__name__)

_START_INTERVAL_S = 0.1
"""Time between the frames that are fitted independently."""
_MAX_STEPS = 30
"""Number of Gauss--Newton steps over all frames."""
_LEAN_SIGMA = 0.4
"""Standard deviation of the lean towards or away from the camera, sine of the angle."""
_TURN_JITTER_RAD = 0.03
"""Standard deviation of the orientation's second difference at 30 fps."""
_MOTION_SCALE = 2.0
"""Factor on the posture prior's innovations: people move less predictably than in the
motion data."""
_MAX_SPEED_M_S = 8.0
"""Speed across the line of sight above which the trajectory is cut: faster than people
run, assuming that fits 0.1 s apart err by well below 0.8 m across the view."""


def fit_bodies(
    keypoints: Keypoints,
    intrinsics: Intrinsics,
    body: BodyModel,
    fps: float,
    settings: PeopleFit = PeopleFit(),
    *,
    common_length: bool = False,
) -> Bodies:
    """Fits posture, shape and position of every person to their keypoints.

    Confidences are relative to the person's own best ones, as their scale differs
    between detectors. A keypoint outside the image is extrapolated and not used.

    **Arguments:** `common_length`: whether people who are in few of the frames share
    the programs of those who are in all, which then are the only ones.

    **Returns:** bodies in the camera frame, one β per person, present in frames
    with enough keypoints and short gaps between such frames.
    """
    people, frames = keypoints.confidence.shape[:2]
    roots = PersonState(
        np.zeros((people, frames), bool),
        np.tile(np.eye(4), (people, frames, 1, 1)),
        np.zeros((people, frames, 23, 3)),
        np.zeros((people, 10)),
    )
    scene = make_scene(intrinsics, body, fps, settings, keypoints.definition)
    for h in range(people):
        sigma = keypoint_sigma(keypoints, intrinsics, h)
        present = find_present(sigma, fps, settings)
        if not present.any():
            log.warning("person %d has too few keypoints in every frame", h)
            continue
        given = scene, keypoints.uv[h], sigma, present, fps, settings
        fitted, chain = _fit_person(*given, frames if common_length else 0)
        roots.present[h] = present
        roots.T_CH[h, fitted, :3, :3] = chain.fit.orientation
        roots.T_CH[h, fitted, :3, 3] = chain.fit.position
        latent = np.asarray(chain.fit.latent)
        roots.body_pose[h, fitted] = _decoded(
            scene.prior, latent, frames if common_length else 0
        )
        roots.T_CH[h, ~present] = np.eye(4)
        roots.body_pose[h, ~present] = 0.0
        roots.shape[h] = chain.shape[:10]
    return bodies_from_roots(roots, body)


def _decoded(
    prior: PosturePrior, latent: Float[np.ndarray, "t k"], least: int = 0
) -> Float[np.ndarray, "t 23 3"]:
    """Returns `PosturePrior.decode` of at least `least` frames, compiled for few
    lengths."""
    longer = lengthened(latent, padded_length(max(len(latent), least)))
    return np.asarray(_decode(prior, longer))[: len(latent)]


_decode = eqx.filter_jit(lambda prior, latent: prior.decode(latent))


def make_scene(
    intrinsics: Intrinsics,
    body: BodyModel,
    fps: float,
    settings: PeopleFit,
    definition: str = "unknown",
) -> Scene:
    """Returns the data that all frames share; `definition` is the detector's, one of
    `body.KEYPOINT_DEFINITIONS`."""
    dtype = body.joint_template.dtype
    number = lambda value: jnp.asarray(value, dtype)
    return Scene(
        make_skeleton(body, 0.0, definition),
        load_posture_prior(fps, dtype),
        number(intrinsics.params),
        number(ROBUST_SCALE),
        number(settings.limit_sigma),
        number(_LEAN_SIGMA**-2),
        number(settings.lift_scale or 1.0),
    )


def _fit_person(
    scene: Scene,
    uv: Float[np.ndarray, "t 25 2"],
    sigma: Float[np.ndarray, "t 25"],
    present: np.ndarray,
    fps: float,
    settings: PeopleFit,
    least: int = 0,
) -> tuple[slice, Chain]:
    """Fits one shape and the postures of all frames to one person's keypoints.

    `uv` is in px, the standard deviation `sigma` in m of the body, infinite for missing
    keypoints. `present` marks the frames in which the person gets a body. Programs are
    those of `least` frames or more.

    **Returns:** the slice of frames from the first to the last present one, and the fit
    in these frames.
    """
    where = np.flatnonzero(present)
    fitted = slice(where[0], where[-1] + 1)
    uv, sigma = uv[fitted], sigma[fitted]
    lifted = guess_postures(scene, uv, sigma, fps, settings, least)
    sigma_px = in_pixels(sigma, pixels_per_metre(uv, sigma, fps))
    usable = np.flatnonzero(has_enough(sigma))
    start, cuts = _start(scene, uv, sigma_px, usable, lifted, fps)

    focal = float(scene.intrinsics[0])
    depth = median_filter(np.asarray(start.position)[:, 2], 2 * round(fps / 4) + 1)
    sigma_px = in_pixels(sigma, focal / depth)
    frames_alike = max(1.0, CORRELATION_TIME * fps)
    dtype = scene.intrinsics.dtype
    length = padded_length(max(len(uv), least)) - len(uv)
    pad = lambda a, value: np.concatenate([a, np.full((length, *a.shape[1:]), value)])
    # NumPy is used because JAX would compile small programs for each length.
    last = lambda a: jnp.asarray(
        np.concatenate([a, np.repeat(np.asarray(a)[-1:], length, axis=0)])
    )
    # Errors of the lifted postures are correlated in time too; padding has none.
    alike = max(1.0, settings.lift_correlation * fps) ** 0.5
    wider = np.where(np.arange(len(uv) + length) < len(uv), alike, np.inf)
    lifted = jax.tree.map(lambda a: last(np.asarray(a, dtype)), lifted)
    evidence = np.sum(np.isfinite(sigma).any(1)) / frames_alike
    problem = ChainProblem(
        scene,
        jnp.asarray(pad(uv, 0.0), dtype),
        jnp.asarray(pad(sigma_px * np.sqrt(frames_alike), np.inf), dtype),
        lifted.widened(jnp.asarray(wider, dtype)),
        make_ties(scene.prior, cuts, len(uv) + length, fps),
        jnp.asarray(max(1.0, evidence / settings.shape_frames), dtype),
    )
    chain = Chain(jax.tree.map(last, start), jnp.zeros(NUM_SHAPE, dtype))
    chain, value = solve_chain(problem, chain, _MAX_STEPS)
    log.info("fitted %d frames, cost %.1f", len(uv), float(value))
    fit = jax.tree.map(lambda a: np.asarray(a)[: len(uv)], chain.fit)
    return fitted, Chain(fit, chain.shape)


def guess_postures(
    scene: Scene,
    uv: Float[np.ndarray, "t 25 2"],
    sigma: Float[np.ndarray, "t 25"],
    fps: float,
    settings: PeopleFit = PeopleFit(),
    least: int = 0,
) -> Lifted:
    """Returns the posture of one person that the lifting network of `settings`
    predicts, in C.

    Standard deviations are infinite where it has too few keypoints, and everywhere if
    the settings' `lift_scale` is 0.
    """
    dtype = scene.intrinsics.dtype
    length = padded_length(max(len(uv), least)) - len(uv)
    # Beyond the end the last frame is repeated, as the first one is before the start.
    last = lambda a: np.concatenate([a, np.repeat(a[-1:], length, axis=0)])
    numbers = (jnp.asarray(a, dtype) for a in (last(uv), last(sigma), fps))
    network = load_lifter(ASSETS[settings.lifter])
    lifted, usable = lift(network, scene.intrinsics, *numbers)
    trusted = usable & (settings.lift_scale > 0)
    lifted = lifted.widened(jnp.where(trusted, 1.0, jnp.inf).astype(dtype))
    return jax.tree.map(lambda a: np.asarray(a)[: len(uv)], lifted)


def _start(
    scene: Scene,
    uv: np.ndarray,
    sigma_px: np.ndarray,
    usable: np.ndarray,
    lifted: Lifted,
    fps: float,
) -> tuple[Fit, np.ndarray]:
    """Fits every few of the `usable` frames and interpolates to all frames.

    **Returns:** the fits, and the frames at which the trajectory is cut.
    """
    stride = max(1, round(_START_INTERVAL_S * fps))
    chosen = np.unique(
        [usable[np.argmin(np.abs(usable - k))] for k in range(0, len(uv), stride)]
    )
    guess = jax.tree.map(lambda a: a[chosen], lifted)
    fit = fit_frames(scene, uv[chosen], sigma_px[chosen], guess)
    speed = np.linalg.norm(np.diff(fit.position[:, :2], axis=0), axis=1) * fps
    broken = speed / np.maximum(np.diff(chosen), 1) > _MAX_SPEED_M_S
    return _interpolate(fit, chosen, broken, len(uv)), chosen[1:][broken]


def _interpolate(fit: Fit, frame: np.ndarray, broken: np.ndarray, total: int) -> Fit:
    """Interpolates between the fitted frames; across a break the earlier one is
    held."""
    wanted = np.arange(total)
    after = np.clip(np.searchsorted(frame, wanted), 1, max(len(frame) - 1, 1))
    after = np.minimum(after, len(frame) - 1)
    before = np.maximum(after - 1, 0)
    share = (wanted - frame[before]) / np.maximum(frame[after] - frame[before], 1)
    share = np.clip(share, 0.0, 1.0)
    if len(broken):
        share = np.where(broken[np.maximum(after - 1, 0)], share >= 1.0, share)
    position, latent = (
        a[before] + share[:, None] * (a[after] - a[before])
        for a in (fit.position, fit.latent)
    )
    orientation = np.asarray(fit.orientation)
    turned = so3.interpolate(orientation[before], orientation[after], share)
    dtype = fit.position.dtype
    return Fit(*(jnp.asarray(a, dtype) for a in (turned, position, latent)))


def make_ties(prior: PosturePrior, cuts: np.ndarray, frames: int, fps: float) -> Ties:
    """Returns the temporal terms between frames; none crosses a cut.

    The first frame of a track has the posture's stationary prior, the second the
    first-order autoregression; from the third on the terms are the full ones. Noise in
    acceleration adds up: velocity changes by σ sqrt(dt), so second differences grow
    with the time between frames to the power 1.5.
    """
    a1, a2 = np.asarray(prior.autoregression, float).T
    lag = a1 / (1 - a2)
    innovation = (1 - lag**2) * (1 - a2**2)
    size = 6 + len(a1)
    weight, c1, c2 = np.zeros((3, frames, size))
    jitter = (
        np.array([_TURN_JITTER_RAD] * 3 + [POSITION_JITTER_M] * 2 + [DEPTH_JITTER_M])
        * (30 / fps) ** 1.5  # From 30 fps, where jitters are stated.
    )
    loose = _MOTION_SCALE**2
    weight[:, :6], c1[:, :6], c2[:, :6] = jitter**-2, -2.0, 1.0
    weight[:, 6:], c1[:, 6:], c2[:, 6:] = 1 / (innovation * loose), -a1, -a2
    for first in (0, *cuts):
        weight[first, :6], weight[first, 6:] = 0.0, 1.0
        c1[first], c2[first] = 0.0, 0.0
        second = first + 1
        if second < frames:
            # The prior on velocity is wide: the change over ten frames.
            weight[second, :6], c1[second, :6] = jitter**-2 / 100, -1.0
            weight[second, 6:], c1[second, 6:] = 1 / ((1 - lag**2) * loose), -lag
            c2[second] = 0.0
    dtype = prior.mean.dtype
    return Ties(*(jnp.asarray(a, dtype) for a in (weight, c1, c2)))
