"""Computes the rows of `bodyslam experiment video`: estimates from rendered video.

Every sequence is rendered with people in clothes; medium ones have furniture that
occludes them, difficult ones also a second person and a rolling shutter. Inputs of the
pipeline are the video and camera.json, and: nothing else (`pixels`); simulated
keypoints (`keypoints`); or these and simulated bodies of a regressor (`bodies`).

With `motion="other"` the first person does something else than walk, in each of the ten
sequences something else; a second person walks.

`detection_figures` measures errors of detected keypoints of rendered people, whose
joints are known.
"""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax import body as body_
from bodyslam_jax import evaluation, io, pipeline, simulation
from bodyslam_jax.body import KEYPOINT_NAMES
from bodyslam_jax.body.skeleton import KEYPOINT_JOINT, SURFACE_POINTS
from bodyslam_jax.config import Config, Experiment, Simulation
from bodyslam_jax.experiments.jobs import COMPILATION_S, Job, Row, named
from bodyslam_jax.experiments.scenario import leg_of, simulations
from bodyslam_jax.pipeline.stage_cache import Cache, fingerprint
from bodyslam_jax.simulation import OTHER, RECORDINGS, SimulatedSequence
from bodyslam_jax.simulation.sensor_noise import is_behind
from bodyslam_jax.types import Keypoints, Sequence

INPUTS = ("pixels", "keypoints", "bodies")
FRAMES = 300
FIGURES = (
    *("c_ate_se3", "c_ate_sim3", "h_ate_se3", "h_ate_sim3", "j_ate_se3", "j_ate_sim3"),
    *("scale", "pa_mpjpe", "gravity_error", *evaluation.FIGURES),
    *(f"{name}_of_truth" for name in evaluation.FIGURES),
)
_SECONDS_PER_FRAME = 0.6
"""Processor time of all stages per frame and input, s."""
_READOUT_S = 0.015
_MIN_HEIGHT_PX = 60.0
"""Height in the image from which a person counts as detectable."""
_OUTLIER_ERROR_STATURES = 0.1
"""Error, in statures, from which a keypoint is an outlier."""
_KEYPOINT_NAMES = KEYPOINT_NAMES["body25"]


def jobs(
    experiment: Experiment, config: Config, stages: Path, sequences: tuple[str, ...]
) -> list[Job]:
    """Returns one row for each sequence and input."""
    if experiment.frames is None:
        experiment = dataclasses.replace(experiment, frames=FRAMES)
    if experiment.family is None:
        experiment = dataclasses.replace(experiment, family="both")
    out = []
    for plain in simulations(experiment, sequences, ("room", "follow")):
        settings = filmed(plain)
        for which in INPUTS:
            label = f"{named(settings)}-{which}"
            seconds = COMPILATION_S + _SECONDS_PER_FRAME * (settings.length or FRAMES)
            one = functools.partial(video_row, settings, which, config, stages)
            out.append(Job(label, (settings, which, config), seconds, one))
    return out


def what_is_done(settings: Simulation) -> str:
    """Returns what the first person does, and the CMU trial of it, where they do not
    walk."""
    trial, what = RECORDINGS[settings.sequence]
    return f"{what} ({trial})"


def filmed(settings: Simulation) -> Simulation:
    """Returns the simulation with occluding furniture and further people, by its
    difficulty."""
    level = settings.sequence[0]
    return dataclasses.replace(
        settings,
        render=True,
        hiding=level in "MD",
        people=2 if level == "D" else 1,
        readout=_READOUT_S if level == "D" else 0.0,
    )


def video_row(
    settings: Simulation, which: str, config: Config = Config(), stages: Path = Path()
) -> Row:
    """Renders a video, runs the pipeline on it, and compares the result with the truth.

    `which` is one of `INPUTS`. The film and finished stages are kept in `stages`.

    **Raises:** as `simulation.simulate` and `pipeline.run`.
    """
    body = body_.load_body_model(config.body_model)
    simulated = simulation.simulate(settings, body)
    folder = stages / f"{simulated.name}-{fingerprint(settings)}"
    film = simulation.film_scene(folder / "film", simulated)
    sequence, measured = io.read_sequence(film), simulation.as_sequence(simulated)
    cache = Cache(folder / which)
    row: Row = {"sequence": simulated.name, "input": which}
    if settings.motion == OTHER:
        row["motion"] = what_is_done(settings)
    if which == "pixels":
        sequence = pipeline.find_people(sequence, config, cache)
        row |= detection_figures(simulated, sequence)
    else:
        sequence = dataclasses.replace(sequence, keypoints=measured.keypoints)
    if which == "bodies":
        sequence = dataclasses.replace(sequence, bodies=measured.bodies)
    result = pipeline.run(sequence, config, cache=cache)
    pair = evaluation.associate(result, simulation.as_truth(simulated), body)
    errors = evaluation.evaluate(*pair)
    row |= {name: float(errors[name]) for name in FIGURES}
    row["size"] = float(leg_of(pair[0]) / leg_of(pair[1]))
    row["status"] = result.summary["status"]
    return row


