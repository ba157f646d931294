"""Composes `summary.json`: headline, verdict, inputs, figures, settings, versions."""

import dataclasses
import importlib.metadata
from typing import Any

import numpy as np

from bodyslam_jax.config import Config
from bodyslam_jax.diagnostics.accuracy import Accuracy, PersonAccuracy
from bodyslam_jax.diagnostics.person_verdict import PersonVerdict
from bodyslam_jax.diagnostics.place_uncertainty import PlaceUncertainty
from bodyslam_jax.diagnostics.verdict import Verdict
from bodyslam_jax.ground.gravity import Upright
from bodyslam_jax.types import (
    JointEstimate,
    OwnVariable,
    Result,
    ScaleStart,
    Sequence,
    SfmResult,
)


def summarise(
    sequence: Sequence,
    config: Config,
    cameras: SfmResult,
    joint: JointEstimate,
    result: Result,
    verdict: Verdict,
    seconds: dict[str, float],
) -> dict[str, Any]:
    """Returns the content of `summary.json`; `seconds` are the durations of the
    stages."""
    lens = focal_length(sequence, cameras)
    within = cameras.within
    return {
        "status": verdict.status,
        "reasons": [reason.to_dict() for reason in verdict.reasons],
        "headline": _headline(sequence, cameras, result, verdict, lens),
        "warnings": list(verdict.warnings),
        "input": {
            **describe(sequence),
            "fps": sequence.fps,
            "intrinsics_guessed": sequence.intrinsics.is_guess,
        },
        "intrinsics": lens,
        "camera_motion": cameras.kind,
        "camera_path_m": verdict.camera.distance,
        "scale": {
            "value": result.scale,
            "sigma": verdict.scale_sigma,
            "sigma_of_covariance": joint.scale_sigma,
            "start": joint.start.value,
            "start_standard_error": joint.start.standard_error,
            **_cues(joint.start),
            "ground_factor": verdict.ground_factor,
        },
        "up": _up(verdict.up, verdict.accuracy),
        "lengths": _lengths(verdict.accuracy),
        "camera_height": _camera_height(result, verdict.places),
        # What the user gave, and the estimates without it.
        "given": [fact.to_dict() for fact in verdict.given],
        "own": {
            # Terms that `run` was given from Python.
            "variables": {v.name: _own_variable(v) for v in joint.own_variables},
            "factors": {
                f.name: {"residuals": f.residuals, "cost": f.cost, "rms": f.rms}
                for f in joint.own_factors
            },
        },
        "people": [
            _person(person, known) | _place(result, verdict.places, h)
            for h, (person, known) in enumerate(
                zip(verdict.people, verdict.accuracy.people, strict=True)
            )
        ],
        # First and last.
        "frames_used": np.flatnonzero(within)[[0, -1]].tolist(),
        "counts": {
            "landmarks": len(result.landmarks),
            "observations": int(cameras.keep.sum()),
            "people": len(verdict.people),
        },
        # Without bundle adjustment the value is a setting, not a measurement.
        "pixel_sigma": cameras.pixel_sigma if cameras.kind == "moving" else None,
        "per_frame": verdict.per_frame,
        "stages": list(joint.stages),
        "solver": joint.status,
        "durations_s": seconds,
        "settings": dataclasses.asdict(config),
        "versions": versions(),
    }


def describe(sequence: Sequence) -> dict[str, Any]:
    """Returns the properties by which two inputs are recognised as the same."""
    return {
        "name": sequence.name,
        "frames": sequence.num_frames,
        "width": sequence.intrinsics.width,
        "height": sequence.intrinsics.height,
    }


def _own_variable(variable: OwnVariable) -> dict[str, Any]:
    known = lambda x: [v if np.isfinite(v) else None for v in x]
    return {
        "value": list(variable.value),
        "sigma": known(variable.sigma),
        "given": list(variable.given),
        "given_sigma": known(variable.given_sigma),
    }


def focal_length(sequence: Sequence, cameras: SfmResult) -> dict[str, Any]:
    """Returns the focal length that was used, px, and its origin.

    `focal_sigma_px` is `None` unless a guess could be refined.
    """
    guessed = sequence.intrinsics.is_refined
    refined = np.isfinite(cameras.focal_sigma)
    return {
        "guessed": guessed,
        "guess_px": float(sequence.intrinsics.params[0]) if guessed else None,
        "focal_px": cameras.focal,
        "focal_sigma_px": cameras.focal_sigma if refined else None,
    }


def versions() -> dict[str, str]:
    """Returns the versions of the packages that results depend on."""
    names = ("bodyslam-jax", "jax", "optimistix", "numpy", "opencv-python-headless")
    return {name: importlib.metadata.version(name) for name in names}


def _headline(
    sequence: Sequence,
    cameras: SfmResult,
    result: Result,
    verdict: Verdict,
    lens: dict[str, Any],
) -> list[str]:
    """Returns a line each for status, camera, people, and a guessed focal length."""
    way = verdict.camera
    known = _length_error(verdict.scale_sigma / result.scale, cameras)
    lines = [
        f"{sequence.name}: {verdict.status}",
        f"camera: {way.distance:.2f} m{known} in {way.seconds:.1f} s ({cameras.kind})",
    ]
    for h, person in enumerate(verdict.people):
        if person.stature is None or person.stature_sigma is None:
            continue
        sure = verdict.accuracy.people[h]
        lines.append(f"person {h}: {_in_a_line(person, sure)}")
    if lens["guessed"]:
        origin = "guess" if sequence.intrinsics.is_guess else "given"
        text = f"focal length: {origin} {lens['guess_px']:.0f} px"
        if (sigma := lens["focal_sigma_px"]) is not None:
            text += f", from the camera's path {lens['focal_px']:.0f} ± {sigma:.0f} px"
        elif sequence.intrinsics.is_guess:
            text += f" ± {100 * verdict.accuracy.focal:.0f} %"
        lines.append(text)
    return lines


