"""The whole flow: video -> tracks -> cameras -> people -> graph -> result."""

import contextlib
import dataclasses
import importlib.metadata
import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import body as body_
from bodyslam_jax import export, frontend, graph, initialisation, motion, people, solver
from bodyslam_jax.cache import Cache, fingerprint
from bodyslam_jax.config import Config
from bodyslam_jax.result import Result
from bodyslam_jax.sequence import Bodies, Sequence, Tracks

log = logging.getLogger(__name__)
FEET = (10, 11)
"""SMPL's foot joints."""


@dataclasses.dataclass(frozen=True)
class Cameras:
    """The up-to-scale reconstruction after bundle adjustment."""

    kind: str
    """`moving`, `rotation` (no parallax) or `static`."""
    T_WC: Float[np.ndarray, "t 4 4"]
    registered: Bool[np.ndarray, " t"]
    """Frames that were located; the poses of others are filled in."""
    landmarks: Float[np.ndarray, "l 3"]
    tracks: Tracks
    """Observations of `landmarks`."""
    keep: Bool[np.ndarray, " m"]
    """Observations that fit."""
    pixel_sigma: float
    """Robust standard deviation of those, px."""
    intrinsics: Float[np.ndarray, " i"]
    costs: tuple[float, float]
    """Before and after bundle adjustment."""
    warnings: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class Joint:
    """The graph's optimum."""

    scale: float
    scale_start: float
    scale_start_error: float
    scale_sigma: float
    cameras: Float[np.ndarray, "t 4 4"]
    roots: Float[np.ndarray, "h t 4 4"]
    poses: Float[np.ndarray, "h t 23 3"]
    shapes: Float[np.ndarray, "h 10"]
    landmarks: Float[np.ndarray, "l 3"]
    intrinsics: Float[np.ndarray, " i"]
    present: Bool[np.ndarray, "h t"]
    status: str
    stages: tuple[dict, ...]


