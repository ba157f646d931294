"""Names what the measurements do not determine, with the likely cause."""

from collections.abc import Iterator

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from bodyslam_jax.graph import (
    AspectRatioPrior,
    CameraPrior,
    FrameFactor,
    IntrinsicsPrior,
    LandmarkPrior,
    Problem,
    Reprojection,
    State,
    world_from_root,
)
from bodyslam_jax.solver.covariance import Marginals

MAX_RELATIVE_DEVIATION = 1 / 3
"""Relative standard deviation above which a quantity is not determined."""
MIN_PATH_TO_DISTANCE = 0.01
"""Least ratio of the camera path's extent to the landmarks' distance for depth."""
MIN_ROTATION_DEG = 3.0
"""Degrees about its mean axis; a camera that turns less does not turn."""
MIN_TRAVEL_M = 0.1
"""Extent in m below which a pelvis, or the camera, does not move."""
MAX_POSTERIOR_TO_PRIOR = 0.7
"""Standard deviation over the prior's, above which measurements do not determine a
quantity."""


def observability(problem: Problem, state: State, spread: Marginals) -> tuple[str, ...]:
    """Returns a line for each quantity that the measurements do not determine.

    A quantity counts as not determined where its standard deviation is more than a
    third of its value; focal length and body size also where it is hardly below that of
    their priors. `state` is a solution and `spread` its `marginals`; for the host, not
    for `jit`.
    """
    scene = _Scene(problem, state)
    parts = (_scale, _focal_length, _halves, _landmarks, _cameras, _people)
    return tuple(line for part in parts for line in part(scene, spread))


class _Scene:
    """Cameras, landmarks and people of a solution, in metres."""

    def __init__(self, problem: Problem, state: State) -> None:
        self.problem = problem
        self.state = state
        self.scale = float(state.scale)
        cameras = np.asarray(state.cameras)
        self.axes = cameras[:, :3, 2]
        self.centres = self.scale * cameras[:, :3, 3]
        self.points = self.scale * np.asarray(state.landmarks)
        self.frame, self.landmark = _observations(problem)
        self.seen = np.zeros(len(self.points), bool)
        self.seen[self.landmark] = True
        self.places = np.asarray(world_from_root(state))[..., :3, 3]
        self.present = np.ones(self.places.shape[:2], bool)
        if problem.motion is not None:
            self.present = np.asarray(problem.motion.present).astype(bool)
        away = self.centres - self.centres.mean(axis=0)
        self.reach = 2 * float(np.max(np.linalg.norm(away, axis=1), initial=0.0))

    def has(self, group: str) -> bool:
        return group in self.problem.variables

    def turned(self) -> float:
        """Returns the largest angle of an optical axis to the mean one, degrees."""
        axis = self.axes.mean(axis=0)
        axis /= max(np.linalg.norm(axis), 1e-12)
        return float(np.rad2deg(np.arccos(np.clip(np.min(self.axes @ axis), -1, 1))))

    def moves(self) -> bool:
        """Returns True if the camera moves far enough to show depths."""
        apart = self.points[self.seen] - self.centres.mean(axis=0)
        distance = np.linalg.norm(apart, axis=1)
        return not len(distance) or bool(
            self.reach > MIN_PATH_TO_DISTANCE * np.median(distance)
        )

    def camera(self) -> str:
        """Returns the motion of the camera that leaves quantities undetermined."""
        if not self.moves():
            does = "turns but does not move" if self.turned() > 1 else "stands still"
            return f"the camera {does}"
        along = np.ptp(self.centres @ self.axes.mean(axis=0))
        if self.turned() < MIN_ROTATION_DEG and along < 0.2 * self.reach:
            return "the camera moves parallel to its image and does not turn"
        return "too few points, or the camera hardly moves"

    def has_size(self) -> bool:
        """Returns True if people or priors fix the unit of the map."""
        ties = LandmarkPrior, CameraPrior
        return bool(len(self.places)) or any(
            isinstance(x, ties) for x in self.problem.factors
        )

    def is_steady(self) -> bool:
        """Returns True if a factor couples cameras of different frames."""
        return any(
            isinstance(x, FrameFactor) and not x.of_people and x.num_lags > 1
            for x in self.problem.factors
        )

    def stand_still(self) -> list[int]:
        """Returns the people whose pelvis moves less than `MIN_TRAVEL_M`."""
        far = [
            np.max(np.ptp(place[here], axis=0)) if here.any() else 0.0
            for place, here in zip(self.places, self.present, strict=True)
        ]
        return [person for person, reach in enumerate(far) if reach < MIN_TRAVEL_M]


