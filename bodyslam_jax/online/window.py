"""The fixed-lag window: the graph over the last frames, and a prior of the rest.

`FRAMES` frames in chunks of ten. The first chunk is the past, whose measurements are in
the prior; the others are measured. All arrays have one size, so that the solver's
programs are compiled once. When the window is full, `solver.marginalise` puts its
oldest measured chunk into the prior, and it moves on by ten frames.

Landmarks live for `LIFE` chunks at most; a longer track continues as another landmark.
So a prior couples `PRIOR` frames, whatever the tracks. A factor that counts one error
once for a whole clip (steps, the ground) gets here what its information grows by.
"""

import dataclasses
import logging
import time

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Real

from bodyslam_jax import graph, initialisation, people, solver
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config import Config
from bodyslam_jax.diagnostics.scale_uncertainty import inflate_fitted_shapes
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.geometry.lengths import put
from bodyslam_jax.geometry.triangulation import triangulate, widest_angle
from bodyslam_jax.graph import CHUNK
from bodyslam_jax.io.camera.calibration import as_opencv, rays
from bodyslam_jax.motion import Prediction, leg_length
from bodyslam_jax.online import prior as priors
from bodyslam_jax.people import PersonState
from bodyslam_jax.pipeline.motion_prediction import (
    contact_predictor,
    contact_probability,
    motion_predictor,
    predict,
)
from bodyslam_jax.solver.marginalisation import in_frames
from bodyslam_jax.types import Intrinsics, Keypoints, ScaleStart, Sequence, Tracks

log = logging.getLogger(__name__)

FRAMES = 60
"""Frames of a window, the first ten of them the past: a size that programs have."""
LIFE = 3
"""Most chunks that a landmark spans: narrow tables of the solver."""
PRIOR = (LIFE + 1) * CHUNK
"""Frames that the prior is of: the past, and what landmarks of the chunk that leaves
reach."""
_FIRST_STEPS, _STEPS = 15, 4
"""Steps of a window's solve: the first with a scale, and all others."""
_LEAST_ANGLE = np.radians(0.5)
"""Parallax from which a landmark is in the graph: ten times the noise of a ray."""
_LEAST_SEEN = 3
"""Observations of a landmark in the graph."""
_OUTLIER = 6.0
"""Reprojection error of a landmark's median observation from which it is left out, in
its standard deviation."""
_SIGMA = 0.7
"""px: noise of tracks before it was measured."""
SCALE_WALK = 0.005
"""Relative standard deviation by which the unit of the map changes in a second: what a
monocular map drifts by on simulated tracks (`benchmarks/online.md`)."""
_AWAY = 10
"""Frames without keypoints after which a person's place is free for somebody else."""
_LEAST_STEPS = 15
"""Predicted steps from which s is estimated: about a second."""
_GROUND_COUNTS = 10.0
"""Frames with ground that count half as much as all of them."""


@dataclasses.dataclass(frozen=True)
class Measured:
    """What the front end found in one frame."""

    time: float
    """s; within half a step of the window's rate from where it stands in it."""
    T_WC: Float[np.ndarray, "4 4"]
    """Map units; a guess where not `located`."""
    located: bool
    """Also of a frame without an image, between others: its ids are empty."""
    ids: Int[np.ndarray, " n"]
    """Of the tracks."""
    uv: Float[np.ndarray, "n 2"]
    """px"""
    people: dict[int, Float[np.ndarray, "25 3"]]
    """Keypoints (u px, v px, confidence) by person."""


@dataclasses.dataclass(frozen=True)
class Solved:
    """A window after its solve: `t` frames, `h` places for people."""

    first: int
    """Number of its first frame; frames of a map count from 0, and the past of the
    first window is before it."""
    times: Float[np.ndarray, " t"]
    T_WC: Float[np.ndarray, "t 4 4"]
    """Map units."""
    located: Bool[np.ndarray, " t"]
    people: tuple[int | None, ...]
    """Who is in each place."""
    present: Bool[np.ndarray, "h t"]
    roots: Float[np.ndarray, "h t 4 4"]
    """T_CH, m."""
    poses: Float[np.ndarray, "h t 23 3"]
    shapes: Float[np.ndarray, "h 10"]
    scale: float
    """m per map unit."""
    scale_sigma: float
    """NaN as long as nobody told it."""
    landmarks: dict[int, Float[np.ndarray, " 3"]]
    """Map units, by the number of the track."""
    contacts: Float[np.ndarray, "h t 4"]
    """Probability that left toe, left heel, right toe, right heel stand."""
    seconds: dict[str, float]
    """Of the parts of this step."""


