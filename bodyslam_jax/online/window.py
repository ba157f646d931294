"""The fixed-lag window: solves the graph over the last frames and marginalises old
ones.

When the window is full, `solver.marginalise` puts its oldest measured chunk into the
prior, and it moves on by ten frames.
"""

import dataclasses
import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import graph, initialisation, solver
from bodyslam_jax.diagnostics.scale_uncertainty import inflate_fitted_shapes
from bodyslam_jax.diagnostics.statistics import stature_and_sigma
from bodyslam_jax.geometry.lengths import put
from bodyslam_jax.graph import CHUNK
from bodyslam_jax.io.camera.calibration import as_opencv, rays
from bodyslam_jax.motion import leg_length
from bodyslam_jax.online import prior as priors
from bodyslam_jax.online import window_problem
from bodyslam_jax.online.window_content import FRAMES, PRIOR, Content, Measured
from bodyslam_jax.people import PersonState
from bodyslam_jax.pipeline.motion_prediction import contact_probability

_NUM_FIRST_STEPS, _NUM_STEPS = 15, 4
"""Steps of a window's solve: of the first one with a scale, and of all others."""
SCALE_WALK = 0.015
"""Relative standard deviation by which the unit of the map changes in a second: the
drift that is measured in a minute of a rendered room, 12 %, over the root of its
seconds (`benchmarks/online.md`)."""
_MIN_OBSERVATIONS = 100
"""Least number of observations from which the noise of the tracks is estimated."""


@dataclasses.dataclass(frozen=True)
class Solved:
    """A window after its solve: `t` frames, `h` slots for people."""

    first: int
    """Number of its first frame; frames of a map count from 0, and the past of the
    first window is before it."""
    times: Float[np.ndarray, " t"]
    T_WC: Float[np.ndarray, "t 4 4"]
    """Camera to map, map units."""
    located: Bool[np.ndarray, " t"]
    people: tuple[int | None, ...]
    """Number of the person in each slot."""
    present: Bool[np.ndarray, "h t"]
    roots: Float[np.ndarray, "h t 4 4"]
    """T_CH, m."""
    poses: Float[np.ndarray, "h t 23 3"]
    shapes: Float[np.ndarray, "h 10"]
    shape_covariance: Float[np.ndarray, "h 10 10"]
    """Covariance of each shape; NaN where it was not computed."""
    scale: float
    """m per map unit."""
    scale_sigma: float
    """Standard deviation of `scale`; NaN as long as the scale is unknown."""
    landmarks: dict[int, Float[np.ndarray, " 3"]]
    """Positions of landmarks, map units, by the number of the track."""
    contacts: Float[np.ndarray, "h t 4"]
    """Probability that left toe, left heel, right toe, right heel are in contact with
    the ground."""
    seconds: dict[str, float]
    """Duration of each part of this step, s."""
    fixed: bool = False
    """True if the camera was held: `scale` is 1 then, and `scale_sigma` the relative
    standard deviation of people's sizes."""


