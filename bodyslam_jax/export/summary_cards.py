"""The report's first row: distances, speeds, statures, and how well they are known."""

import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bodyslam_jax.body import BodyModel
from bodyslam_jax.diagnostics import statistics
from bodyslam_jax.types import Result


def cards(
    result: Result,
    summary: Mapping[str, Any],
    camera: statistics.PathStatistics,
    people: Sequence[statistics.PathStatistics],
    body: BodyModel,
) -> str:
    """Cards of camera, people and sizes, as one section of HTML."""
    if result.present.any():
        of_camera = (
            f"{camera.distance:.1f} m",
            "camera",
            f"way over the ground, {camera.mean_speed:.2f} m/s on average",
            f"held {camera.height:.2f} m above the floor",
        )
    else:
        of_camera = (
            f"{camera.distance:.2g} units",
            "camera",
            "way in the map's own unit: without people there are no metres",
        )
    found = [_card("Camera", *of_camera)]
    reported = summary.get("people") or []
    for person, way in enumerate(people):
        if not result.present[person].any():
            continue
        near, far = statistics.distance_to_camera(result, person)
        visible = f"visible for {way.seconds:.1f} s, {near:.1f} to {far:.1f} m away"
        found.append(
            _card(
                f"Person {person}",
                f"{way.distance:.1f} m",
                f"person-{person % 4}",
                f"way over the ground, {way.mean_speed:.2f} m/s on average",
                visible,
            )
        )
        tall = statistics.stature(body, result.betas[person])
        sigma = None
        if person < len(reported):
            sigma = reported[person].get("stature_sigma_m")
        plus_minus = "" if sigma is None else f" ± {100 * sigma:.0f}"
        found.append(
            _card(
                f"Stature of person {person}",
                f"{100 * tall:.0f}{plus_minus} cm",
                f"person-{person % 4}",
                "barefoot, from the estimated shape",
                "the lower foot (its joint, median) moves at "
                f"{100 * statistics.foot_skating(result, person):.0f} cm/s "
                "(a real walk: about 10 cm/s)",
            )
        )
    found.append(_sizes(result, summary.get("scale") or {}))
    found += _focal_length(summary.get("intrinsics") or {})
    return f'<section class="cards">{"".join(found)}</section>'


def _sizes(result: Result, scale: Mapping[str, Any]) -> str:
    """How well all lengths are known."""
    sigma = scale.get("sigma")
    if not result.present.any():
        return _card("Sizes", "not in metres", "", "there are no people to measure by")
    if sigma is None or not np.isfinite(sigma) or result.scale <= 0:
        return _card("Sizes", "in metres", "", "their uncertainty was not computed")
    of_covariance = scale.get("sigma_of_covariance", sigma)
    how = "one standard deviation of all lengths, from the covariance of the estimate"
    if of_covariance < sigma:
        how = (
            "half the difference between the cues below; the covariance of the "
            f"estimate alone gives {100 * of_covariance / result.scale:.1f} %"
        )
    known = f"known to {100 * sigma / result.scale:.1f} %"
    return _card("Sizes", known, "", how, *_cues(result.scale, scale))


def _cues(value: float, scale: Mapping[str, Any]) -> list[str]:
    """Size by each cue alone and by the ground, relative to the estimate."""
    found = []
    for cue, name in (
        ("from_motion", "people's motion"),
        ("from_ground", "the ground under people's feet"),
    ):
        if (estimate := scale.get(cue)) is not None:
            ratio, error = (100 * x / value for x in estimate)
            found.append(f"{name} alone: {ratio - 100:+.0f} ± {error:.0f} %")
    if (factor := scale.get("ground_factor")) is not None:
        found.append(f"feet exactly on the ground: {round(100 * (factor - 1)):+d} %")
    return found


def _focal_length(lens: Mapping[str, Any]) -> list[str]:
    """A card for a focal length that was guessed."""
    if not lens.get("guessed"):
        return []
    guess, sigma = lens["guess_px"], lens.get("focal_sigma_px")
    if sigma is None:
        notes = ("guessed from the image's size", "depths are wrong in proportion")
        return [_card("Focal length", f"{guess:.0f} px", "", *notes)]
    value = f"{lens['focal_px']:.0f} ± {sigma:.0f} px"
    notes = ("estimated from the camera's path", f"the guess was {guess:.0f} px")
    return [_card("Focal length", value, "", *notes)]


def _card(title: str, value: str, color: str, *notes: str) -> str:
    dot = f'<i style="background: var(--{color})"></i>' if color else ""
    lines = "".join(f"<p>{html.escape(note)}</p>" for note in notes)
    return (
        f'<div class="card"><h2>{dot}{title}</h2><strong>{value}</strong>{lines}</div>'
    )