def detection_figures(simulated: SimulatedSequence, found: Sequence) -> dict[str, Any]:
    """Returns the detection rate of the first person, and the errors of each keypoint.

    `found` is the detection rate over the frames in which the person is taller than 60
    px and half of the joints are visible. `keypoints` has for each name: `offset`, the
    mean error in the frame of the joint that the keypoint moves with (x to the left on
    the left side, mirrored on the right, y up and z forward at rest), a constant fitted
    to the errors in the image at the true depth; `spread`, the standard deviation of
    the residuals in the image; both in statures; `seen`, the detection rate of the
    keypoint in the frames in which the person is found and the point is visible;
    `gross`, the share of outliers among these detections.
    """
    exact, depth, R_CJ, inside = _truth(simulated)
    wanted = (np.ptp(exact[:, :15, 1], axis=1) > _MIN_HEIGHT_PX) & (
        inside.mean(axis=1) > 0.5
    )
    if found.keypoints is None or not wanted.any():
        return {"found": 0.0, "keypoints": {}}
    uv, valid, number = _nearest(found.keypoints, exact)
    stature = np.ptp(simulated.person.skin[:, 1])
    error = (uv - exact) / simulated.intrinsics[:2] * depth[:, :, None] / stature
    return {
        "found": float(number[wanted].mean()),
        "keypoints": {
            name: _offset(
                error[:, k], R_CJ[:, k], valid[:, k], inside[:, k], number & wanted,
                mirrored=name.startswith("right"),
            )
            for k, name in enumerate(_KEYPOINT_NAMES)
        },
    }  # fmt: skip


def _truth(simulated: SimulatedSequence):
    """Returns pixels and depths of BODY_25, the orientations of its joints in the
    camera frame, and which points are in the image and not occluded by furniture or
    others."""
    person, walk = simulated.person, simulated.walk
    G, joints = person.joints(walk.poses, walk.pelvis)
    points = person.keypoints(G, joints)
    R_CW = np.swapaxes(simulated.T_WC[:, :3, :3], 1, 2)
    p = np.einsum("tab,tkb->tka", R_CW, points - simulated.T_WC[:, None, :3, 3])
    depth = np.maximum(p[..., 2], 0.05)
    uv = p[..., :2] / depth[..., None] * simulated.intrinsics[:2]
    uv = uv + simulated.intrinsics[2:]
    free = ((uv >= 0) & (uv <= np.array(simulated.size) - 1)).all(axis=2)
    free &= p[..., 2] > 0.1
    for k, T in enumerate(simulated.T_WC):
        free[k] &= ~simulated.room.is_hidden(T[:3, 3], points[k])
    for other in simulated.others:
        off = other.joints - simulated.T_WC[:, None, :3, 3]
        q = np.einsum("tab,tjb->tja", R_CW, off)
        free &= ~is_behind(p, q, simulated.intrinsics)
    leads = [_leader(name) for name in _KEYPOINT_NAMES]
    return uv, depth, R_CW[:, None] @ G[:, leads], free


def _leader(name: str) -> int:
    """Returns the joint that a keypoint moves with."""
    if name not in SURFACE_POINTS:
        return KEYPOINT_JOINT[name]
    if "toe" in name or "heel" in name:
        return KEYPOINT_JOINT[f"{name.split('_')[0]}_ankle"]
    return KEYPOINT_JOINT["head"]


def _nearest(
    found: Keypoints, exact: Float[np.ndarray, "t 25 2"]
) -> tuple[
    Float[np.ndarray, "t 25 2"], Bool[np.ndarray, "t 25"], Bool[np.ndarray, " t"]
]:
    """Returns, for each frame, the detection that belongs to the person, if any: its
    median distance is within a quarter of the person's height."""
    uv, valid = found.uv, found.confidence > 0
    away = np.linalg.norm(uv - exact, axis=-1)
    few = valid.sum(axis=-1) < 5
    middle = np.ma.median(np.ma.masked_array(away, ~valid), axis=-1).filled(np.inf)
    middle = np.where(few, np.inf, middle)
    who, frame = middle.argmin(axis=0), np.arange(uv.shape[1])
    near = middle[who, frame] < 0.25 * np.ptp(exact[..., 1], axis=1)
    return uv[who, frame], valid[who, frame] & near[:, None], near


def _offset(error, R_CJ, given, in_view, counted, *, mirrored: bool) -> dict[str, Any]:
    """Returns the `detection_figures` of one keypoint; `error` is in the image, in
    statures."""
    detected = given & in_view & counted
    good = detected & (np.linalg.norm(error, axis=1) < _OUTLIER_ERROR_STATURES)
    row: dict[str, Any] = {
        "seen": float(detected.sum() / max((counted & in_view).sum(), 1)),
        "gross": float(1 - good.sum() / detected.sum()) if detected.any() else np.nan,
    }
    if good.sum() < 10:
        return {**row, "offset": [np.nan] * 3, "spread": np.nan}
    A, b = R_CJ[good, :2].reshape(-1, 3), error[good].reshape(-1)
    # A constant view does not determine the offset in depth: a ridge keeps it small.
    ridge = 1e-3 * len(A) * np.eye(3)
    offset = np.linalg.solve(A.T @ A + ridge, A.T @ b)
    rest = b - A @ offset
    offset = offset * ([-1, 1, 1] if mirrored else 1)
    return {**row, "offset": offset.tolist(), "spread": float(rest.std())}