class Stopwatch:
    """Seconds by stage, and a log line at the end of each."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextlib.contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        log.info("%s ...", stage)
        start = time.perf_counter()
        yield
        self.seconds[stage] = round(time.perf_counter() - start, 2)
        log.info("%s: %.1f s", stage, self.seconds[stage])


def run(
    sequence: Sequence, config: Config = Config(), *, cache: Cache = Cache(None)
) -> Result:
    """Estimates cameras, people and map in metres; `cache` keeps finished stages.

    **Raises:** `ValueError` if there is nothing to be estimated from, in one line.
    """
    watch = Stopwatch()
    body = body_.load_body_model(config.body_model)
    key = fingerprint(sequence, config.tracking)
    with watch("tracks"):
        tracks = cache.stage("tracks", key, Tracks, lambda: _tracks(sequence, config))
    key = fingerprint(key, config.structure, config.weights.landmark_loss)
    with watch("cameras"):
        cameras = cache.stage(
            "cameras", key, Cameras, lambda: _cameras(sequence, tracks, config)
        )
    key = fingerprint(sequence, config.people_fit, config.people, config.body_model)
    with watch("people"):
        bodies = cache.stage(
            "people", key, Bodies, lambda: _people(sequence, body, config)
        )
    key = fingerprint(sequence, config)
    with watch("joint"):
        joint = cache.stage(
            "joint", key, Joint, lambda: _joint(sequence, cameras, bodies, body, config)
        )
    return _result(sequence, config, body, cameras, joint, watch.seconds)


def _tracks(sequence: Sequence, config: Config) -> Tracks:
    if sequence.tracks is not None:
        return sequence.tracks
    return frontend.track(sequence, config.tracking)


def _cameras(sequence: Sequence, tracks: Tracks, config: Config) -> Cameras:
    """Structure from motion, then bundle adjustment of all frames and landmarks."""
    intrinsics = np.asarray(sequence.intrinsics.params, float)
    found = frontend.reconstruct(
        tracks, sequence.intrinsics, sequence.num_frames, config.structure
    )
    tracks = found.tracks
    keep = np.ones(len(tracks.frame), bool)
    cameras = Cameras(
        kind=found.kind,
        T_WC=found.T_WC,
        registered=found.registered,
        landmarks=found.landmarks,
        tracks=tracks,
        keep=keep,
        pixel_sigma=config.weights.pixel_sigma,
        intrinsics=intrinsics,
        costs=(0.0, 0.0),
        warnings=tuple(found.warnings),
    )
    if found.kind != "moving":
        return cameras
    nobody = initialisation.no_people(sequence.num_frames)
    state = initialisation.first_state(found.T_WC, found.landmarks, nobody, intrinsics)
    factor = initialisation.map_factor(tracks, keep, 1.0, config.weights)
    problem = graph.make_problem([factor], state)
    before = float(problem.cost(state))
    solution = solver.solve(problem, state)
    state = solution.state
    error = np.linalg.norm(np.asarray(factor.residual(state)), axis=-1)
    low, high = initialisation.PIXEL_SIGMA_RANGE
    # The median of a two-dimensional normal error's length is 1.18 sigma.
    sigma = (
        float(np.clip(np.median(error[keep]) / 1.18, low, high)) if keep.any() else 1.0
    )
    return dataclasses.replace(
        cameras,
        T_WC=np.asarray(state.cameras),
        landmarks=np.asarray(state.landmarks),
        keep=keep & (error < 10 * sigma),
        pixel_sigma=sigma,
        costs=(before, float(solution.cost)),
    )


def _people(sequence: Sequence, body: body_.BodyModel, config: Config) -> Bodies:
    """Bodies in the camera frame: a regressor's, cleaned, or fitted to keypoints."""
    t = sequence.num_frames
    if not config.people or (sequence.bodies is None and sequence.keypoints is None):
        return Bodies(
            np.zeros((0, t), bool),
            np.zeros((0, t, 72)),
            np.zeros((0, t, 10)),
            np.zeros((0, t, 3)),
        )
    if sequence.bodies is not None:
        return people.prepare_bodies(
            sequence.bodies,
            sequence.keypoints,
            sequence.intrinsics,
            body,
            sequence.fps,
            config.people_fit,
        )
    assert sequence.keypoints is not None
    return people.fit_bodies(
        sequence.keypoints, sequence.intrinsics, body, sequence.fps, config.people_fit
    )


def _joint(
    sequence: Sequence,
    cameras: Cameras,
    bodies: Bodies,
    body: body_.BodyModel,
    config: Config,
) -> Joint:
    """The paper's graph: two steps, then the optimum of everything."""
    roots = people.roots_from_bodies(bodies, body)
    state = initialisation.first_state(
        cameras.T_WC, cameras.landmarks, roots, cameras.intrinsics
    )
    model = motion.load_motion_model(config.motion_model)
    predictor = graph.MotionPredictor(
        motion.predict_between,
        (model, motion.make_clock(sequence.timestamps, model.fps)),
        body,
        jnp.asarray(roots.present),
    )
    moving = cameras.kind == "moving"
    start = initialisation.ScaleStart(1.0, float("inf"))
    stages = []
    factors = []
    if moving:
        factors.append(
            initialisation.map_factor(
                cameras.tracks, cameras.keep, cameras.pixel_sigma, config.weights
            )
        )
    if len(roots.present):
        seen = initialisation.people_factors(sequence, roots, config.weights, body)
        alone = [f for f in seen if not isinstance(f, graph.RootSmoothness)]
        problem = graph.make_problem(
            alone, state, free=initialisation.free_people(state)
        )
        state = _solve(problem, state, config, "people", stages).state
        factors += seen
        if moving:
            start = initialisation.scale_start(state, predictor)
            log.info("scale: %.4g ± %.2g", start.value, start.standard_error)
            state = eqx.tree_at(lambda s: s.scale, state, jnp.asarray(start.value))
        factors.append(initialisation.motion_factor(predictor(state), config.weights))
    if not factors:
        raise ValueError(f"{sequence.name}: no landmarks and no people to estimate.")
    problem = graph.make_problem(
        factors,
        state,
        motion=predictor if len(roots.present) else None,
        free=None if moving else initialisation.free_people(state),
    )
    solution = _solve(problem, state, config, "joint", stages)
    best = solution.state
    return Joint(
        scale=float(best.scale),
        scale_start=start.value,
        scale_start_error=start.standard_error,
        scale_sigma=float("nan"),
        cameras=np.asarray(best.cameras),
        roots=np.asarray(best.roots),
        poses=np.asarray(best.poses),
        shapes=np.asarray(best.shapes),
        landmarks=np.asarray(best.landmarks),
        intrinsics=np.asarray(best.intrinsics),
        present=roots.present,
        status=solution.status,
        stages=tuple(stages),
    )


