"""Formats the report's figures for experts: people, lengths, focal length.

Its tables are formatted as HTML here.
"""

import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bodyslam_jax import evaluation
from bodyslam_jax.body import BodyModel
from bodyslam_jax.diagnostics import statistics
from bodyslam_jax.diagnostics.reported_status import reported_status
from bodyslam_jax.export.answers import stature_sigma
from bodyslam_jax.types import Result


def people_table(
    result: Result,
    summary: Mapping[str, Any],
    people: Sequence[statistics.PathStatistics],
    body: BodyModel,
) -> str:
    """Returns an HTML table with a column for each person who is present in any
    frame."""
    shown = [h for h, present in enumerate(result.present) if present.any()]
    columns = []
    for h in shown:
        way = people[h]
        near, far = statistics.distance_to_camera(result, h)
        sigma = stature_sigma(summary, h)
        plus_minus = "" if sigma is None else f" ± {100 * sigma:.1f}"
        columns.append(
            {
                "can be trusted": reported_status(summary, h).status or None,
                "visible, s": f"{way.seconds:.1f}",
                "distance from the camera, m": f"{near:.1f} to {far:.1f}",
                "place on the floor, m": _place(summary, h),
                "way, m": f"{way.distance:.2f}",
                "mean speed, m/s": f"{way.mean_speed:.2f}",
                "stature, cm": f"{100 * statistics.stature(body, result.betas[h]):.1f}"
                + plus_minus,
                "lower foot, cm/s": f"{100 * statistics.foot_skating(result, h):.0f}",
                "not measured, % of frames": _not_measured(summary, h),
                "leg in the image, px": _leg(summary, h),
            }
        )
    if not columns:
        return ""
    rows = [[name, *(column[name] for column in columns)] for name in columns[0]]
    note = (
        "<p>Places are as seen from the first camera, with one standard deviation. "
        "Ways are over the ground, smoothed over half a second. The stature is "
        "barefoot, from the estimated shape. The lower foot (its joint, median) of a "
        "real walk moves at about 10 cm/s. What was not measured was hidden, out of "
        "the image or uncertain to the detector: the posture is inferred there.</p>"
    )
    return table(["people", *(f"person {h}" for h in shown)], rows) + note


def _not_measured(summary: Mapping[str, Any], h: int) -> str | None:
    """Returns the limbs with the share of frames in which they were not measured, as
    text."""
    shares = _reported(summary, h).get("not_measured") or {}
    return ", ".join(f"{limb} {100 * x:.0f}" for limb, x in shares.items()) or None


def _place(summary: Mapping[str, Any], h: int) -> str | None:
    """Returns the standard deviation of a person's place on the floor, as text."""
    sigma = _reported(summary, h).get("place_sigma_m")
    return None if sigma is None else f"± {sigma:.2f}"


def _leg(summary: Mapping[str, Any], h: int) -> str | None:
    leg = _reported(summary, h).get("leg_px")
    return None if leg is None else f"{leg:.0f}"


def _reported(summary: Mapping[str, Any], h: int) -> Mapping[str, Any]:
    people = summary.get("people") or []
    return people[h] if h < len(people) else {}


def lengths(result: Result, scale: Mapping[str, Any]) -> str:
    """Returns HTML on the uncertainty of all lengths, and its origin."""
    sigma = scale.get("sigma")
    if sigma is None or not np.isfinite(sigma) or result.scale <= 0:
        return ""
    if not result.present.any():
        return ""
    of_covariance = scale.get("sigma_of_covariance", sigma)
    how = "one standard deviation of all lengths, from the covariance of the estimate"
    if of_covariance < sigma:
        how = (
            "half the difference between the cues below; the covariance of the "
            f"estimate alone gives {100 * of_covariance / result.scale:.1f} %"
        )
    text = f"Lengths are known to {100 * sigma / result.scale:.1f} %: {how}."
    items = "".join(f"<li>{cue}</li>" for cue in _cues(result.scale, scale))
    return f"<p>{text}</p>" + (f"<ul>{items}</ul>" if items else "")


def _cues(value: float, scale: Mapping[str, Any]) -> list[str]:
    """Returns text on the size by each cue alone and by the ground, relative to the
    estimate."""
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


