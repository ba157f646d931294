"""The report: one HTML file that opens offline."""

import html
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bodyslam_jax.body import BodyModel
from bodyslam_jax.diagnostics.statistics import (
    PathStatistics,
    camera_statistics,
    person_statistics,
)
from bodyslam_jax.export import figures
from bodyslam_jax.export.folder import plain
from bodyslam_jax.export.summary_cards import cards
from bodyslam_jax.export.tables import errors_section, folded, table
from bodyslam_jax.types import Result


def write_report(path: Path, result: Result, body: BodyModel) -> None:
    """Writes the report of a result: no other file, no network, light or dark.

    Distances and speeds are computed from the result, all else comes from
    `result.summary` (keys as written by `summary.summarise`); parts that it lacks are
    left out. The optional key `errors` maps a name of what was evaluated ("cameras
    alone, arbitrary scale", "joint estimate, in metres") to its errors by the names of
    `evaluation`; a text in place of a number tells why there is no number.
    """
    summary = plain(result.summary)
    camera = camera_statistics(result)
    people = [person_statistics(result, h) for h in range(len(result.poses))]
    source = summary.get("input") or {}
    name = source.get("name") if isinstance(source, dict) else str(source)
    sections = [
        _reasons(summary.get("reasons") or []),
        cards(result, summary, camera, people, body),
        _warnings(summary.get("warnings") or []),
        errors_section(summary.get("errors") or {}),
        _trajectories(result),
        _motion(result, camera, people),
        _stages(summary),
        _per_frame(result, summary.get("per_frame") or {}),
        _details(result, summary),
    ]
    style = resources.files("bodyslam_jax.export").joinpath("report.css").read_text()
    path.write_text(
        _PAGE.format(
            title=html.escape(str(name or "run")),
            style=style,
            status=_status(str(summary.get("status", "ok"))),
            subtitle=html.escape(_subtitle(result, source)),
            body="\n".join(section for section in sections if section),
        ),
        encoding="utf-8",
    )