class Window:
    """The last frames of one map, and who is in them."""

    def __init__(
        self,
        intrinsics: Intrinsics,
        body: BodyModel,
        config: Config,
        fps: float,
        places: int,
    ) -> None:
        """**Arguments:** `fps` of the window's frames; `places` for people."""
        self.intrinsics, self.body, self.config = intrinsics, body, config
        self.fps, self.places = fps, places
        self.count = 0
        """Measured frames in the window, after the past."""
        self.solved_until = -CHUNK
        """The first frame that no solve has seen."""
        self.first = self.start = -CHUNK
        """Number of its first frame, now and at first; frames of the map count from 0.
        """
        self.times = np.arange(FRAMES) / fps
        self.cameras = np.tile(np.eye(4), (FRAMES, 1, 1))
        self.located = np.zeros(FRAMES, bool)
        self.free = np.zeros((FRAMES, 6))
        self.seen: list[tuple[np.ndarray, np.ndarray]] = [_NOTHING] * FRAMES
        """Landmark and pixel of each observation, by frame."""
        self.uv = np.zeros((places, FRAMES, 25, 2))
        self.confidence = np.zeros((places, FRAMES, 25))
        self.roots = np.tile(np.eye(4), (places, FRAMES, 1, 1))
        self.poses = np.zeros((places, FRAMES, 23, 3))
        self.known = np.zeros((places, FRAMES), bool)
        """Where roots and poses are those of a solve."""
        self.shapes = np.zeros((places, 10))
        self.people: list[int | None] = [None] * places
        self.began = np.zeros(places, int)
        """Frame in which each person's shape is measured."""
        self.book: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        """Shape, and its standard deviations, of people who were here."""
        self.scale, self.scale_sigma = 1.0, float("nan")
        self.pixel_sigma = _SIGMA
        self.steps_told = np.zeros(places)
        """Information of marginalised steps on their common factor."""
        self.ground_told = 0.0
        """Marginalised frames with ground."""
        self.prior: graph.MarginalPrior | None = None
        self.where: dict[int, np.ndarray] = {}
        """Places of landmarks, map units."""
        self.life: dict[int, tuple[int, int]] = {}
        """Of a track: its landmark, and the chunk in which that ends."""
        self.track: dict[int, int] = {}
        """Of a landmark: its track."""
        self.landmarks = 0
        self.predictor: graph.MotionPredictor | None = None
        self.stands: graph.MotionPredictor | None = None

    def restart(self) -> None:
        """Forgets the map; people stay in the book."""
        for h in range(self.places):
            self._leave(h)
        book, told = self.book, (self.predictor, self.stands)
        self.__init__(self.intrinsics, self.body, self.config, self.fps, self.places)
        self.book = book
        self.predictor, self.stands = told

    def skip(self, frames: int) -> None:
        """Goes on as many frames later, in the same map: nothing is known of cameras,
        landmarks and postures there, but people and s are as they were."""
        self.prior = None
        people = list(self.people)
        told = self.steps_told, self.ground_told, self.pixel_sigma
        at = self.first + self.count + frames
        scale, variance = self.scale, self.scale_sigma**2
        self.restart()
        self.people = people
        self.steps_told, self.ground_told, self.pixel_sigma = told
        self.shapes = np.array([self._known_shape(p) for p in self.people])
        self.began[:] = -1
        self.first = self.start = self.solved_until = at
        walked = (scale * SCALE_WALK) ** 2 * frames / self.fps
        self.scale, self.scale_sigma = scale, (variance + walked) ** 0.5

    def advance(self, frames: list[Measured]) -> list[Solved]:
        """Takes more frames in, solves, and lets the oldest go.

        Of several chunks that waited the newest is followed by a solve, and an earlier
        one only where a chunk would leave before it was solved with all frames that its
        landmarks reach.

        **Returns:** the window after each of these solves: what leaves it is as the
        last of them that has it.

        **Raises:** `ValueError` if these are not whole chunks of ten frames.
        """
        if not frames or len(frames) % CHUNK:
            raise ValueError(f"frames: {len(frames)}, expected a multiple of {CHUNK}.")
        solved, clock = [], _Clock()
        for start in range(0, len(frames), CHUNK):
            if self.count == FRAMES - CHUNK:
                # Landmarks of the chunk that leaves go with all their observations:
                # without those in later frames the map would be cut there.
                cut = self.first + PRIOR > self.solved_until
                if cut or len(self.state.cameras) < PRIOR + CHUNK:
                    solved.append(self._solve(clock))
                    clock = _Clock()
                self._move_on()
                clock("marginalise")
            self._take(frames[start : start + CHUNK])
        return [*solved, self._solve(clock)]

    def _solve(self, clock: "_Clock") -> Solved:
        """Solves the window as it is."""
        sequence, state, roots = self._start()
        clock("start")
        problem, state, told = self._problem(sequence, state, roots)
        clock("factors")
        first = np.isnan(self.scale_sigma)
        steps = _FIRST_STEPS if first else _STEPS
        stage = solver.Stage(max_steps=steps, rtol=1e-4, atol=0.01)
        solution = solver.solve(problem, state, schedule=(stage,))
        state = solution.state
        state.scale.block_until_ready()
        clock("solve")
        self._measure(problem, state, bool(told.size))
        clock("covariance")
        contacts = self._contacts(state, roots)
        self._keep(problem, state, told)
        clock("contacts")
        self.solved_until = self.first + CHUNK + self.count
        return self._solved(contacts, clock.seconds)

    # What comes in.

    def _take(self, frames: list[Measured]) -> None:
        at = CHUNK + self.count
        if self.count == 0:  # The past of the first window is nothing.
            self.cameras[:] = frames[0].T_WC
        step = 1 / self.fps
        if self.count == 0:
            self.times[:at] = frames[0].time - step * np.arange(at, 0, -1)
        self.times[at : at + CHUNK] = [frame.time for frame in frames]
        later = np.arange(1, FRAMES - at - CHUNK + 1)
        self.times[at + CHUNK :] = frames[-1].time + step * later
        for k, frame in enumerate(frames, start=at):
            self.cameras[k:] = frame.T_WC
            self.located[k] = frame.located
            self.free[k] = float(frame.located and len(frame.ids) > 0)
            self.seen[k] = self._landmarks_of(k, frame) if frame.located else _NOTHING
            self.known[:, k:] = False
            self.uv[:, k:], self.confidence[:, k:] = 0.0, 0.0
            for person, points in frame.people.items():
                h = self._place_of(person, k)
                if h is not None:
                    self.uv[h, k] = points[:, :2]
                    self.confidence[h, k] = points[:, 2]
        self.count += CHUNK
        if self.first == self.start:
            self._fix_gauge()

    def _fix_gauge(self) -> None:
        """The first camera is held, and one coordinate of the farthest of the first
        window: the unit of the map."""
        shown = np.array([len(ids) > 0 for ids, _ in self.seen])
        here = CHUNK + np.flatnonzero(shown[CHUNK:])
        if not len(here):
            return
        self.free[here] = 1.0
        self.free[here[0]] = 0.0
        away = np.abs(self.cameras[here, :3, 3] - self.cameras[here[0], :3, 3])
        k, axis = np.unravel_index(np.argmax(away), away.shape)
        self.free[here[k], 3 + axis] = 0.0

    def _landmarks_of(self, k: int, frame: Measured) -> tuple[np.ndarray, np.ndarray]:
        chunk = (self.first + k) // CHUNK
        order = np.argsort([i not in self.life for i in frame.ids], kind="stable")
        chosen = np.sort(order[:_POINTS])
        rows = []
        for i in frame.ids[chosen].tolist():
            landmark, end = self.life.get(i, (-1, -1))
            if chunk >= end:
                # The first life of a track is shorter for two in three: tracks that
                # begin together end apart, so that no frame cuts the map in two.
                life = LIFE if landmark >= 0 else 1 + (i % LIFE)
                before = self.where.get(landmark)
                landmark, self.landmarks = self.landmarks, self.landmarks + 1
                self.life[i] = landmark, chunk + life
                self.track[landmark] = i
                if before is not None:
                    self.where[landmark] = before
            rows.append(landmark)
        return np.array(rows, int), np.asarray(frame.uv[chosen], float)

    def _place_of(self, person: int, k: int) -> int | None:
        """The person's place from frame `k` on; a new one gets that of somebody who was
        not seen for a while."""
        if person in self.people:
            return self.people.index(person)
        recent = slice(max(0, k - _AWAY), k)
        gone = [
            h
            for h, other in enumerate(self.people)
            if other is None or not (self.confidence[h, recent] > 0).any()
        ]
        if not gone:
            return None
        h = gone[0]
        self._leave(h)
        self.people[h] = person
        self.began[h] = -1
        self.steps_told[h] = 0.0
        self.known[h] = False
        self.uv[h], self.confidence[h] = 0.0, 0.0
        self.roots[h], self.poses[h] = np.eye(4), 0.0
        self.shapes[h] = self._known_shape(person)
        return h

    def _known_shape(self, person: int | None) -> Float[np.ndarray, " 10"]:
        known = None if person is None else self.book.get(person)
        return np.zeros(10) if known is None else known[0]

    def _leave(self, h: int) -> None:
        """Frees a place; what is known of the person's shape goes into the book."""
        person = self.people[h]
        if person is None:
            return
        sigma = np.full(10, self.config.weights.shape_sigma)
        self.book[person] = self.shapes[h].copy(), sigma
        if self.prior is not None:
            self.prior = priors.without_person(self.prior, h)
        self.people[h] = None

    # The problem.

    def _start(self) -> tuple[Sequence, graph.State, PersonState]:
        """The window as a sequence, the first state of its solve, and people's bodies
        as fitted to their keypoints alone."""
        keypoints = Keypoints(self.uv, self.confidence, self.config_definition)
        sequence = Sequence(
            name="window",
            frames=None,
            # Even times: the motion model's programs depend on how they lie.
            timestamps=np.arange(FRAMES) / self.fps,
            intrinsics=self.intrinsics,
            keypoints=keypoints,
        )
        given = keypoints, self.intrinsics, self.body, self.fps
        settings = self.config.people_fit
        bodies = people.fit_bodies(*given, settings, common_length=True)
        roots = people.roots_from_bodies(bodies, self.body)
        for h in range(self.places):
            self._start_person(h, roots)
        state = graph.State(
            scale=jnp.asarray(self.scale, float),
            cameras=jnp.asarray(self.cameras),
            roots=jnp.asarray(self.roots),
            poses=jnp.asarray(self.poses),
            shapes=jnp.asarray(self.shapes),
            landmarks=jnp.zeros((0, 3)),
            intrinsics=jnp.asarray(self.intrinsics.params, float),
        )
        return sequence, state, roots

    config_definition = "unknown"
    """What the detector calls a hip or a knee (`Keypoints.definition`)."""

    def _start_person(self, h: int, roots: PersonState) -> None:
        """Frames of a person that no solve has moved start at the fit."""
        there = roots.present[h]
        there[: CHUNK - 1] &= self.known[h, : CHUNK - 1]
        new = there & ~self.known[h]
        if not new.any():
            return
        if self.began[h] < 0:
            self.began[h] = self.first + int(np.argmax(there))
        if self.people[h] not in self.book and not self.known[h].any():
            self.shapes[h] = roots.shape[h]
        # A fit of another stature stands at another distance.
        both = np.flatnonzero(there & self.known[h])[-CHUNK:]
        ratio = 1.0
        if len(both):
            depths = (x[h, both, 2, 3] for x in (self.roots, roots.T_CH))
            ratio = float(np.median(np.divide(*depths)))
        self.roots[h, new] = roots.T_CH[h, new]
        self.roots[h, new, :3, 3] *= ratio
        self.poses[h, new] = roots.body_pose[h, new]

    def _problem(
        self, sequence: Sequence, state: graph.State, roots: PersonState
    ) -> tuple[graph.Problem, graph.State, np.ndarray]:
        weights = self.config.weights
        measured = np.arange(FRAMES) >= CHUNK
        tracks, places = self._tracks()
        state = eqx.tree_at(lambda s: s.landmarks, state, put(places))
        sigma = initialisation.landmark_sigma(self.pixel_sigma, weights)
        cameras = initialisation.map_factor(
            tracks, np.ones(len(tracks.frame), bool), sigma, weights
        )
        of_people = [
            self._shape_once(f, roots) if isinstance(f, graph.ShapePrior) else f
            for f in initialisation.people_factors(sequence, roots, weights, self.body)
        ]
        if self.predictor is None:
            given = sequence, roots, self.body, self.config
            self.predictor = motion_predictor(*given)
            self.stands = contact_predictor(*given)
        located = self.located | (np.arange(FRAMES) < CHUNK)
        predictor = dataclasses.replace(
            self.predictor, present=jnp.asarray(roots.present & located)
        )
        prediction = predict(predictor, state)
        legs = people.legs_shown(
            people.shown_keypoints(sequence, self.body), roots.present, self.fps
        )
        steps = initialisation.steps_shown(prediction, legs, self.fps)
        moved = initialisation.motion_factor(
            steps, state.shapes, self.body, weights, shared_error=0.0
        )
        moved, told = self._steps_once(moved, measured)
        ground, state = self._ground(sequence, state, roots, legs, steps, measured)
        factors = [*of_people, moved, ground]
        factors = [cameras, *(in_frames(f, measured) for f in factors)]
        if self.prior is None:
            nothing = priors.no_prior(state, PRIOR, 2)
            self.prior = priors.with_scale(nothing, self.scale_sigma)
        metric = np.isfinite(self.scale_sigma) or bool((told > 0).any())
        free = dataclasses.replace(state, landmarks=put(places[:0])).zero_step()
        ones = lambda x, mask: jnp.ones_like(x) * jnp.asarray(mask, x.dtype)
        past = np.asarray(np.arange(FRAMES) >= CHUNK - self.prior.reach)
        last = np.asarray(np.arange(FRAMES) >= CHUNK - 1)
        filled = np.arange(FRAMES) < CHUNK + self.count
        there = roots.present & filled
        free = dataclasses.replace(
            free,
            scale=ones(free.scale, float(metric)),
            cameras=jnp.asarray(self.free * past[:, None]),
            roots=ones(free.roots, (there & past)[..., None]),
            poses=ones(free.poses, (there & last)[..., None, None]),
            shapes=ones(free.shapes, np.asarray(there.any(axis=1))[:, None]),
            landmarks=put(np.ones(places.shape)),
        )
        problem = graph.make_problem(
            [*factors, self.prior],
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
        return problem, state, told if metric else told[:0]

    def _tracks(self) -> tuple[Tracks, Float[np.ndarray, "l 3"]]:
        """Observations of the landmarks that are in the graph, and their places."""
        frame = np.concatenate([np.full(len(s[0]), k) for k, s in enumerate(self.seen)])
        landmark = np.concatenate([s[0] for s in self.seen]).astype(int)
        uv = np.concatenate([s[1] for s in self.seen])
        known, row, seen = np.unique(landmark, return_inverse=True, return_counts=True)
        R_CW = np.swapaxes(self.cameras[:, :3, :3], 1, 2)[frame]
        centre = self.cameras[frame, :3, 3]
        K, distortion = as_opencv(self.intrinsics.params)
        xy = rays(uv, K, distortion)
        pixel = 1 / K[0, 0]
        places = np.array([self.where.get(i, _NOWHERE) for i in known.tolist()])
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
        limit = _OUTLIER * self.pixel_sigma * pixel
        off = np.bincount(row, np.logical_or(~front, away > limit), len(known)) / seen
        good = (seen >= _LEAST_SEEN) & (off < 0.5)
        good &= widest_angle(centre, row, places) > _LEAST_ANGLE
        for i in known[~good]:
            self.where.pop(int(i), None)
        good = _most(good, seen, _ROOM)
        rows = np.flatnonzero(good[row])
        number = np.cumsum(good) - 1
        self.in_graph = known[good]
        return Tracks(frame[rows], number[row[rows]], uv[rows]), places[good]

    def _shape_once(
        self, factor: graph.ShapePrior, roots: PersonState
    ) -> graph.ShapePrior:
        """One measurement of each person's shape: the fit in their first frame here, or
        what the book has of them."""
        sigma = np.full(np.shape(factor.sigma), np.inf)
        shape = np.array(factor.shape)
        for h, person in enumerate(self.people):
            k = self.began[h] - self.first
            if person is None or not 0 <= k < FRAMES or not roots.present[h].any():
                continue
            mean, known = self.book.get(
                person, (roots.shape[h], self.config.weights.shape_sigma)
            )
            shape[h], sigma[h, k] = mean, known
        return eqx.tree_at(
            lambda f: (f.shape, f.sigma),
            factor,
            (jnp.asarray(shape), jnp.asarray(sigma)),
        )

    def _steps_once(
        self, moved: graph.HumanMotion, measured: np.ndarray
    ) -> tuple[graph.HumanMotion, Float[np.ndarray, "h t"]]:
        """Steps with the weight by which they add to those before.

        With an error e common to all steps, information I on their factor is worth
        `I / (1 + e² I)`. What it grows by from I_0 to I_0 + I is the weight
        `1 / ((1 + e² I_0) (1 + e² (I_0 + I)))` of I.

        **Returns:** the information of each frame, too.
        """
        weights = self.config.weights
        whitening = np.array(moved.whitening)
        step = np.asarray(moved.translation)
        rho = weights.motion_correlation
        told = ((whitening @ step[..., None])[..., 0] ** 2).sum(-1)
        told = told * (1 - rho) / (1 + rho) * measured
        squared = weights.fitted_step_error**2
        before = 1 + squared * self.steps_told
        after = before + squared * told.sum(axis=1)
        whitening *= (before * after)[:, None, None, None] ** -0.5
        moved = eqx.tree_at(lambda f: f.whitening, moved, jnp.asarray(whitening))
        return moved, told

    def _ground(
        self,
        sequence: Sequence,
        state: graph.State,
        roots: PersonState,
        legs: np.ndarray,
        steps: Prediction,
        measured: np.ndarray,
    ) -> tuple[graph.GroundContact, graph.State]:
        """The factor of people on the ground of the map, and the state with a first
        scale if it has none yet and there is something that tells it."""
        weights = self.config.weights
        blank = graph.GroundContact(
            self.body,
            jnp.asarray([0.0, -1.0, 0.0]),
            jnp.zeros((self.places, FRAMES)),
            jnp.full((self.places, FRAMES), jnp.inf),
        )
        present = roots.present & self.located & legs & measured
        contact = None
        if present.sum() >= CHUNK:
            contact = initialisation.ground_contact(
                state, present, sequence.keypoints, self.body, weights, self.fps
            )
        if contact is not None:
            contact = initialisation.with_wander(contact, state, self.fps)
        if np.isnan(self.scale_sigma):
            start = ScaleStart()
            if np.asarray(steps.valid)[:, CHUNK:].sum() >= _LEAST_STEPS:
                start = initialisation.scale_start(
                    state, steps, contact, shared_error=weights.fitted_step_error
                )
            if np.isfinite(start.standard_error) and start.value > 0:
                scale = jnp.asarray(start.value, state.scale.dtype)
                state = eqx.tree_at(lambda s: s.scale, state, scale)
        if contact is None:
            return blank, state
        sigma = np.asarray(contact.sigma)
        used = np.isfinite(sigma)
        count, told = float(used.sum()), self.ground_told
        share = lambda n: n / (_GROUND_COUNTS + n)
        grown = max(share(told + count) - share(told), 1e-9)
        # `sigma` is that of all frames together times the root of their number.
        sigma = sigma / np.sqrt(count) * np.sqrt(count / grown)
        return eqx.tree_at(lambda f: f.sigma, contact, jnp.asarray(sigma)), state

    # What comes out.

    def _measure(
        self, problem: graph.Problem, state: graph.State, metric: bool
    ) -> None:
        """Standard deviation of s by the window's posterior."""
        if not metric:
            return
        spread = solver.marginals(problem, state)
        present = np.array([p is not None for p in self.people])
        variance = float(spread.scale)
        if present.any():
            sigma = np.where(present, self.config.weights.shape_sigma, 1.0)
            variance = float(
                inflate_fitted_shapes(
                    spread.scale,
                    spread.shapes,
                    state.scale,
                    state.shapes,
                    self.body,
                    sigma,
                    present,
                )[0]
            )
        self.scale_sigma = variance**0.5

    def _contacts(
        self, state: graph.State, roots: PersonState
    ) -> Float[np.ndarray, "h t 4"]:
        if self.stands is None or not roots.present.any():
            return np.zeros((self.places, FRAMES, 4))
        present = jnp.asarray(roots.present)
        predictor = dataclasses.replace(self.stands, present=present)
        return contact_probability(predictor, state, self.fps)

    def _keep(
        self, problem: graph.Problem, state: graph.State, told: np.ndarray
    ) -> None:
        self.cameras = np.array(state.cameras)
        self._bridge()
        self.cameras[CHUNK + self.count :] = self.cameras[CHUNK + self.count - 1]
        present = np.array(np.asarray(problem.free.poses).any(axis=(2, 3)))
        present[:, :CHUNK] |= self.known[:, :CHUNK]
        self.roots, self.poses = np.array(state.roots), np.array(state.poses)
        self.known |= present & (np.arange(FRAMES) < CHUNK + self.count)
        self.shapes = np.array(state.shapes)
        self.scale = float(state.scale)
        for i, place in zip(self.in_graph.tolist(), np.asarray(state.landmarks)):
            self.where[i] = place
        tracks = problem.factors[0]
        assert isinstance(tracks, graph.Reprojection)
        self._measure_pixels(tracks, np.asarray(state.landmarks))
        self.problem, self.state = problem, state
        self.told = told

    def _bridge(self) -> None:
        """Puts cameras without an image between those around them."""
        rows = np.arange(CHUNK, CHUNK + self.count)
        shown = np.array([len(self.seen[k][0]) > 0 for k in rows], bool)
        solved = rows[shown]
        missing = rows[~shown & self.located[rows]]
        missing = missing[(missing > solved.min(initial=FRAMES))]
        missing = missing[(missing < solved.max(initial=0))]
        if len(missing):
            self.cameras[missing] = between(solved, self.cameras[solved], missing)

    def _measure_pixels(
        self, tracks: graph.Reprojection, places: Float[np.ndarray, "l 3"]
    ) -> None:
        """Noise of the tracks, by the residuals."""
        frame, landmark = np.asarray(tracks.frame), np.asarray(tracks.landmark)
        if len(frame) < _LEAST_ROWS:
            return
        T_WC = self.cameras[frame]
        p_C = np.einsum(
            "mji,mj->mi", T_WC[:, :3, :3], places[landmark] - T_WC[:, :3, 3]
        )
        K, distortion = as_opencv(self.intrinsics.params)
        xy = rays(np.asarray(tracks.pixel), K, distortion)
        front = p_C[:, 2] > 1e-6
        away = K[0, 0] * (p_C[front, :2] / p_C[front, 2:] - xy[front])
        low, high = initialisation.PIXEL_SIGMA_RANGE
        sigma = 1.4826 * float(np.median(np.abs(away)))
        self.pixel_sigma = float(np.clip(sigma, low, high))

    def _move_on(self) -> None:
        """Marginalises the oldest measured chunk and moves the window on."""
        # Predictions are made here, by a program of one shape.
        problem = self.problem
        if problem.motion is not None:
            bare = dataclasses.replace(self.state, landmarks=jnp.zeros((0, 3)))
            problem = problem.with_prediction(_prediction(problem.motion, bare))
            problem = dataclasses.replace(problem, motion=None)
        left = solver.marginalise(problem, self.state, 2 * CHUNK)
        prior = left.problem.factors[-1]
        assert isinstance(prior, graph.MarginalPrior)
        prior = priors.padded(prior, left.state, PRIOR)
        walk = self.scale * SCALE_WALK
        self.prior = priors.with_walk_of_scale(prior, walk**2 * CHUNK / self.fps)
        if self.told.size:
            self.steps_told += self.told[:, CHUNK : 2 * CHUNK].sum(axis=1)
            self.told = self.told[:, CHUNK:]
        sigma = np.asarray(_ground_of(problem).sigma)[:, CHUNK : 2 * CHUNK]
        self.ground_told += float(np.isfinite(sigma).sum())
        gone = np.concatenate([s[0] for s in self.seen[CHUNK : 2 * CHUNK]])
        gone = np.unique(gone)
        move = lambda x, axis: np.concatenate(
            [
                np.take(x, np.arange(CHUNK, FRAMES), axis),
                np.take(x, np.full(CHUNK, FRAMES - 1), axis),
            ],
            axis,
        )
        for name in ("cameras", "located", "free"):
            setattr(self, name, move(getattr(self, name), 0))
        for name in ("uv", "confidence", "roots", "poses", "known"):
            setattr(self, name, move(getattr(self, name), 1))
        last = self.times[-1] + np.arange(1, CHUNK + 1) / self.fps
        self.times = np.concatenate([self.times[CHUNK:], last])
        self.known[:, FRAMES - CHUNK :] = False
        self.confidence[:, FRAMES - CHUNK :] = 0.0
        self.seen = self.seen[CHUNK:] + [_NOTHING] * CHUNK
        for k in range(FRAMES):
            ids, uv = self.seen[k]
            kept = ~np.isin(ids, gone) & (k >= CHUNK)
            self.seen[k] = ids[kept], uv[kept]
        # What is left is marginalised next where chunks come faster than solves.
        factors = (*left.problem.factors[:-1], self.prior)
        self.problem = dataclasses.replace(left.problem, factors=factors)
        self.state = left.state
        self.first += CHUNK
        self.count -= CHUNK
        self._forget()

    def _forget(self) -> None:
        """Landmarks and tracks that are in no frame any more."""
        here = set(np.concatenate([s[0] for s in self.seen]).tolist())
        chunk = (self.first + FRAMES) // CHUNK - 1
        self.life = {
            i: (landmark, end)
            for i, (landmark, end) in self.life.items()
            if landmark in here or end >= chunk
        }
        current = {landmark for landmark, _ in self.life.values()} | here
        self.where = {i: x for i, x in self.where.items() if i in current}
        self.track = {i: x for i, x in self.track.items() if i in current}

    def _solved(self, contacts: np.ndarray, seconds: dict[str, float]) -> Solved:
        shown = slice(0, CHUNK + self.count)
        return Solved(
            first=self.first,
            times=self.times[shown].copy(),
            T_WC=self.cameras[shown].copy(),
            located=self.located[shown].copy(),
            people=tuple(self.people),
            present=self.known[:, shown].copy(),
            roots=self.roots[:, shown].copy(),
            poses=self.poses[:, shown].copy(),
            shapes=self.shapes.copy(),
            scale=self.scale,
            scale_sigma=self.scale_sigma,
            landmarks={
                self.track[i]: self.where[i]
                for i in self.in_graph.tolist()
                if i in self.track
            },
            contacts=contacts[:, shown],
            seconds=seconds,
        )


def between(
    known: Real[np.ndarray, " n"],
    T: Float[np.ndarray, "n 4 4"],
    wanted: Real[np.ndarray, " m"],
) -> Float[np.ndarray, "m 4 4"]:
    """Poses at other times, interpolated; beyond the ends the first and the last."""
    found = np.tile(np.eye(4), (len(wanted), 1, 1))
    after = np.clip(np.searchsorted(known, wanted), 0, len(known) - 1)
    before = np.clip(np.searchsorted(known, wanted, side="right") - 1, 0, None)
    gap = np.maximum(known[after] - known[before], 1e-9)
    share = np.clip((wanted - known[before]) / gap, 0.0, 1.0)
    a, b = T[before], T[after]
    found[:, :3, 3] = a[:, :3, 3] + share[:, None] * (b[:, :3, 3] - a[:, :3, 3])
    found[:, :3, :3] = so3.interpolate(a[:, :3, :3], b[:, :3, :3], share)
    return found


@eqx.filter_jit
def _prediction(predictor: graph.MotionPredictor, state: graph.State) -> object:
    """As `Problem.predict`."""
    found = predictor(state)
    return {
        "translation": found.translation,
        "leg": leg_length(predictor.body, state.shapes)[:, None, None],
        "rotation": found.rotation,
        "body_pose": found.body_pose,
        "valid": found.valid,
    }


_LEAST_ROWS = 100
"""Observations by which the noise of the tracks is measured."""
_NOTHING = np.zeros(0, int), np.zeros((0, 2))
_NOWHERE = np.full(3, np.nan)
_ROOM = 540
"""Landmarks that the tables of a window hold, partly filled as they are."""
_POINTS = 150
"""Most observations of a frame that are in the graph."""
_VARIABLES = ("scale", "cameras", "roots", "poses", "shapes", "landmarks")


def _most(good: np.ndarray, seen: np.ndarray, most: int) -> np.ndarray:
    """At most so many of the good ones, those that are seen most."""
    if good.sum() <= most:
        return good
    order = np.argsort(np.where(good, -seen, 0), kind="stable")
    kept = np.zeros(len(good), bool)
    kept[order[:most]] = True
    return kept & good


def _ground_of(problem: graph.Problem) -> graph.GroundContact:
    for factor in problem.factors:
        inner = getattr(factor, "factor", factor)
        if isinstance(inner, graph.GroundContact):
            return inner
    raise AssertionError("a window has a factor of the ground")


class _Clock:
    """Durations of parts, one after another."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.last = time.perf_counter()

    def __call__(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self.last
        self.last = now