def _observations(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Returns the frame and landmark of each observation with a finite sigma."""
    pairs = [
        np.stack([np.asarray(x.frame), np.asarray(x.landmark)])[:, np.isfinite(x.sigma)]
        for x in problem.factors
        if isinstance(x, Reprojection)
    ]
    frame, landmark = np.concatenate([np.zeros((2, 0), int), *pairs], axis=1)
    return frame, landmark


def _deviation(covariance) -> np.ndarray:
    """Returns the root of the trace, m: the standard deviation of a position."""
    variance = np.trace(np.asarray(covariance), axis1=-2, axis2=-1)
    return np.sqrt(np.maximum(variance, 0.0))


def _scale(scene: _Scene, spread: Marginals) -> Iterator[str]:
    if not scene.has("scale"):
        return
    share = float(np.sqrt(max(float(spread.scale), 0.0))) / scene.scale
    if share < MAX_RELATIVE_DEVIATION:
        return
    people = len(scene.places)
    still = scene.stand_still()
    if not people:
        why = "nobody is there to tell it"
    elif len(still) == people:
        who = "the person stands" if people == 1 else "all people stand"
        why = f"{who} still"
    elif scene.reach < MIN_TRAVEL_M:
        why = "the camera hardly moves"
    else:
        why = "nothing links people's motion to the map, or nothing tells how far it is"
    known = f"known to {share:.0%} only" if share < 1 else "not known"
    yield f"scale: {known}; {why}."


def _focal_length(scene: _Scene, spread: Marginals) -> Iterator[str]:
    if not scene.has("intrinsics"):
        return
    size = float(scene.state.intrinsics[0])
    deviation = float(np.sqrt(max(float(spread.intrinsics[0, 0]), 0.0)))
    before = min(
        (
            float(x.sigma[0, 0])
            for x in scene.problem.factors
            if isinstance(x, IntrinsicsPrior)
        ),
        default=np.inf,
    )
    if any(isinstance(x, AspectRatioPrior) for x in scene.problem.factors):
        before /= np.sqrt(2)  # known twice
    if not deviation < min(
        MAX_RELATIVE_DEVIATION * size, MAX_POSTERIOR_TO_PRIOR * before
    ):
        share = deviation / size
        yield f"focal length: known to {share:.0%} only; {scene.camera()}."


def _halves(scene: _Scene, spread: Marginals) -> Iterator[str]:
    """Reports parts of the video that share no landmark, and so have no common map."""
    if not scene.has("cameras") or not len(scene.frame):
        return
    t, l = len(scene.centres), len(scene.points)
    edges = (np.ones(len(scene.frame)), (scene.frame, t + scene.landmark))
    _, part = connected_components(coo_array(edges, (t + l, t + l)), directed=False)
    used = np.unique(scene.frame)
    first = {part[frame]: frame for frame in used[::-1]}
    if len(first) > 1:
        start = ", ".join(str(x) for x in sorted(first.values())[1:6])
        yield (
            f"one map: {len(first)} parts of the video share no landmark, from frames "
            f"{start} on."
        )


def _landmarks(scene: _Scene, spread: Marginals) -> Iterator[str]:
    if not len(scene.points) or not scene.has("landmarks"):
        return
    seen = scene.seen
    if not seen.all():
        yield f"landmarks: {int((~seen).sum())} are not observed."
    if scene.moves() and not scene.has_size():
        yield "size of the map: nothing tells it, and one camera shows none."
        return
    depth = np.linalg.norm(scene.points - scene.centres.mean(axis=0), axis=1)
    lost = seen & ~(_deviation(spread.landmarks) < MAX_RELATIVE_DEVIATION * depth)
    if lost.sum() > 0.5 * seen.sum():
        count = f"{int(lost.sum())} of {int(seen.sum())}"
        yield f"depth of {count} landmarks: {scene.camera()}."
    elif lost.any():
        yield f"depth of {int(lost.sum())} landmarks: seen from one place."


def _cameras(scene: _Scene, spread: Marginals) -> Iterator[str]:
    if not scene.has("cameras"):
        return
    if scene.moves() and not scene.has_size():
        blind = len(scene.centres) - len(np.unique(scene.frame))
        if blind and not scene.is_steady():
            yield f"cameras of {blind} frames: no landmark is seen in them."
        return
    reach = max(scene.reach, 1e-9)
    lost = ~(_deviation(spread.cameras) < MAX_RELATIVE_DEVIATION * reach)
    if lost[1:].any():
        yield f"centres of {int(lost[1:].sum())} cameras: {scene.camera()}."


def _people(scene: _Scene, spread: Marginals) -> Iterator[str]:
    for person in range(len(scene.places)):
        if scene.has("roots"):
            apart = scene.places[person] - scene.centres
            distance = np.linalg.norm(apart, axis=1)
            lost = ~(
                _deviation(spread.people[person]) < MAX_RELATIVE_DEVIATION * distance
            )
            lost &= scene.present[person]
            if lost.any():
                yield f"place of person {person} in {int(lost.sum())} frames."
        if scene.has("shapes"):
            # Shape components are in standard deviations of the population.
            deviation = float(np.sqrt(max(float(spread.shapes[person, 0, 0]), 0.0)))
            if not deviation < MAX_POSTERIOR_TO_PRIOR:
                yield f"size of person {person}: little better known than anybody's."