_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{title} – BodySLAM report</title>
<style>
{style}
</style>
</head>
<body>
<header>
<div class="title"><h1>{title}</h1>{status}</div>
<p>{subtitle}</p>
</header>
<main>
{body}
</main>
</body>
</html>
"""


def _status(status: str) -> str:
    good = status == "ok"
    text = "ok" if good else html.escape(status)
    return f'<span class="badge {"good" if good else "bad"}">{text}</span>'


def _subtitle(result: Result, source: Any) -> str:
    t = result.timestamps
    words = [f"{len(t)} frames in {t[-1] - t[0]:.1f} s"]
    if isinstance(source, dict) and source.get("width"):
        words.append(f"{source['width']} × {source['height']} px")
    people = len(result.poses)
    words.append("one person" if people == 1 else f"{people or 'no'} people")
    words.append(f"{len(result.landmarks):,} landmarks")
    return " · ".join(words)


def _warnings(warnings: Sequence[str]) -> str:
    if not warnings:
        return ""
    items = "".join(f"<li>{html.escape(str(w))}</li>" for w in warnings)
    return f'<section class="warnings"><h2>Warnings</h2><ul>{items}</ul></section>'


def _reasons(reasons: Sequence[dict[str, Any]]) -> str:
    """Why the result is doubtful or failed, and what to do about it."""
    if not reasons:
        return ""
    items = "".join(
        f"<li>{html.escape(str(r.get('message')))} "
        f"<em>{html.escape(str(r.get('advice', '')))}.</em></li>"
        for r in reasons
    )
    title = "Why this result is in doubt"
    return f'<section class="warnings"><h2>{title}</h2><ul>{items}</ul></section>'


def _figure(svg: str, caption: str, kind: str = "full") -> str:
    text, drawn = html.escape(caption), figures.labelled(svg, caption)
    return f'<figure class="{kind}">{drawn}<figcaption>{text}</figcaption></figure>'


def _trajectories(result: Result) -> str:
    above, side = figures.trajectories(result)
    from_side = "From the side. The floor is at the height of standing feet."
    return (
        '<section><h2>Paths</h2><div class="two">'
        + _figure(above, "From above. Arrows: where the camera looks.", "half")
        + _figure(side, from_side, "half")
        + "</div></section>"
    )


def _motion(
    result: Result,
    camera: PathStatistics,
    people: Sequence[PathStatistics],
) -> str:
    if len(result.timestamps) < 2:
        return ""
    svg = figures.speeds(result, camera, people)
    caption = "Speed over the ground, paths smoothed over half a second."
    return f"<section><h2>Speed</h2>{_figure(svg, caption)}</section>"


def _stages(summary: Mapping[str, Any]) -> str:
    stages = summary.get("stages") or []
    durations = summary.get("durations_s") or {}
    if not stages and not durations:
        return ""
    drawn = [
        stage
        for stage in stages
        if min(stage.get("cost_before") or 0, stage.get("cost_after") or 0) > 0
    ]
    parts = ["<section><h2>Stages of the estimate</h2>"]
    if drawn:
        parts.append(_figure(figures.costs(drawn), "Cost of each stage."))
    parts.append('<div class="two">')
    if stages:
        columns = list(dict.fromkeys(key for stage in stages for key in stage))
        parts.append(table(columns, [[s.get(c) for c in columns] for s in stages]))
    if durations:
        total = ("total", sum(durations.values()))
        parts.append(table(["step", "seconds"], [*durations.items(), total]))
    return "".join(parts) + "</div></section>"


_CURVES = (
    (
        "Reprojection error",
        "error, px",
        {"reprojection_px": "landmarks", "keypoint_px": "keypoints"},
        "Mean reprojection error of each frame.",
    ),
    (
        "Landmarks per frame",
        "number per frame",
        {"tracks": "tracked points", "inliers": "inliers"},
        "Observations of landmarks in each frame.",
    ),
)


def _per_frame(result: Result, per_frame: Mapping[str, Sequence[Any]]) -> str:
    sections = []
    for title, ylabel, names, caption in _CURVES:
        colors = (figures.CAMERA, figures.person_color(0))
        curves = {
            label: (np.array(per_frame[key], float), color)
            for (key, label), color in zip(names.items(), colors, strict=True)
            if len(per_frame.get(key) or []) == len(result.timestamps)
        }
        if curves:
            svg = figures.over_time(result.timestamps, curves, ylabel, figures.HALF)
            sections.append(
                f"<section><h2>{title}</h2>{_figure(svg, caption, 'half')}</section>"
            )
    return '<div class="two">' + "".join(sections) + "</div>" if sections else ""


def _details(result: Result, summary: Mapping[str, Any]) -> str:
    """Scale, intrinsics, counts, versions and settings, folded away."""
    labels = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    lens = [
        (label, round(float(value), 5))
        for label, value in zip(labels, result.intrinsics, strict=False)
    ]
    parts = [folded("Camera intrinsics (px)", table(["parameter", "value"], lens))]
    parts.append(folded("Scale", _scale_table(result, summary.get("scale") or {})))
    for title, key in (
        ("Counts", "counts"),
        ("Versions", "versions"),
        ("Settings", "settings"),
    ):
        if summary.get(key):
            text = yaml.safe_dump(summary[key], sort_keys=False)
            parts.append(folded(title, f"<pre>{html.escape(text)}</pre>"))
    return f"<section><h2>Details</h2>{''.join(parts)}</section>"


def _scale_table(result: Result, scale: Mapping[str, Any]) -> str:
    """The scale of the map and its cues, m per unit of the map before scaling."""
    rows = [("estimate", result.scale, scale.get("sigma"))]
    for cue, name in (
        ("from_motion", "people's motion alone"),
        ("from_ground", "ground under people's feet alone"),
        ("from_path", "given camera path alone"),
    ):
        if scale.get(cue) is not None:
            rows.append((name, *scale[cue]))
    columns = ["scale", "m per unit of the unscaled map", "standard deviation"]
    return table(columns, rows)