def focal_length(lens: Mapping[str, Any]) -> str:
    """Returns HTML on a focal length that was guessed."""
    if not lens.get("guessed"):
        return ""
    guess, sigma = lens["guess_px"], lens.get("focal_sigma_px")
    if sigma is None:
        text = (
            f"Focal length: {guess:.0f} px, guessed from the image's size; distances "
            "from the camera and motion along the view are wrong in proportion."
        )
    else:
        text = (
            f"Focal length: {lens['focal_px']:.0f} ± {sigma:.0f} px, estimated from "
            f"the camera's path; the guess was {guess:.0f} px."
        )
    return f"<p>{text}</p>"


def error_tables(
    errors: Mapping[str, Mapping[str, Any]], sentences: Sequence[str] = ()
) -> str:
    """Returns the errors against the truth, with one column per evaluated estimate, and
    the sentences below the main ones."""
    if not errors:
        return ""
    first = [row for row in evaluation.ROWS if row[0] in _MAIN_ERRORS]
    others = [row for row in evaluation.ROWS if row[0] not in _MAIN_ERRORS]
    return (
        "<section><h2>Error against the truth</h2>"
        "<p>Means over all frames. SE(3) alignment keeps the estimated size; Sim(3) "
        "corrects it by the truth, which is unknown outside of benchmarks.</p>"
        f"{_error_table(errors, first)}"
        f"{''.join(f'<p>{html.escape(line)}</p>' for line in sentences)}"
        f"{folded('More errors', _error_table(errors, others))}</section>"
    )


_MAIN_ERRORS = ("c_ate_se3", "c_ate_sim3", "h_ate_se3", "j_ate_se3", "scale", "w_mpjpe")
_MAIN_ERRORS += ("wa_mpjpe", "pa_mpjpe", "rte")


def _error_table(
    errors: Mapping[str, Mapping[str, Any]],
    chosen: Sequence[tuple[str, str, str, float]],
) -> str:
    head = "".join(_header(name) for name in errors)
    rows = []
    for key, label, unit, factor in chosen:
        values = [found.get(key) for found in errors.values()]
        if any(isinstance(value, (int, float)) for value in values):
            cells = "".join(f"<td>{_error(v, factor)}</td>" for v in values)
            name = f"{html.escape(label)}{f', {unit}' if unit else ''}"
            rows.append(f'<tr><th scope="row">{name}</th>{cells}</tr>')
    return (
        f'<div class="wide"><table><thead><tr>{_header("error")}{head}</tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table></div>"
    )


def _error(value: Any, factor: float) -> str:
    """Returns a number, or a dash with the reason for which there is none."""
    why = f" <small>{html.escape(value)}</small>" if isinstance(value, str) else ""
    return number(value, factor) + why


def number(value: Any, factor: float = 1.0) -> str:
    """Returns a number times `factor` as text with four digits; a dash if it is not
    finite."""
    if not isinstance(value, (int, float)) or not math.isfinite(value):
        return "–"
    value *= factor
    if value == 0 or 1e-3 <= abs(value) < 1e6:
        return f"{value:.4g}" if abs(value) < 1e4 else f"{value:,.0f}"
    return f"{value:.3g}"


def table(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Returns a table as HTML; the first cell of each row is its header."""
    head = "".join(_header(words(str(column))) for column in columns)
    body = "".join(
        f'<tr><th scope="row">{html.escape(words(str(name)))}</th>'
        f"{''.join(f'<td>{_cell(value)}</td>' for value in values)}</tr>"
        for name, *values in rows
    )
    return (
        f'<div class="wide"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{body}</tbody></table></div>"
    )


def _header(name: str) -> str:
    return f'<th scope="col">{html.escape(name)}</th>'


def _cell(value: Any) -> str:
    if value is None or isinstance(value, (int, float)) and not isinstance(value, bool):
        return number(value)
    return html.escape(words(str(value)))


def words(name: str) -> str:
    """Returns a name with spaces for underscores."""
    return name.replace("_", " ")


def folded(title: str, content: str) -> str:
    """Returns content that is folded below its title, as HTML."""
    return f"<details><summary>{title}</summary>{content}</details>"
