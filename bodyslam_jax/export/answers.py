"""Formats the report's first screen: distance, speed, stature and uncertainty."""

import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bodyslam_jax.body import BodyModel
from bodyslam_jax.diagnostics import statistics
from bodyslam_jax.diagnostics.reported_status import reported_status
from bodyslam_jax.evaluation.before_after import TruthBeside
from bodyslam_jax.export.figures import person_variable
from bodyslam_jax.types import Result

_MAX_ROWS = 5
"""Number of people that a card names at most; the table of people contains all."""
_MIN_SHOWN_SIGMA = 0.1
"""Relative standard deviation of a distance or speed from which it is printed."""
_STATIC_WORDS = {"static": "stood still", "rotation": "turned on the spot"}


def answers(
    result: Result,
    summary: Mapping[str, Any],
    camera: statistics.PathStatistics,
    people: Sequence[statistics.PathStatistics],
    body: BodyModel,
    truth: TruthBeside | None = None,
) -> str:
    """Returns four cards as one section of HTML."""
    shown = [h for h, present in enumerate(result.present) if present.any()]
    name = lambda h: "person" if len(people) == 1 else f"person {h}"
    rows = lambda text: [(person_variable(h), name(h), text(h)) for h in shown]
    kind = _STATIC_WORDS.get(str(summary.get("camera_motion")))
    if shown:
        known = [h for h in shown if reported_status(summary, h).measurable]
        if_known = lambda h, text: text if h in known else "not measurable"
        give = lambda h, x: f"{x:.1f}{_vague(summary, h, x)}"
        far = rows(lambda h: if_known(h, f"{give(h, people[h].distance)} m"))
        fast = rows(lambda h: if_known(h, f"{give(h, people[h].mean_speed)} m/s"))
        walk = [f"{name(h)}: {3.6 * people[h].mean_speed:.1f} km/h" for h in known[:1]]
        tall = rows(lambda h: if_known(h, _stature(result, summary, body, h)))
        moved = kind or f"{camera.distance:.1f} m"
        pace = "–" if kind else f"{camera.mean_speed:.1f} m/s"
    else:
        far, fast, walk, tall = [], [], [], [("", "", "nobody was found")]
        moved, pace = kind or f"{camera.distance:.2g} units", "–"
    span = f"in {result.timestamps[-1] - result.timestamps[0]:.1f} s of video"
    of_camera = lambda value: [("camera", "camera", value)]
    sure, *notes = sizes(result, summary)
    cards = (
        _card("How far?", [*far, *of_camera(moved)], [span]),
        _card("How fast?", [*fast, *([] if kind else of_camera(pace))], walk),
        _card("How tall?", tall, _barefoot(truth) if shown else []),
        _card("How sure?", [("", "", sure)], notes),
    )
    return f'<section class="cards">{"".join(cards)}</section>'


def _barefoot(truth: TruthBeside | None) -> list[str]:
    """Returns the note below the statures, with those of the truth."""
    if truth is None or not truth.statures:
        return ["barefoot"]
    true = ", ".join(f"{100 * tall:.0f} cm" for tall, _ in truth.statures.values())
    return [f"barefoot; in truth {true}"]


def _stature(
    result: Result, summary: Mapping[str, Any], body: BodyModel, h: int
) -> str:
    tall = statistics.stature(body, result.betas[h])
    sigma = stature_sigma(summary, h)
    plus_minus = "" if sigma is None else f" ± {100 * sigma:.0f}"
    return f"{100 * tall:.0f}{plus_minus} cm"


def stature_sigma(summary: Mapping[str, Any], h: int) -> float | None:
    """Returns the reported standard deviation of a person's stature, m."""
    reported = (summary.get("people") or [])[h : h + 1]
    return reported[0].get("stature_sigma_m") if reported else None


