"""The report's first row: how far, how fast, how tall, how sure."""

import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bodyslam_jax.body import BodyModel
from bodyslam_jax.export import statistics as facts
from bodyslam_jax.types import Result


def cards(
    result: Result,
    summary: Mapping[str, Any],
    camera: facts.PathFacts,
    people: Sequence[facts.PathFacts],
    body: BodyModel,
) -> str:
    """The summary that a person understands: how far, how fast, how tall, how sure."""
    if result.present.any():
        known_of_camera = (
            f"{camera.distance:.1f} m",
            "camera",
            f"way over the ground, {camera.mean_speed:.2f} m/s on average",
            f"held {camera.height:.2f} m above the floor",
        )
    else:
        own = f"{camera.distance:.2g} units"
        known_of_camera = (
            own,
            "camera",
            "way in the map's own unit: people alone tell metres",
        )
    found = [_card("Camera", *known_of_camera)]
    known = summary.get("people") or []
    for person, way in enumerate(people):
        if not result.present[person].any():
            continue
        near, far = facts.distance_to_camera(result, person)
        here = f"there for {way.seconds:.1f} s, {near:.1f} to {far:.1f} m away"
        found.append(
            _card(
                f"Person {person}",
                f"{way.distance:.1f} m",
                f"person-{person % 4}",
                f"way over the ground, {way.mean_speed:.2f} m/s on average",
                here,
            )
        )
        tall = facts.stature(body, result.betas[person])
        sigma = known[person].get("stature_sigma_m") if person < len(known) else None
        plus_minus = "" if sigma is None else f" ± {100 * sigma:.0f}"
        found.append(
            _card(
                f"Stature of person {person}",
                f"{100 * tall:.0f}{plus_minus} cm",
                f"person-{person % 4}",
                "barefoot, from the estimated shape",
                "the lower foot (its joint, median) moves at "
                f"{100 * facts.foot_skating(result, person):.0f} cm/s "
                "(a real walk: about 10 cm/s)",
            )
        )
    scale = summary.get("scale") or {}
    sigma = scale.get("sigma") if isinstance(scale, dict) else None
    if not result.present.any():
        told = "nothing tells it: there are no people"
    else:
        told = "its uncertainty was not computed"
    if sigma is not None and np.isfinite(sigma) and result.scale > 0:
        percent = 100 * sigma / result.scale
        own = scale.get("sigma_of_covariance", sigma)
        how = "one standard deviation of the scale, as the estimate itself sees it"
        if own < sigma:
            how = (
                "half of what the two below are apart; the estimate itself has "
                f"{100 * own / result.scale:.1f} %"
            )
        found.append(
            _card(
                "How sure are the metres?",
                f"± {percent:.1f} %",
                "",
                how,
                f"scale {result.scale:.4g} m per unit of the unscaled map",
                *_cues(scale),
            )
        )
    else:
        found.append(
            _card(
                "Scale",
                f"{result.scale:.4g}",
                "",
                "metres per unit of the unscaled map",
                told,
            )
        )
    found += _focal_length(summary.get("intrinsics") or {})
    return f'<section class="cards">{"".join(found)}</section>'


def _cues(scale: Mapping[str, Any]) -> list[str]:
    """What motion and ground say by themselves, and where the feet are at the end."""
    found = []
    for cue, name in (
        ("from_motion", "people's motion"),
        ("from_ground", "the ground under people's feet"),
    ):
        if (told := scale.get(cue)) is not None:
            found.append(f"from {name} alone: {told[0]:.4g} ± {told[1]:.2g}")
    if (factor := scale.get("ground_factor")) is not None:
        found.append(f"feet exactly on the ground: {round(100 * (factor - 1)):+d} %")
    return found


def _focal_length(lens: Mapping[str, Any]) -> list[str]:
    """A card only where the focal length was not given."""
    if not lens.get("guessed"):
        return []
    guess, sigma = lens["guess_px"], lens.get("focal_sigma_px")
    if sigma is None:
        notes = ("guessed from the image's size", "depths are as wrong as it is")
        return [_card("Focal length", f"{guess:.0f} px", "", *notes)]
    value = f"{lens['focal_px']:.0f} ± {sigma:.0f} px"
    notes = ("found from the camera's path", f"the guess was {guess:.0f} px")
    return [_card("Focal length", value, "", *notes)]


def _card(title: str, value: str, color: str, *notes: str) -> str:
    dot = f'<i style="background: var(--{color})"></i>' if color else ""
    lines = "".join(f"<p>{html.escape(note)}</p>" for note in notes)
    return (
        f'<div class="card"><h2>{dot}{title}</h2><strong>{value}</strong>{lines}</div>'
    )
