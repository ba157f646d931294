"""The graph's problem over the content of the window.

All arrays have one size, so that the solver's programs are compiled once. A factor
whose error is common to a whole clip (steps, the ground) enters with the information
that it adds to that of earlier frames.
"""

import dataclasses
import logging
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from bodyslam_jax import graph, initialisation, motion, people
from bodyslam_jax.geometry.lengths import put
from bodyslam_jax.geometry.triangulation import triangulate, widest_angle
from bodyslam_jax.graph import CHUNK
from bodyslam_jax.io.camera.calibration import as_opencv, rays
from bodyslam_jax.motion import Prediction
from bodyslam_jax.online import prior as priors
from bodyslam_jax.online.window_content import FRAMES, PRIOR, Content
from bodyslam_jax.people import PersonState
from bodyslam_jax.pipeline.motion_prediction import (
    contact_predictor,
    contact_probability,
    motion_predictor,
    predict,
)
from bodyslam_jax.pipeline.people_floor import View, on_floor
from bodyslam_jax.solver.subproblem import in_frames
from bodyslam_jax.types import Keypoints, ScaleStart, Sequence, Tracks

log = logging.getLogger(__name__)

_MIN_PARALLAX_RAD = np.radians(0.5)
"""Least parallax of a landmark in the graph, rad: ten times the noise of a ray."""
MAX_SCALE_SIGMA = 0.5
"""Relative standard deviation of s from which it is unknown: two of them reach 0."""
_MIN_OBSERVATIONS = 3
"""Least number of observations of a landmark in the graph."""
_MAX_MEDIAN_ERROR = 6.0
"""Largest median reprojection error of a landmark in the graph, in its standard
deviation."""
_MIN_STEPS = 8
"""Least number of predicted steps from which s is estimated: about a second."""
GROUND_HALF_INFORMATION_FRAMES = 10.0
"""Number of frames with ground whose information is half that of infinitely many."""
_DEFINITION = "unknown"
"""The detector's definition of hip and knee (`Keypoints.definition`)."""
_UNKNOWN_POSITION = np.full(3, np.nan)
_PLACEHOLDER_SIGMA_PX = 1e6
"""Standard deviation of the observation of a placeholder landmark, px. A window without
landmarks has one, so that its tables, and with them its programs, are those of others.
"""
_MAX_LANDMARKS = 540
"""Number of landmarks that the tables of a window hold; they are partly filled."""
_VARIABLES = ("scale", "cameras", "roots", "poses", "shapes", "landmarks")


def start(
    window: Content,
) -> tuple[Sequence, graph.State, PersonState]:
    """Returns the window as a sequence, the first state of its solve, and people's
    bodies as fitted to their keypoints alone."""
    keypoints = Keypoints(window.uv, window.confidence, _DEFINITION)
    sequence = Sequence(
        name="window",
        frames=None,
        # Even times: the motion model's programs depend on how they lie.
        timestamps=np.arange(FRAMES) / window.fps,
        intrinsics=window.intrinsics,
        keypoints=keypoints,
    )
    given = keypoints, window.intrinsics, window.body, window.fps
    settings = window.config.people_fit
    bodies = people.fit_bodies(*given, settings, common_length=True)
    roots = people.roots_from_bodies(bodies, window.body)
    for h in range(window.places):
        _start_person(window, h, roots)
    state = graph.State(
        scale=jnp.asarray(window.scale, float),
        cameras=jnp.asarray(window.cameras),
        roots=jnp.asarray(window.roots),
        poses=jnp.asarray(window.poses),
        shapes=jnp.asarray(window.shapes),
        landmarks=jnp.zeros((0, 3)),
        intrinsics=jnp.asarray(window.intrinsics.params, float),
    )
    return sequence, state, roots


def _start_person(window: Content, h: int, roots: PersonState) -> None:
    """Sets frames of a person that no solve has estimated to the fit."""
    there = roots.present[h]
    there[: CHUNK - 1] &= window.known[h, : CHUNK - 1]
    new = there & ~window.known[h]
    if not new.any():
        return
    if window.began[h] < 0:
        window.began[h] = window.first + int(np.argmax(there))
    if window.people[h] not in window.book and not window.known[h].any():
        window.shapes[h] = roots.shape[h]
    # A fit of another stature stands at another distance.
    both = np.flatnonzero(there & window.known[h])[-CHUNK:]
    ratio = 1.0
    if len(both):
        depths = (x[h, both, 2, 3] for x in (window.roots, roots.T_CH))
        ratio = float(np.median(np.divide(*depths)))
    window.roots[h, new] = roots.T_CH[h, new]
    window.roots[h, new, :3, 3] *= ratio
    window.poses[h, new] = roots.body_pose[h, new]