def _solve(
    problem: graph.Problem,
    state: graph.State,
    config: Config,
    name: str,
    stages: list[dict],
) -> solver.Solution:
    """`solver.solve` with a line for the log and one for the report."""
    start = time.perf_counter()
    before = float(problem.cost(state))
    schedule = solver.PAPER_SCHEDULE if name == "joint" else (solver.Stage(),)
    solution = solver.solve(problem, state, solver=config.solver, schedule=schedule)
    stages.append(
        {
            "name": name,
            "cost_before": before,
            "cost_after": float(solution.cost),
            "iterations": int(sum(int(n) for n in solution.num_steps)),
            "seconds": round(time.perf_counter() - start, 2),
            "status": solution.status,
        }
    )
    log.info(
        "%s: cost %.4g -> %.4g in %d steps, %s",
        *list(stages[-1].values())[:4],
        solution.status,
    )
    return solution


def _result(
    sequence: Sequence,
    config: Config,
    body: body_.BodyModel,
    cameras: Cameras,
    joint: Joint,
    seconds: dict[str, float],
) -> Result:
    """The optimum in a metric world whose y axis is the people's up."""
    T_WC = joint.cameras.copy()
    T_WC[:, :3, 3] *= joint.scale
    turn = upright(T_WC, T_WC @ joint.roots, joint.present)
    T_WC = turn @ T_WC
    T_WH = T_WC @ joint.roots
    landmarks = joint.scale * joint.landmarks @ turn[:3, :3].T + turn[:3, 3]
    root = np.asarray(jaxlie.SO3.from_matrix(jnp.asarray(T_WH[..., :3, :3])).log())
    poses = np.concatenate([root, joint.poses.reshape(*root.shape[:2], 69)], axis=-1)
    rest = np.asarray(body_.rest_joints(body, jnp.asarray(joint.shapes)))
    trans = T_WH[..., :3, 3] - rest[:, None, 0]
    shapes = jnp.asarray(joint.shapes)[:, None]
    joints = np.array(
        body_.joints(body, jnp.asarray(poses), shapes, jnp.asarray(trans))
    )
    if joint.present.any():
        # The floor is where feet are lowest, but for a few frames.
        floor = np.quantile(joints[joint.present][:, FEET, 1].min(axis=1), 0.05)
        for points in (T_WC[:, :3, 3], trans, joints, landmarks):
            points[..., 1] -= floor
    result = Result(
        timestamps=sequence.timestamps,
        T_WC=T_WC,
        scale=joint.scale,
        intrinsics=joint.intrinsics,
        landmarks=landmarks if cameras.kind == "moving" else np.zeros((0, 3)),
        poses=poses,
        trans=trans,
        betas=joint.shapes,
        joints=np.asarray(joints),
        present=joint.present,
    )
    summary = summarise(sequence, config, body, cameras, joint, result, seconds)
    return dataclasses.replace(result, summary=summary)


def upright(
    T_WC: Float[np.ndarray, "t 4 4"],
    T_WH: Float[np.ndarray, "h t 4 4"],
    present: Bool[np.ndarray, "h t"],
) -> Float[np.ndarray, "4 4"]:
    """The rigid motion to a world with y up, z ahead of the first camera, which is its
    origin.

    Nothing measures gravity: up is where people's trunks point on average, or, without
    people, where the first camera's top does.
    """
    up = T_WH[present][:, :3, 1].sum(axis=0) if present.any() else -T_WC[0, :3, 1]
    y = up / np.linalg.norm(up)
    ahead = T_WC[0, :3, 2] - y * (y @ T_WC[0, :3, 2])
    if np.linalg.norm(ahead) < 1e-3:  # The camera looks straight up or down.
        ahead = T_WC[0, :3, 1] - y * (y @ T_WC[0, :3, 1])
    z = ahead / np.linalg.norm(ahead)
    turn = np.eye(4)
    turn[:3, :3] = np.stack([np.cross(y, z), y, z])
    turn[:3, 3] = -turn[:3, :3] @ T_WC[0, :3, 3]
    return turn


