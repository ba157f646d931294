"""Writes the report: one HTML file that opens offline, beside the overlay and the
scene.

`in_plain_words` gives the reasons to doubt a result without technical terms.
"""

import base64
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
from bodyslam_jax.evaluation.before_after import TruthBeside, sizes
from bodyslam_jax.export import figures
from bodyslam_jax.export.answers import along_view, answers
from bodyslam_jax.export.expert_figures import (
    error_tables,
    focal_length,
    folded,
    lengths,
    people_table,
    table,
)
from bodyslam_jax.export.folder import plain
from bodyslam_jax.types import Result

_PERSON_SENTENCES = {
    "standing_foot_speed": "The feet of {who} slide over the ground while they stand.",
    "gliding": "{Who} glides: the foot that should stand moves along.",
    "step_short_of_reach": "{Who} steps, but hardly advances.",
    "step_beyond_reach": "{Who} advances further with each step than legs can reach.",
    "step_beyond_reach_of_runner": (
        "{Who} advances further with each step than a runner does."
    ),
    "quick_steps": "{Who} takes steps as quickly as only children do.",
    "turned_from_body": "{Who} is tilted against the bodies that were given.",
    "feet_off_ground": "{Who} floats above the ground, or sinks into it.",
    "ground_slope": "{Who} rises or sinks along the path, as on a steep slope.",
    "knee": "{Who} walks with knees bent as nobody's are.",
    "straighter_knee": "{Who} walks without ever stretching a knee.",
    "hip_over_ankle": "{Who} walks as if crouching.",
    "trunk_lean": "{Who} leans over more than people who walk do.",
    "turn_of_walker": "{Who} turns around faster than people who walk can.",
    "turn": "{Who} turns around faster than people can.",
    "velocity_jump_of_walker": "{Who} changes speed faster than people who walk can.",
    "velocity_jump": "{Who} changes speed faster than people can.",
    "joint_acceleration": "{Who} trembles or jerks.",
    "speed": "{Who} is faster than people can be.",
    "stature": "{Who} is too tall for a person.",
    "short_stature": "{Who} is too short for an adult.",
    "keypoint_misfit": "The body of {who} is away from the person in the images.",
    "legs_inferred": (
        "The legs of {who} are hidden or out of the image for a while; what is shown "
        "there is a guess."
    ),
    "seen_in_pieces": "{Who} is seen in short pieces only, which do not fit together.",
    "appears_within": (
        "{Who} appears in front of or behind somebody else: the two may be exchanged, "
        "or be one."
    ),
    "speed_across_gap": (
        "{Who} is gone for a moment and back too far away to be the same person."
    ),
    "given_stature": "{Who} looks taller or shorter than the stature that was given.",
    "given_fps": (
        "{Who} takes steps more slowly or quickly than people do at the frame rate "
        "that was given."
    ),
    "stature_beyond_body_model": (
        "{Who} is smaller or taller than the body model can be, and has an adult's "
        "proportions."
    ),
    "leg_in_image": "{Who} is too small in the video to be measured.",
    "speed_error": "{Who} is too far away, for too short a time, to be measured.",
}
_WHOLE_SENTENCES = {
    "floors_apart": "People stand at different heights, as if on different floors.",
    "up_against_trunks": "The ground is tilted against the people on it.",
    "lean_of_walkers": "People lean as nobody can who walks.",
    "up_in_image": "The scene is tilted against the images.",
    "slope_of_ground": "The ground slopes against the people on it.",
    "camera_speed": "The camera moves faster than somebody can carry it.",
    "camera_acceleration": "The camera's way jerks more than a hand can.",
    "camera_turning": "The camera turns faster than a hand can turn it.",
    "given_focal": "The images contradict the focal length that was given.",
    "given_centre": "The images contradict the camera's centre that was given.",
    "given_gravity": "People and ground contradict the gravity that was given.",
    "given_static": "The camera was said to stand still, but the background moves.",
    "given_path": "People's sizes contradict the camera's path that was given.",
    "own_factor": "Everything else contradicts a factor that was added.",
    "input_contradicts_itself": "The files that were given contradict each other.",
    "scale_sigma": "All sizes and distances are hardly known.",
    "scale_cues_apart": (
        "People's steps and the ground they stand on disagree about the size of the "
        "scene."
    ),
    "ground_under_feet": "People do not stand on the ground of the map.",
    "height_over_ground": (
        "People climb, and how high over the ground they are is hardly known; nor is "
        "the size of the scene."
    ),
    "not_finite": "The computation failed.",
    "camera_motion": "It was not found how the camera moved.",
    "people": "Nobody was found in the video, so sizes are unknown.",
    "frames_used": "Only a part of the video could be used.",
    "scale_sign": "People move against the direction that they walk in.",
    "scale_unknown": "Nothing in the video tells how large the scene is.",
}