def _in_a_line(person: PersonVerdict, sure: PersonAccuracy) -> str:
    """Returns text on distance, speed, stature and status of a person."""
    if person.status == "not_measurable":
        return (
            f"too small or too far away to be measured ({person.frames} frames, legs "
            f"of {person.leg_px:.0f} px)"
        )
    sigma = person.stature_sigma
    plus_minus = "" if sigma is None or np.isnan(sigma) else f" ± {100 * sigma:.0f}"
    tall = f"{100 * (person.stature or 0.0):.0f}{plus_minus}"
    way = f"{person.path.distance:.2f} m at {person.path.mean_speed:.2f} m/s"
    # The camera's line states the uncertainty that all lengths share.
    if sure.speed > 1.5 * sure.across:
        way += f" ± {100 * sure.speed:.0f} %"
    return f"{way}, {tall} cm tall ({person.status})"


def _length_error(relative: float, cameras: SfmResult) -> str:
    """Returns the relative standard error of a length, as text to append to it."""
    if cameras.kind != "moving" or np.isnan(relative):
        return ""
    if relative >= 1:
        return ", of no known size,"
    return f" ± {max(1, 100 * relative):.0f} %"


def _lengths(found: Accuracy) -> dict[str, float | None]:
    """Returns the relative standard deviations of lengths by what they depend on."""
    known = lambda x: float(x) if np.isfinite(x) else None
    return {
        "across_view_sigma": known(found.across),
        "along_view_sigma": known(found.along),
        "focal_sigma": known(found.focal),
    }


def _up(up: Upright, found: Accuracy) -> dict[str, float | None]:
    """Returns the uncertainty of the vertical, over all kinds of ground and on ground
    that slopes, its angles to trunks and edges, and the slope of the ground."""
    angles = {
        "sigma_degrees": found.up,
        "sigma_if_sloping_degrees": up.sigma_if_sloping,
        "from_trunks_degrees": up.trunks,
        "from_edges_degrees": up.edges,
        "slope_of_ground_degrees": up.ground,
    }
    degrees = lambda x: float(np.degrees(x)) if np.isfinite(x) else None
    found_by_name = {name: degrees(angle) for name, angle in angles.items()}
    known = np.isfinite(up.slope_probability)
    found_by_name["slope_probability"] = up.slope_probability if known else None
    return found_by_name


def _person(person: PersonVerdict, sure: PersonAccuracy) -> dict[str, Any]:
    known = lambda x: None if np.isnan(x) else float(x)
    return {
        "status": person.status,
        "reasons": [reason.message for reason in person.reasons],
        "frames": person.frames,
        "path_m": person.path.distance,
        "speed_m_s": person.path.mean_speed,
        "speed_sigma_m_s": known(sure.speed * person.path.mean_speed),
        "across_view_sigma": known(sure.across),
        "along_view_sigma": known(sure.along),
        "steps_per_s": person.steps_per_s,
        "stature_m": person.stature,
        "stature_sigma_m": person.stature_sigma,
        "speed_noise_m_s": known(person.speed_noise),
        "leg_px": known(person.leg_px),
        "not_measured": person.not_measured,
        "inferred_frames": [list(stretch) for stretch in person.inferred_frames],
        "sitting": [
            {"frames": list(one.frames), "probability": one.probability}
            for one in person.seated
        ],
    }


def _camera_height(
    result: Result, places: PlaceUncertainty | None
) -> dict[str, float | None]:
    """Returns the height of the first camera above the floor, m, with its standard
    deviation; `None` without people."""
    sigma = np.nan if places is None else places.camera_height
    return {
        "value_m": float(result.T_WC[0, 1, 3]) if result.present.any() else None,
        "sigma_m": sigma if np.isfinite(sigma) else None,
    }


def _place(
    result: Result, places: PlaceUncertainty | None, h: int
) -> dict[str, float | None]:
    """Returns the standard deviations of a person's place on the floor and of the
    height of the pelvis above it, m: root mean squares over the frames with the person;
    `None` where they are not known."""
    present = result.present[h]
    level = height = None
    if places is not None and present.any():
        variance = (places.root_sigma[h, present] ** 2).mean(axis=0)
        level, height = (
            float(np.sqrt(variance[[0, 2]].sum())),
            float(variance[1] ** 0.5),
        )
    return {"place_sigma_m": level, "height_sigma_m": height}


def _cues(start: ScaleStart) -> dict[str, list[float] | None]:
    """Returns scale and standard error by each cue alone; `None` for a missing cue."""
    cues = {
        "from_motion": [start.motion, start.motion_error],
        "from_ground": [start.ground, start.ground_error],
        "from_path": [start.path, start.path_error],
    }
    return {k: v if np.isfinite(v[1]) else None for k, v in cues.items()}