def make(
    window: Content, sequence: Sequence, state: graph.State, roots: PersonState
) -> tuple[graph.Problem, graph.State, np.ndarray]:
    weights = window.config.weights
    measured = np.arange(FRAMES) >= CHUNK
    tracks, places = _tracks(window)
    shown = len(places) > 0
    if not shown:
        tracks, places = _placeholder(window)
    state = eqx.tree_at(lambda s: s.landmarks, state, put(places))
    sigma = initialisation.landmark_sigma(window.pixel_sigma, weights)
    cameras = initialisation.map_factor(
        tracks, np.ones(len(tracks.frame), bool), sigma, weights
    )
    if not shown:
        none = jnp.full_like(cameras.sigma, _PLACEHOLDER_SIGMA_PX)
        cameras = eqx.tree_at(lambda f: f.sigma, cameras, none)
    of_people = [
        _shape_once(window, f, roots) if isinstance(f, graph.ShapePrior) else f
        for f in initialisation.people_factors(sequence, roots, weights, window.body)
    ]
    if window.predictor is None:
        given = sequence, roots, window.body, window.config
        window.predictor = motion_predictor(*given)
        window.stands = contact_predictor(*given)
    located = window.located | (np.arange(FRAMES) < CHUNK)
    there = jnp.asarray(roots.present & located)
    predictor = at_times(window, window.predictor, there)
    prediction = predict(predictor, state)
    legs = people.legs_shown(
        people.shown_keypoints(sequence, window.body), roots.present, window.fps
    )
    steps = initialisation.steps_shown(prediction, legs, window.fps)
    moved = initialisation.motion_factor(
        steps, state.shapes, window.body, weights, shared_error=0.0
    )
    moved, told = _steps_once(window, moved, measured)
    ground, state, begun = _ground(
        window, sequence, state, roots, legs, steps, measured
    )
    metric = np.isfinite(window.scale_sigma) or (begun and bool((told > 0).any()))
    if window.fixed:  # s is proportional to the floor's height.
        metric = bool(np.isfinite(np.asarray(ground.sigma)).any())
    elif not metric:  # s is held, and its value means nothing.
        moved = eqx.tree_at(lambda f: f.whitening, moved, 0.0 * moved.whitening)
        ground = _no_ground(window)
    factors = [*of_people, moved, ground]
    factors = [cameras, *(in_frames(f, measured) for f in factors)]
    if window.prior is None:
        nothing = priors.no_prior(state, PRIOR, 2)
        window.prior = priors.with_scale(nothing, window.scale_sigma)
    free = dataclasses.replace(state, landmarks=put(places[:0])).zero_step()
    ones = lambda x, mask: jnp.ones_like(x) * jnp.asarray(mask, x.dtype)
    past = np.asarray(np.arange(FRAMES) >= CHUNK - window.prior.reach)
    last = np.asarray(np.arange(FRAMES) >= CHUNK - 1)
    filled = np.arange(FRAMES) < CHUNK + window.count
    there = roots.present & filled
    free = dataclasses.replace(
        free,
        scale=ones(free.scale, float(metric)),
        cameras=jnp.asarray(window.free * past[:, None]),
        roots=ones(free.roots, (there & past)[..., None]),
        poses=ones(free.poses, (there & last)[..., None, None]),
        shapes=ones(free.shapes, np.asarray(there.any(axis=1))[:, None]),
        landmarks=put(np.full(places.shape, float(shown))),
    )
    problem = graph.make_problem(
        [*factors, window.prior],
        state,
        motion=predictor,
        free=free,
        common_sizes=True,
        basis=people.posture_basis(),
    )
    variables = tuple(v for v in graph.VARIABLES if v in _VARIABLES)
    problem = dataclasses.replace(problem, variables=variables)
    if problem.layout.num_chunks != FRAMES // CHUNK:
        log.warning("a window's landmarks fit in no table of its size")
    return problem, state, told if metric and not window.fixed else told[:0]


def at_times(
    window: Content, predictor: graph.MotionPredictor, present: Bool[Array, "h t"]
) -> graph.MotionPredictor:
    """Returns a predictor for the times of the window's frames, which lie up to half a
    step from even ones: a step that took longer is longer."""
    network, _ = predictor.model
    even = np.arange(FRAMES) / window.fps
    away = window.times - even
    # After a source stood still, its clock is another one.
    away = np.clip(away - np.median(away), -0.5 / window.fps, 0.5 / window.fps)
    ticks = math.ceil(FRAMES / window.fps * network.fps)
    clock = motion.make_clock(even + away, network.fps, num_ticks=ticks)
    return dataclasses.replace(predictor, model=(network, clock), present=present)