def write_report(
    path: Path,
    result: Result,
    body: BodyModel,
    still: bytes | None = None,
    truth: TruthBeside | None = None,
) -> None:
    """Writes the report of a result: without network or scripts, light or dark.

    Distances and speeds are computed from the result, everything else is taken from
    `result.summary` (keys as written by `summary.summarise`); missing parts are left
    out. The optional key `errors` maps the name of what was evaluated ("cameras alone,
    arbitrary scale", "joint estimate, in metres") to its errors by the names of
    `evaluation`; text in place of a number gives the reason for which there is no
    number.

    Overlay and scene are shown if they are in the folder of `path`. `still` is one
    frame of the overlay (JPEG), which is embedded in the report. The paths and statures
    of `truth` are shown beside the estimate's, and what the stature alone would give.
    """
    summary = plain(result.summary)
    camera = camera_statistics(result)
    people = [person_statistics(result, h) for h in range(len(result.poses))]
    source = summary.get("input") or {}
    name = source.get("name") if isinstance(source, dict) else str(source)
    sections = [
        answers(result, summary, camera, people, body, truth),
        _in_short(summary, len(people)),
        _pictures(path.parent, still),
        _reasons(summary, len(people), _overlay(path.parent)),
        _plots(result, summary, camera, people, truth),
        _warnings(summary.get("warnings") or []),
        _details(result, summary, people, body, truth),
    ]
    style = resources.files("bodyslam_jax.export").joinpath("report.css").read_text()
    path.write_text(
        _PAGE.format(
            title=html.escape(str(name or "run")),
            style=style,
            status=_status(str(summary.get("status", "ok")), along_view(summary)),
            subtitle=html.escape(_subtitle(result, source)),
            body="\n".join(section for section in sections if section),
        ),
        encoding="utf-8",
    )


_MIN_SHOWN_DISTANCE_SIGMA = 0.1
"""Relative standard deviation of distances from which it is printed beside the
status."""
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


def _status(status: str, along: float | None) -> str:
    """Returns the badge beside the title; `along` is the relative standard deviation of
    distances from the camera."""
    good = status == "ok"
    text = html.escape(status)
    if good and along is not None and along > _MIN_SHOWN_DISTANCE_SIGMA:
        text += f", distances ± {100 * along:.0f} %"
    return f'<span class="badge {"good" if good else "bad"}">{text}</span>'


def _subtitle(result: Result, source: Any) -> str:
    t = result.timestamps
    words = [f"{len(t)} frames in {t[-1] - t[0]:.1f} s"]
    if isinstance(source, dict) and source.get("width"):
        words.append(f"{source['width']} × {source['height']} px")
    people = len(result.poses)
    words.append("one person" if people == 1 else f"{people or 'no'} people")
    return " · ".join(words)


def _warnings(warnings: Sequence[str]) -> str:
    if not warnings:
        return ""
    items = "".join(f"<li>{html.escape(str(w))}</li>" for w in warnings)
    return f'<section class="notes"><h2>Warnings</h2><ul>{items}</ul></section>'


def _in_short(summary: Mapping[str, Any], num_people: int) -> str:
    """Returns a line or two on what is in doubt; advice follows further down."""
    reasons = summary.get("reasons") or []
    if not reasons:
        return ""
    failed = summary.get("status") == "failed"
    title = "Do not use this result." if failed else "Look twice at this result."
    text = " ".join(in_plain_words(reason, num_people) for reason in reasons)
    return (
        f'<p class="warnings"><strong>{title}</strong> {html.escape(text)} '
        '<a href="#reasons">What to do</a></p>'
    )


def _overlay(folder: Path) -> str | None:
    """Returns the name of the overlay video, if the folder has one."""
    names = ("overlay.webm", "overlay.mp4")
    return next((name for name in names if (folder / name).exists()), None)