def _vague(summary: Mapping[str, Any], h: int, value: float) -> str:
    """Returns the standard deviation of a person's distance or speed as text, if it is
    large."""
    person = (_people(summary)[h : h + 1] or [{}])[0]
    sigma, speed = person.get("speed_sigma_m_s"), person.get("speed_m_s")
    share = sigma / speed if sigma and speed else 0.0
    return f" ± {share * value:.1f}" if share > _MIN_SHOWN_SIGMA else ""


def sizes(result: Result, summary: Mapping[str, Any]) -> list[str]:
    """Returns a short text on the uncertainty of lengths, followed by notes."""
    if not result.present.any():
        return ["not in metres", "there are no people to measure by"]
    scale = summary.get("scale") or {}
    sigma = scale.get("sigma")
    if str(summary.get("camera_motion")) in _STATIC_WORDS:
        return _sizes_of_stature(result, summary)
    reasons = summary.get("reasons") or []
    if any(reason.get("name") == "scale_unknown" for reason in reasons):
        return ["sizes are not known", "nothing in the video tells how large it is"]
    if sigma is None or not np.isfinite(sigma) or result.scale <= 0:
        return ["in metres", "how well they are known was not computed"]
    share = sigma / result.scale
    if share >= 1:
        return ["sizes are not known", "distances and statures may be off many times"]
    notes = [_one_metre(share)]
    far = along_view(summary)
    if far is not None and far > 1.5 * share:
        return [f"sizes are known to {_percent(share)}", _from_focal(far), *notes[1:]]
    if scale.get("sigma_of_covariance", sigma) < sigma:
        notes.append("people's steps and the ground tell different sizes")
    return [f"sizes are known to {_percent(share)}", *notes]


def _sizes_of_stature(result: Result, summary: Mapping[str, Any]) -> list[str]:
    """Returns the texts of `sizes` for a camera whose path does not determine the
    scale: all sizes then follow from the bodies, and distances also from the focal
    length."""
    known = [stature_sigma(summary, h) for h in range(len(result.present))]
    statures = [(s, p.get("stature_m")) for s, p in zip(known, _people(summary))]
    shares = [s / m for s, m in statures if s and m]
    note = "all of them come from how tall people look"
    if not shares:
        return ["in metres", note]
    far = along_view(summary)
    if far is None or far < 1.5 * min(shares):
        return [f"sizes are known to {_percent(min(shares))}", note]
    return [
        f"sizes across the view are known to {_percent(min(shares))}",
        _from_focal(far),
        note,
    ]


def along_view(summary: Mapping[str, Any]) -> float | None:
    """Returns the reported relative standard deviation of distances from the camera."""
    far = (summary.get("lengths") or {}).get("along_view_sigma")
    return None if far is None or not np.isfinite(far) else float(far)


def _from_focal(far: float) -> str:
    return (
        "distances from the camera and motion along the view are known to "
        f"{_percent(far)}, by the focal length: give it (--focal)"
    )


def _people(summary: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    return summary.get("people") or []


def _percent(share: float) -> str:
    return f"{max(1, round(100 * share))} %"


def _one_metre(share: float) -> str:
    low, high = 1 - share, 1 + share
    return f"a metre in here is {low:.2f} to {high:.2f} m, in two of three results"


def _card(
    title: str, rows: Sequence[tuple[str, str, str]], notes: Sequence[str]
) -> str:
    """Returns a card; rows are colour, name and value, and an empty name is not
    shown."""
    lines = []
    for color, name, value in rows[:_MAX_ROWS]:
        dot = f'<i style="background: var(--{color})"></i>' if color else ""
        label = f"<span>{dot}{html.escape(name)}</span> " if name else ""
        lines.append(f"<li>{label}<strong>{html.escape(value)}</strong></li>")
    if len(rows) > _MAX_ROWS:
        lines.append(f"<li><span>and {len(rows) - _MAX_ROWS} more, below</span></li>")
    notes_ = "".join(f"<p>{html.escape(note)}</p>" for note in notes)
    return f'<div class="card"><h2>{title}</h2><ul>{"".join(lines)}</ul>{notes_}</div>'