def summarise(
    sequence: Sequence,
    config: Config,
    body: body_.BodyModel,
    cameras: Cameras,
    joint: Joint,
    result: Result,
    seconds: dict[str, float],
) -> dict[str, Any]:
    """`summary.json`: what a person wants to know first, then everything else."""
    warnings = [*sequence.warnings, *cameras.warnings]
    status = "ok"
    if not joint.present.any():
        status = "no people: cameras and map have no unit"
    elif not np.isfinite(result.T_WC).all():
        status = "failed"
    if cameras.kind != "moving":
        warnings.append(
            "metric size comes from the body alone: the camera's path gives none."
        )
    path = lambda x: float(np.linalg.norm(np.diff(x, axis=0), axis=-1).sum())
    persons = []
    for h in range(len(result.poses)):
        there = result.present[h]
        pelvis = result.joints[h, there, 0]
        duration = max(there.sum() - 1, 1) / sequence.fps
        persons.append(
            {
                "frames": int(there.sum()),
                "path_m": path(pelvis),
                "speed_m_s": path(pelvis) / duration,
                "stature_m": stature(body, result.betas[h]),
            }
        )
    headline = [
        f"{sequence.name}: {status}",
        f"camera: {path(result.T_WC[:, :3, 3]):.2f} m in "
        f"{result.timestamps[-1] - result.timestamps[0]:.1f} s ({cameras.kind})",
    ]
    headline += [
        f"person {h}: {p['path_m']:.2f} m, {p['speed_m_s']:.2f} m/s, "
        f"{100 * p['stature_m']:.0f} cm tall"
        for h, p in enumerate(persons)
    ]
    return {
        "status": status,
        "headline": headline,
        "warnings": warnings,
        "input": {
            "name": sequence.name,
            "frames": sequence.num_frames,
            "fps": sequence.fps,
            "width": sequence.intrinsics.width,
            "height": sequence.intrinsics.height,
            "intrinsics_guessed": sequence.intrinsics.is_guess,
        },
        "camera_motion": cameras.kind,
        "scale": {
            "value": result.scale,
            "sigma": joint.scale_sigma,
            "start": joint.scale_start,
            "start_standard_error": joint.scale_start_error,
        },
        "people": persons,
        "counts": {
            "landmarks": len(result.landmarks),
            "observations": int(cameras.keep.sum()),
            "people": len(persons),
        },
        "pixel_sigma": cameras.pixel_sigma,
        "stages": list(joint.stages),
        "solver": joint.status,
        "durations_s": seconds,
        "settings": dataclasses.asdict(config),
        "versions": versions(),
    }


def stature(body: body_.BodyModel, shape: Float[np.ndarray, " 10"]) -> float:
    """Height of the mesh in its rest pose, m."""
    rest = jnp.zeros(72)
    vertices = body_.vertices(body, rest, jnp.asarray(shape), jnp.zeros(3))
    return float(vertices[:, 1].max() - vertices[:, 1].min())


def versions() -> dict[str, str]:
    """What ran: a result can be repeated only with the same."""
    names = ("bodyslam-jax", "jax", "optimistix", "numpy", "opencv-python-headless")
    return {name: importlib.metadata.version(name) for name in names}


def run_to_folder(sequence: Sequence, out: Path, config: Config = Config()) -> Result:
    """`run`, with finished stages kept in `out` and everything of the contract written.

    **Raises:** `ValueError` if `out` cannot be written.
    """
    export.check_folder(out)
    result = run(sequence, config, cache=Cache(out / ".cache"))
    export.write_run(out, result, config)
    return result