def _where(reason: Mapping[str, Any], overlay: str | None) -> str:
    """Returns the frames to look at, as a link to their time in the overlay."""
    frames, seconds = reason.get("frames"), reason.get("seconds")
    if not frames:
        return ""
    first, last = (int(frame) for frame in frames)
    words = f"Look at frames {first} to {last}"
    if overlay is None or not seconds:
        return f"{words}. "
    start, end = (float(second) for second in seconds)
    link = f"{overlay}#t={start:.2f},{max(end, start + 0.5):.2f}"
    return f'<a href="{link}">{words} ({start:.2f} to {end:.2f} s)</a>. '


def _reasons(summary: Mapping[str, Any], num_people: int, overlay: str | None) -> str:
    """Returns each reason to doubt the result, with its figure, the frames to look at,
    and advice."""
    items = "".join(
        f"<li><strong>{html.escape(in_plain_words(reason, num_people))}</strong> "
        f"{_where(reason, overlay)}"
        f"What to do: {html.escape(str(reason.get('advice', '')))}. "
        f"<small>{html.escape(str(reason.get('message', '')))}</small></li>"
        for reason in summary.get("reasons") or []
    )
    if not items:
        return ""
    title = "Why it is in doubt, and what to do"
    return (
        f'<section class="warnings" id="reasons"><h2>{title}</h2><ul>{items}</ul>'
        "</section>"
    )


def _pictures(folder: Path, still: bytes | None) -> str:
    """Returns the overlay and the scene of the run, and links that open them
    separately."""
    picture = ""
    if still is not None:
        picture = "data:image/jpeg;base64," + base64.b64encode(still).decode()
    parts = []
    name = _overlay(folder)
    if name is not None:
        poster = f' poster="{picture}"' if picture else ""
        shown = (
            f'<video src="{name}" controls muted loop playsinline '
            f'preload="metadata"{poster}></video>'
        )
        words = f'The video with the bodies in it: <a href="{name}">{name}</a>'
        parts.append((shown, words))
    elif picture:
        alt = "a frame of the video with the bodies in it"
        parts.append((f'<img src="{picture}" alt="{alt}">', "A frame of the video."))
    if (folder / "scene.html").exists():
        frame = (
            '<iframe src="scene.html#embedded" loading="lazy" title="scene in 3D">'
            "</iframe>"
        )
        words = 'In 3D, to be turned: <a href="scene.html">scene.html</a>'
        parts.append((frame, words))
    if not parts:
        return ""
    figures_ = "".join(
        f"<figure>{shown}<figcaption>{words}</figcaption></figure>"
        for shown, words in parts
    )
    return f'<section class="two pictures">{figures_}</section>'


def _figure(svg: str, caption: str) -> str:
    text, drawn = html.escape(caption), figures.labelled(svg, caption)
    return f"<figure>{drawn}<figcaption>{text}</figcaption></figure>"


def _plots(
    result: Result,
    summary: Mapping[str, Any],
    camera: PathStatistics,
    people: Sequence[PathStatistics],
    truth: TruthBeside | None,
) -> str:
    """Returns the paths from above and from the side, and the speeds."""
    above, side = figures.trajectories(result, truth)
    beside = _figure(
        side, "From the side. The floor is at the height of standing feet."
    )
    moves = summary.get("camera_motion") not in ("static", "rotation")
    if len(result.timestamps) > 1 and (moves or people):
        svg = figures.speeds(result, camera if moves else None, people)
        caption = "Speed over the ground, paths smoothed over half a second."
        beside += _figure(svg, caption)
    return (
        '<section><h2>Paths and speed</h2><div class="two">'
        + _figure(
            above,
            "From above, with z, ahead of the first camera, up the page: x grows to "
            "the left. Arrows: where the camera looks."
            + (" Dashed: the truth." if truth is not None else ""),
        )
        + f"<div>{beside}</div></div></section>"
    )


