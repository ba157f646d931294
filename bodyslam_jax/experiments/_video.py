"""From pixels alone, beside keypoints and bodies that are simulated: the same images.

Every sequence is rendered with people in clothes. Medium ones have furniture in the
way, difficult ones a second person, too, and a rolling shutter. The pipeline then sees
the video and camera.json, and: nothing else (`pixels`); the simulated keypoints of the
people (`keypoints`); these and bodies as of a regressor (`bodies`).
"""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from bodyslam_jax import body as body_
from bodyslam_jax import evaluation, frontend, pipeline, synthetic
from bodyslam_jax.cache import Cache, fingerprint
from bodyslam_jax.config import Config, Experiment, Simulation
from bodyslam_jax.diagnostics import _posture as posture
from bodyslam_jax.experiments._case import simulations
from bodyslam_jax.experiments._detector import detection_figures
from bodyslam_jax.experiments._jobs import COMPILE, Job, named
from bodyslam_jax.experiments._journal import Row
from bodyslam_jax.result import Result

INPUTS = ("pixels", "keypoints", "bodies")
FRAMES = 300
_ERRORS = (
    *("c_ate_se3", "c_ate_sim3", "h_ate_se3", "h_ate_sim3", "j_ate_se3", "j_ate_sim3"),
    *("scale", "pa_mpjpe"),
)
_PLAUSIBLE = ("foot_speed", "lowest_p5", "lowest_p95", "knee", "straighter_knee")
FORM: dict[str, Any] = {
    "input": str,
    "status": str,
    **dict.fromkeys((*_ERRORS, *_PLAUSIBLE, "gravity_error", "size"), float),
    **{f"true/{name}": float for name in _PLAUSIBLE},
}
"""What a kept row must have, beside its sequence."""
_SECONDS = 0.6
"""Processor time of all stages, a frame and input, s."""
_READOUT = 0.015


def jobs(
    experiment: Experiment, config: Config, stages: Path, sequences: tuple[str, ...]
) -> list[Job]:
    """One row for each sequence and input."""
    if experiment.frames is None:
        experiment = dataclasses.replace(experiment, frames=FRAMES)
    if experiment.family is None:
        experiment = dataclasses.replace(experiment, family="both")
    out = []
    for plain in simulations(experiment, sequences, ("room", "follow")):
        settings = filmed(plain)
        for which in INPUTS:
            label = f"{named(settings)}-{which}"
            form = {"sequence": named(settings), **FORM, "input": which}
            seconds = COMPILE + _SECONDS * (settings.length or FRAMES)
            one = functools.partial(video_row, settings, which, config, stages)
            out.append(Job(label, (settings, which, config), seconds, one, form))
    return out


def filmed(settings: Simulation) -> Simulation:
    """The same with what stands in the way and who else is there."""
    level = settings.sequence[0]
    return dataclasses.replace(
        settings,
        render=True,
        hiding=level in "MD",
        people=2 if level == "D" else 1,
        readout=_READOUT if level == "D" else 0.0,
    )


def video_row(
    settings: Simulation, which: str, config: Config = Config(), stages: Path = Path()
) -> Row:
    """Renders, runs everything on the images, and compares with the truth.

    `which` is of `INPUTS`. The film and finished stages are kept in `stages`.

    **Raises:** as `synthetic.simulate` and `pipeline.run`.
    """
    body = body_.load_body_model(config.body_model)
    simulated = synthetic.simulate(settings, body)
    folder = stages / f"{simulated.name}-{fingerprint(settings)}"
    film = synthetic.film_scene(folder / "film", simulated)
    sequence, measured = frontend.read_sequence(film), synthetic.as_sequence(simulated)
    cache = Cache(folder / which)
    row: Row = {"sequence": simulated.name, "input": which}
    if which == "pixels":
        sequence = pipeline.find_people(sequence, config, cache)
        row |= detection_figures(simulated, sequence)
    else:
        sequence = dataclasses.replace(sequence, keypoints=measured.keypoints)
    if which == "bodies":
        sequence = dataclasses.replace(sequence, bodies=measured.bodies)
    result = pipeline.run(sequence, config, cache=cache)
    truth = synthetic.as_truth(simulated)
    errors = evaluation.evaluate(result, truth, body)
    row |= {name: float(errors[name]) for name in _ERRORS}
    row |= {f"true/{k}": v for k, v in _person_figures(truth, 0, 0).items()}
    h = first_person(result, truth)
    nothing = dict.fromkeys(_PLAUSIBLE, np.nan)
    row |= nothing if h is None else _person_figures(result, h, 0)
    row["size"] = np.nan if h is None else leg_ratio(result, truth, h)
    row["gravity_error"] = gravity_error(result, truth)
    row["status"] = result.summary["status"]
    return row


def first_person(result: Result, truth: Result) -> int | None:
    """Who of the estimated people is the truth's first: by where they are in the image,
    which neither size nor depth changes."""
    direction = lambda r, h: _to_camera(r, r.joints[h, :, 0])
    true, best = direction(truth, 0), (0.1, None)
    for h in range(len(result.joints)):
        both = result.present[h] & truth.present[0]
        if both.any():
            away = np.linalg.norm(direction(result, h) - true, axis=1)[both]
            best = min(best, (float(np.median(away)), h), key=lambda one: one[0])
    return best[1]


def _to_camera(result: Result, points: Float[np.ndarray, "t 3"]):
    """Where points are in the image of a camera of focal length 1."""
    off = points - result.T_WC[:, :3, 3]
    p = np.einsum("tba,tb->ta", result.T_WC[:, :3, :3], off)
    return p[:, :2] / np.where(abs(p[:, 2:]) < 1e-3, 1e-3, p[:, 2:])


def _person_figures(result: Result, h: int, floor: float) -> dict[str, float]:
    """Feet and knees of a person in a world with y up and the floor at `floor`."""
    seen = result.joints[h][result.present[h]]
    fps = 1 / float(np.median(np.diff(result.timestamps)))
    low = seen[:, [*posture.FEET, *posture.ANKLES], 1].min(axis=1) - floor
    knee = posture.knee_flexion(seen)
    return {
        "foot_speed": float(np.median(posture.lower_foot_speed(seen, fps))),
        "lowest_p5": float(np.percentile(low, 5)),
        "lowest_p95": float(np.percentile(low, 95)),
        "knee": float(knee.mean()),
        "straighter_knee": float(knee.min(axis=1).mean()),
    }


def gravity_error(result: Result, truth: Result) -> float:
    """Angle between the result's up and the true one, degrees: worlds are turned onto
    each other by the cameras' orientations."""
    turn = np.einsum("tab,tcb->ac", truth.T_WC[:, :3, :3], result.T_WC[:, :3, :3])
    U, _, Vt = np.linalg.svd(turn)
    R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    return float(np.degrees(np.arccos(np.clip(R[1, 1], -1, 1))))


def leg_ratio(result: Result, truth: Result, h: int) -> float:
    """Length of the legs over the true length."""
    leg = lambda joints: sum(
        np.linalg.norm(joints[:, a] - joints[:, b], axis=1).mean()
        for a, b in ((1, 4), (4, 7), (2, 5), (5, 8))
    )
    return float(leg(result.joints[h][result.present[h]]) / leg(truth.joints[0]))