def _tracks(
    window: Content,
) -> tuple[Tracks, Float[np.ndarray, "l 3"]]:
    """Returns the observations of the landmarks that are in the graph, and their
    positions."""
    frame = np.concatenate([np.full(len(s[0]), k) for k, s in enumerate(window.seen)])
    landmark = np.concatenate([s[0] for s in window.seen]).astype(int)
    uv = np.concatenate([s[1] for s in window.seen])
    known, row, seen = np.unique(landmark, return_inverse=True, return_counts=True)
    R_CW = np.swapaxes(window.cameras[:, :3, :3], 1, 2)[frame]
    centre = window.cameras[frame, :3, 3]
    K, distortion = as_opencv(window.intrinsics.params)
    xy = rays(uv, K, distortion)
    pixel = 1 / K[0, 0]
    places = np.array([window.where.get(i, _UNKNOWN_POSITION) for i in known.tolist()])
    places = places.reshape(-1, 3)
    fresh = np.asarray(np.isnan(places).any(axis=1))
    if fresh.any():
        found = triangulate(R_CW, centre, xy, row, len(known), pixel)
        places = np.where(fresh[:, None], found, places)
    p_C = np.einsum("mij,mj->mi", R_CW, places[row] - centre)
    depth = p_C[:, 2]
    front = depth > 1e-6
    away = np.linalg.norm(
        p_C[:, :2] / np.where(front, depth, 1.0)[:, None] - xy, axis=1
    )
    limit = _MAX_MEDIAN_ERROR * window.pixel_sigma * pixel
    off = np.bincount(row, np.logical_or(~front, away > limit), len(known)) / seen
    good = (seen >= _MIN_OBSERVATIONS) & (off < 0.5)
    good &= widest_angle(centre, row, places) > _MIN_PARALLAX_RAD
    for i in known[~good]:
        window.where.pop(int(i), None)
    good = _most(good, seen, _MAX_LANDMARKS)
    rows = np.flatnonzero(good[row])
    number = np.cumsum(good) - 1
    window.in_graph = known[good]
    return Tracks(frame[rows], number[row[rows]], uv[rows]), places[good]


def _placeholder(window: Content) -> tuple[Tracks, Float[np.ndarray, "1 3"]]:
    """Returns the observation of a placeholder landmark in the first measured frame,
    and its position, one map unit ahead of that camera."""
    T_WC = window.cameras[CHUNK]
    middle = np.asarray(window.intrinsics.params[2:4], float)
    seen = np.array([CHUNK]), np.array([0]), middle[None]
    return Tracks(*seen), (T_WC[:3, 3] + T_WC[:3, 2])[None]


def _shape_once(
    window: Content, factor: graph.ShapePrior, roots: PersonState
) -> graph.ShapePrior:
    """Returns one measurement of each person's shape: the fit in their first frame of
    the window, or the shape in the book."""
    sigma = np.full(np.shape(factor.sigma), np.inf)
    shape = np.array(factor.shape)
    for h, person in enumerate(window.people):
        k = window.began[h] - window.first
        if person is None or not 0 <= k < FRAMES or not roots.present[h].any():
            continue
        mean, known = window.book.get(
            person, (roots.shape[h], window.config.weights.shape_sigma)
        )
        shape[h], sigma[h, k] = mean, known
    return eqx.tree_at(
        lambda f: (f.shape, f.sigma),
        factor,
        (jnp.asarray(shape), jnp.asarray(sigma)),
    )


def _steps_once(
    window: Content, moved: graph.HumanMotion, measured: np.ndarray
) -> tuple[graph.HumanMotion, Float[np.ndarray, "h t"]]:
    """Returns the motion factor, weighted by the information that its steps add to
    those before.

    With an error e common to all steps, information I on their factor is worth
    `I / (1 + e² I)`. What it grows by from I_0 to I_0 + I is the weight
    `1 / ((1 + e² I_0) (1 + e² (I_0 + I)))` of I.

    **Returns:** the information of each frame, too.
    """
    weights = window.config.weights
    whitening = np.array(moved.whitening)
    step = np.asarray(moved.translation)
    rho = weights.motion_correlation
    told = ((whitening @ step[..., None])[..., 0] ** 2).sum(-1)
    told = told * (1 - rho) / (1 + rho) * measured
    squared = weights.fitted_step_error**2
    before = 1 + squared * window.steps_told
    after = before + squared * told.sum(axis=1)
    whitening *= (before * after)[:, None, None, None] ** -0.5
    moved = eqx.tree_at(lambda f: f.whitening, moved, jnp.asarray(whitening))
    return moved, told


