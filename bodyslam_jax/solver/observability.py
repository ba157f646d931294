"""What the measurements do not determine, by name, and why where the scene shows it."""

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

UNKNOWN = 1 / 3
"""Standard deviation as a share of the thing itself from which it is not determined."""
NEAR = 0.01
"""A path this short beside the distance of what is seen shows no depth."""
STRAIGHT = 3.0
"""Degrees; a camera that turns less about its mean axis does not turn."""
STILL = 0.1
"""m; a person whose pelvis moves less in all stands still."""
NO_BETTER = 0.7
"""Share of a prior's standard deviation: what measurements lower less, they do not
tell."""


def observability(problem: Problem, state: State, spread: Marginals) -> tuple[str, ...]:
    """What the measurements do not determine, one line each; empty if all is well.

    A direction counts as not determined where its standard deviation is more than a
    third of the thing itself; focal length and size also where they are hardly better
    known than before anything was measured. `state` is a solution and `spread` its
    `marginals`; for the host, not for `jit`.
    """
    scene = _Scene(problem, state)
    parts = (_scale, _focal_length, _halves, _landmarks, _cameras, _people)
    return tuple(line for part in parts for line in part(scene, spread))


class _Scene:
    """What is looked at, in metres."""

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
        """By how much at most from the mean direction, degrees."""
        axis = self.axes.mean(axis=0)
        axis /= max(np.linalg.norm(axis), 1e-12)
        return float(np.rad2deg(np.arccos(np.clip(np.min(self.axes @ axis), -1, 1))))

    def moves(self) -> bool:
        """Far enough to show depths."""
        apart = self.points[self.seen] - self.centres.mean(axis=0)
        distance = np.linalg.norm(apart, axis=1)
        return not len(distance) or bool(self.reach > NEAR * np.median(distance))

    def camera(self) -> str:
        """What the camera does that keeps things from being seen."""
        if not self.moves():
            does = "turns but does not move" if self.turned() > 1 else "stands still"
            return f"the camera {does}"
        along = np.ptp(self.centres @ self.axes.mean(axis=0))
        if self.turned() < STRAIGHT and along < 0.2 * self.reach:
            return "the camera moves parallel to its image and does not turn"
        return "too few points, or the camera hardly moves"

    def has_size(self) -> bool:
        """Whether something ties the map to metres, or to a unit at all."""
        ties = LandmarkPrior, CameraPrior
        return bool(len(self.places)) or any(
            isinstance(x, ties) for x in self.problem.factors
        )

    def is_steady(self) -> bool:
        """Whether something ties cameras to those before."""
        return any(
            isinstance(x, FrameFactor) and not x.of_people and x.num_lags > 1
            for x in self.problem.factors
        )

    def stand_still(self) -> list[int]:
        """The people who do not walk, nor otherwise move their pelvis."""
        far = [
            np.max(np.ptp(place[here], axis=0)) if here.any() else 0.0
            for place, here in zip(self.places, self.present, strict=True)
        ]
        return [person for person, reach in enumerate(far) if reach < STILL]


def _observations(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    """Frame and landmark of each observation that counts."""
    pairs = [
        np.stack([np.asarray(x.frame), np.asarray(x.landmark)])[:, np.isfinite(x.sigma)]
        for x in problem.factors
        if isinstance(x, Reprojection)
    ]
    frame, landmark = np.concatenate([np.zeros((2, 0), int), *pairs], axis=1)
    return frame, landmark


def _deviation(covariance) -> np.ndarray:
    """Root of the trace: of a place, m."""
    variance = np.trace(np.asarray(covariance), axis1=-2, axis2=-1)
    return np.sqrt(np.maximum(variance, 0.0))


def _scale(scene: _Scene, spread: Marginals) -> Iterator[str]:
    if not scene.has("scale"):
        return
    share = float(np.sqrt(max(float(spread.scale), 0.0))) / scene.scale
    if share < UNKNOWN:
        return
    people = len(scene.places)
    still = scene.stand_still()
    if not people:
        why = "nobody is there to tell it"
    elif len(still) == people:
        who = "the person stands" if people == 1 else "all people stand"
        why = f"{who} still"
    elif scene.reach < STILL:
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
    if not deviation < min(UNKNOWN * size, NO_BETTER * before):
        share = deviation / size
        yield f"focal length: known to {share:.0%} only; {scene.camera()}."


def _halves(scene: _Scene, spread: Marginals) -> Iterator[str]:
    """Parts of the video that share no landmark have no common map."""
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
    lost = seen & ~(_deviation(spread.landmarks) < UNKNOWN * depth)
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
    lost = ~(_deviation(spread.cameras) < UNKNOWN * reach)
    if lost[1:].any():
        yield f"centres of {int(lost[1:].sum())} cameras: {scene.camera()}."


def _people(scene: _Scene, spread: Marginals) -> Iterator[str]:
    for person in range(len(scene.places)):
        if scene.has("roots"):
            apart = scene.places[person] - scene.centres
            distance = np.linalg.norm(apart, axis=1)
            lost = ~(_deviation(spread.people[person]) < UNKNOWN * distance)
            lost &= scene.present[person]
            if lost.any():
                yield f"place of person {person} in {int(lost.sum())} frames."
        if scene.has("shapes"):
            # Shape components are in standard deviations of the population.
            deviation = float(np.sqrt(max(float(spread.shapes[person, 0, 0]), 0.0)))
            if not deviation < NO_BETTER:
                yield f"size of person {person}: little better known than anybody's."