def _stages(summary: Mapping[str, Any]) -> str:
    stages = summary.get("stages") or []
    durations = summary.get("durations_s") or {}
    drawn = [
        stage
        for stage in stages
        if min(stage.get("cost_before") or 0, stage.get("cost_after") or 0) > 0
    ]
    parts = []
    if drawn:
        parts.append(_figure(figures.costs(drawn), "Cost of each stage."))
    if stages:
        columns = list(dict.fromkeys(key for stage in stages for key in stage))
        parts.append(table(columns, [[s.get(c) for c in columns] for s in stages]))
    if durations:
        total = ("total", sum(durations.values()))
        parts.append(table(["step", "seconds"], [*durations.items(), total]))
    return "".join(parts)


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
    drawn = []
    for title, ylabel, names, caption in _CURVES:
        colors = (figures.CAMERA_COLOUR, figures.person_color(0))
        curves = {
            label: (np.array(per_frame[key], float), color)
            for (key, label), color in zip(names.items(), colors, strict=True)
            if len(per_frame.get(key) or []) == len(result.timestamps)
        }
        curves = {k: v for k, v in curves.items() if np.isfinite(v[0]).any()}
        if curves:
            svg = figures.over_time(result.timestamps, curves, ylabel)
            drawn.append(f"<div><h3>{title}</h3>{_figure(svg, caption)}</div>")
    return '<div class="two">' + "".join(drawn) + "</div>" if drawn else ""


def _details(
    result: Result,
    summary: Mapping[str, Any],
    people: Sequence[PathStatistics],
    body: BodyModel,
    truth: TruthBeside | None,
) -> str:
    """Returns the details for experts, folded except for errors against a truth."""
    labels = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    lens = [
        (label, round(float(value), 5))
        for label, value in zip(labels, result.intrinsics, strict=False)
    ]
    scale = summary.get("scale") or {}
    contents = {
        "People": people_table(result, summary, people, body),
        "What was given, and what is found without it": _given(summary),
        "Terms of your own": _own(summary),
        "Scale": lengths(result, scale) + _scale_table(result, scale),
        "Camera intrinsics (px)": focal_length(summary.get("intrinsics") or {})
        + table(["parameter", "value"], lens),
        "Stages of the estimate": _stages(summary),
        "Errors of each frame": _per_frame(result, summary.get("per_frame") or {}),
    }
    for title in ("Counts", "Versions", "Settings"):
        if found := summary.get(title.lower()):
            text = yaml.safe_dump(found, sort_keys=False)
            contents[title] = f"<pre>{html.escape(text)}</pre>"
    parts = [folded(title, text) for title, text in contents.items() if text]
    errors = summary.get("errors") or {}
    compared = error_tables(errors, sizes(errors, truth) if truth else ())
    return f"{compared}<section><h2>For experts</h2>{''.join(parts)}</section>"


def _own(summary: Mapping[str, Any]) -> str:
    """Returns the variables and factors that were added to the joint problem from
    Python."""
    own = summary.get("own") or {}
    variables = [
        (name if len(row["value"]) == 1 else f"{name}[{i}]", *numbers)
        for name, row in (own.get("variables") or {}).items()
        for i, numbers in enumerate(
            zip(row["value"], row["sigma"], row["given"], row["given_sigma"])
        )
    ]
    factors = [
        (name, *(row.get(key) for key in ("residuals", "cost", "rms")))
        for name, row in (own.get("factors") or {}).items()
    ]
    found = ""
    if variables:
        found += table(["variable", "value", "±", "prior", "±"], variables)
    if factors:
        found += table(["factor", "residuals", "cost", "rms, in sigmas"], factors)
    return found


def _given(summary: Mapping[str, Any]) -> str:
    """Returns the given facts, each with the estimate that was made without it."""
    rows = [
        [
            str(fact.get("name", "")).removeprefix("given_").replace("_", " ")
            + ("" if fact.get("person") is None else f" of person {fact['person']}"),
            *(fact.get(key) for key in ("unit", "given", "given_sigma")),
            *(fact.get(key) for key in ("without", "without_sigma")),
            fact.get("standard_deviations_apart"),
        ]
        for fact in summary.get("given") or []
    ]
    columns = ["fact", "unit", "given", "±", "without it", "±", "apart, in sigmas"]
    return table(columns, rows) if rows else ""


def _scale_table(result: Result, scale: Mapping[str, Any]) -> str:
    """Returns the scale of the map and its cues, m per unit of the map before
    scaling."""
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


def in_plain_words(reason: Mapping[str, Any], num_people: int = 1) -> str:
    """Returns a sentence for an entry of `reasons` in `summary.json`; its own message
    if there is no plainer one."""
    name = str(reason.get("name"))
    if name in _WHOLE_SENTENCES:
        return _WHOLE_SENTENCES[name]
    if name not in _PERSON_SENTENCES:
        return str(reason.get("message", name))
    number = reason.get("person")
    who = "the person" if number is None or num_people < 2 else f"person {number}"
    return _PERSON_SENTENCES[name].format(who=who, Who=who[0].upper() + who[1:])