class Window(Content):
    """The last frames of one map, solved."""

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
            self._follow()
            self._take(frames[start : start + CHUNK])
        return [*solved, self._solve(clock)]

    def follow(self, ratio: float) -> None:
        """Lets s follow a drift of the map's unit that a loop told: the unit became so
        many times as long as the window knew."""
        self.drift *= ratio

    def _follow(self) -> None:
        if self.drift == 1.0:
            return
        self.scale *= self.drift
        self.scale_sigma *= self.drift
        if self.prior is not None:
            self.prior = priors.with_drift_of_scale(self.prior, self.drift)
        self.drift = 1.0
        # The last problem is of the unit before: it is solved before frames leave.
        self.solved_until = self.first

    def skip(self, frames: int) -> None:
        """Resumes after a gap of so many frames, in the same map: cameras, landmarks
        and postures of the gap are unknown, people and s are kept."""
        self.prior = None
        self._follow()
        people, fixed = list(self.people), self.fixed
        at = self.first + self.count + frames
        scale, variance = self.scale, self.scale_sigma**2
        walked = SCALE_WALK**2 * frames / self.fps
        window_problem.forget(self, walked)
        told = self.steps_told, self.ground_told, self.pixel_sigma
        self.restart()
        self.people, self.fixed = people, fixed
        self.steps_told, self.ground_told, self.pixel_sigma = told
        self.shapes = np.array([self._known_shape(p) for p in self.people])
        self.began[:] = -1
        self.first = self.start = self.solved_until = at
        self.scale = scale
        self.scale_sigma = (variance + scale**2 * walked) ** 0.5

    def _solve(self, clock: "_Clock") -> Solved:
        """Solves the window with its current frames."""
        sequence, state, roots = window_problem.start(self)
        clock("start")
        problem, state, told = window_problem.make(self, sequence, state, roots)
        clock("factors")
        first = np.isnan(self.size_sigma if self.fixed else self.scale_sigma)
        steps = _NUM_FIRST_STEPS if first else _NUM_STEPS
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

    def _measure(
        self, problem: graph.Problem, state: graph.State, metric: bool
    ) -> None:
        """Updates the standard deviations of s and of people's sizes from the window's
        posterior."""
        present = np.array([p is not None for p in self.people])
        seen = present & np.asarray(problem.free.shapes).any(axis=1)
        if not (metric or (self.fixed and seen.any())):
            return
        spread = solver.marginals(problem, state)
        variance, shapes = spread.scale, spread.shapes
        if present.any():
            sigma = np.where(present, self.config.weights.shape_sigma, 1.0)
            of_state = state.scale, state.shapes, self.body
            given = variance, shapes, *of_state, sigma, present
            variance, shapes = inflate_fitted_shapes(*given)
        self.shape_covariance[seen] = np.asarray(shapes)[seen]
        if not self.fixed:
            sigma = float(variance) ** 0.5
            # The next solve looks for a first scale again.
            known = sigma < window_problem.MAX_SCALE_SIGMA * float(state.scale)
            self.scale_sigma = sigma if known else float("nan")
            return
        betas = np.asarray(state.shapes, float)
        relative = []
        for h in np.flatnonzero(seen):
            given = self.body, betas[h], self.shape_covariance[h]
            stature, sigma = stature_and_sigma(*given)
            relative.append(sigma / stature)
        # The errors of people's sizes are independent.
        self.size_sigma = float(np.linalg.norm(relative)) / len(relative)

    def _contacts(
        self, state: graph.State, roots: PersonState
    ) -> Float[np.ndarray, "h t 4"]:
        if self.stands is None or not roots.present.any():
            return np.zeros((self.places, FRAMES, 4))
        present = jnp.asarray(roots.present)
        predictor = window_problem.at_times(self, self.stands, present)
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
        # Before a camera that is held s is the height of the floor in this window.
        self.scale = 1.0 if self.fixed else float(state.scale)
        for i, place in zip(self.in_graph.tolist(), np.asarray(state.landmarks)):
            self.where[i] = place
        tracks = problem.factors[0]
        assert isinstance(tracks, graph.Reprojection)
        self._measure_pixels(tracks, np.asarray(state.landmarks))
        self.problem, self.state = _strong(problem), _strong(state)
        self.told = told

    def _measure_pixels(
        self, tracks: graph.Reprojection, places: Float[np.ndarray, "l 3"]
    ) -> None:
        """Updates the noise of the tracks from the residuals."""
        frame, landmark = np.asarray(tracks.frame), np.asarray(tracks.landmark)
        if len(frame) < _MIN_OBSERVATIONS:
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
        walk = np.inf if self.fixed else self.scale * SCALE_WALK
        self.prior = priors.with_walk_of_scale(prior, walk**2 * CHUNK / self.fps)
        if self.told.size:
            self.steps_told += self.told[:, CHUNK : 2 * CHUNK].sum(axis=1)
            self.told = self.told[:, CHUNK:]
        sigma = np.asarray(_ground_of(problem).sigma)[:, CHUNK : 2 * CHUNK]
        self.ground_told += float(np.isfinite(sigma).sum())
        window_problem.forget(self, SCALE_WALK**2 * CHUNK / self.fps)
        self._shift()
        # What is left is marginalised next where chunks come faster than solves.
        factors = (*left.problem.factors[:-1], self.prior)
        self.problem = dataclasses.replace(left.problem, factors=factors)
        self.state = left.state

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
            shape_covariance=self.shape_covariance.copy(),
            scale=self.scale,
            scale_sigma=self.size_sigma if self.fixed else self.scale_sigma,
            landmarks={
                self.track[i]: self.where[i]
                for i in self.in_graph.tolist()
                if i in self.track
            },
            contacts=contacts[:, shown],
            seconds=seconds,
            fixed=self.fixed,
        )


def _strong(tree: Any) -> Any:
    """Returns arrays whose type JAX had weakened (of Python's numbers) with that type,
    as they are when they come from a file: a program is compiled for each kind."""
    weak = lambda x: isinstance(x, jax.Array) and x.weak_type
    return jax.tree.map(lambda x: put(x) if weak(x) else x, tree)


@eqx.filter_jit
def _prediction(predictor: graph.MotionPredictor, state: graph.State) -> object:
    """Returns the prediction as `Problem.predict` does, compiled."""
    found = predictor(state)
    return {
        "translation": found.translation,
        "leg": leg_length(predictor.body, state.shapes)[:, None, None],
        "rotation": found.rotation,
        "body_pose": found.body_pose,
        "valid": found.valid,
    }


def _ground_of(problem: graph.Problem) -> graph.GroundContact:
    for factor in problem.factors:
        inner = getattr(factor, "factor", factor)
        if isinstance(inner, graph.GroundContact):
            return inner
    raise AssertionError("a window has a factor of the ground")


class _Clock:
    """Durations of consecutive parts."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.last = time.perf_counter()

    def __call__(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self.last
        self.last = now