def forget(window: Content, variance: float) -> None:
    """Discounts the information on s that steps and the ground gave before a random
    walk of s with this variance, relative to s².

    Their errors are common to all frames, so the information that they gave is
    subtracted from what they give next (`_steps_once`, `_ground`). The walk, of
    variance q, leaves the share P / (P + q) of the information on s, where P is its
    relative variance; the same share of what each source gave is left, so that later
    steps measure the new s. Otherwise the variance of s would grow without bound.
    """
    known = (window.scale_sigma / window.scale) ** 2
    if window.fixed or not np.isfinite(known):
        return
    kept = known / (known + variance)
    squared = window.config.weights.fitted_step_error**2
    steps = kept * window.steps_told / (1 + squared * window.steps_told)
    window.steps_told = steps / (1 - squared * steps)
    ground = kept * window.ground_told
    ground /= GROUND_HALF_INFORMATION_FRAMES + window.ground_told
    window.ground_told = GROUND_HALF_INFORMATION_FRAMES * ground / (1 - ground)


def _ground(
    window: Content,
    sequence: Sequence,
    state: graph.State,
    roots: PersonState,
    legs: np.ndarray,
    steps: Prediction,
    measured: np.ndarray,
) -> tuple[graph.GroundContact, graph.State, bool]:
    """Returns the factor of people on the ground of the map, the state, with a first
    scale if it has none yet and enough steps determine it, and whether that is so."""
    weights = window.config.weights
    blank, begun = _no_ground(window), False
    present = roots.present & window.located & legs & measured
    if window.fixed:
        return _floor(window, sequence, state, present) or blank, state, begun
    contact = None
    if present.sum() >= CHUNK:
        contact = initialisation.ground_contact(
            state, present, sequence.keypoints, window.body, weights, window.fps
        )
    if contact is not None:
        contact = initialisation.with_elevation(contact, state, window.fps)
    if np.isnan(window.scale_sigma):
        start = ScaleStart()
        if np.asarray(steps.valid)[:, CHUNK:].sum() >= _MIN_STEPS:
            start = initialisation.scale_start(
                state, steps, contact, shared_error=weights.fitted_step_error
            )
        # An unknown error is infinite or NaN.
        if start.standard_error < MAX_SCALE_SIGMA * start.value:
            scale = jnp.asarray(start.value, state.scale.dtype)
            state, begun = eqx.tree_at(lambda s: s.scale, state, scale), True
    if contact is None:
        return blank, state, begun
    sigma = np.asarray(contact.sigma)
    used = np.isfinite(sigma)
    count, told = float(used.sum()), window.ground_told
    share = lambda n: n / (GROUND_HALF_INFORMATION_FRAMES + n)
    grown = max(share(told + count) - share(told), 1e-9)
    # `sigma` is that of all frames together times the root of their number.
    sigma = sigma / np.sqrt(count) * np.sqrt(count / grown)
    return eqx.tree_at(lambda f: f.sigma, contact, jnp.asarray(sigma)), state, begun


def _no_ground(window: Content) -> graph.GroundContact:
    """Returns a factor of the ground that says nothing."""
    return graph.GroundContact(
        window.body,
        jnp.asarray([0.0, -1.0, 0.0]),
        jnp.zeros((window.places, FRAMES)),
        jnp.full((window.places, FRAMES), jnp.inf),
        jnp.zeros((window.places, FRAMES)),
    )


def _floor(
    window: Content, sequence: Sequence, state: graph.State, present: np.ndarray
) -> graph.GroundContact | None:
    """Returns the factor of people on one floor before a fixed camera, as offline: its
    height is determined by their sizes alone. `None` without feet in contact."""
    weights = window.config.weights
    if weights.ground_sigma is None or not present.any():
        return None
    probability = None
    if window.stands is not None:
        stands = at_times(window, window.stands, jnp.asarray(present))
        probability = contact_probability(stands, state, window.fps)
    fitted = np.ones(window.places, bool)
    seen = present, sequence.keypoints, fitted, window.fps, window.config.gravity
    return on_floor(state, probability, View(*seen), window.body, weights)


def _most(good: np.ndarray, seen: np.ndarray, most: int) -> np.ndarray:
    """Returns at most so many of the good landmarks, those with the most
    observations."""
    if good.sum() <= most:
        return good
    order = np.argsort(np.where(good, -seen, 0), kind="stable")
    kept = np.zeros(len(good), bool)
    kept[order[:most]] = True
    return kept & good
