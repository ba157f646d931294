"""Draws the report's figures as SVG text whose colours follow the page, light or
dark."""

import html
import io
import re
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator, MultipleLocator

from bodyslam_jax.body.skeleton import head_ball
from bodyslam_jax.diagnostics.statistics import PathStatistics
from bodyslam_jax.evaluation.before_after import TruthBeside
from bodyslam_jax.geometry.arrays import runs
from bodyslam_jax.types import Result

# Placeholder colours, replaced by CSS variables in the SVG text.
_INK, _GRID, _POINTS = "#010203", "#040506", "#070809"
CAMERA_COLOUR = "#0a0b0c"
_PERSON_COLOURS = (
    *("#0d0e0f", "#101112", "#131415", "#161718"),
    *("#191a1b", "#1c1d1e", "#1f2021", "#222324"),
)
_VARIABLES = {
    _INK: "var(--ink-2)",
    _GRID: "var(--grid)",
    _POINTS: "var(--points)",
    CAMERA_COLOUR: "var(--camera)",
    **{color: f"var(--person-{i})" for i, color in enumerate(_PERSON_COLOURS)},
}
_WIDTH_IN = 5.4
"""Width of figures: half of a wide page, all of a phone's."""
_STYLE: Any = {
    "svg.fonttype": "none",
    "font.family": "sans-serif",
    "font.size": 11,
    "text.color": _INK,
    "axes.edgecolor": _GRID,
    "axes.labelcolor": _INK,
    "xtick.color": _GRID,
    "ytick.color": _GRID,
    "xtick.labelcolor": _INK,
    "ytick.labelcolor": _INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": _GRID,
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "lines.linewidth": 1.8,
    "lines.solid_capstyle": "round",
    "svg.hashsalt": "report",
}


def person_variable(person: int) -> str:
    """Returns the name of the CSS variable for a person's colour."""
    return f"person-{person % len(_PERSON_COLOURS)}"


def person_color(person: int) -> str:
    """Returns the colour of a person in every figure."""
    return _PERSON_COLOURS[person % len(_PERSON_COLOURS)]


def trajectories(result: Result, truth: TruthBeside | None = None) -> tuple[str, str]:
    """Draws camera and people from above and from the side, on a metric grid, and the
    true paths dashed."""
    low, high = _extent(result, truth)
    size = np.maximum(high - low, 0.5)
    width = _WIDTH_IN
    with matplotlib.rc_context(_STYLE):
        plan_height = float(np.clip(width * size[2] / size[0], 2.6, 6.0))
        plan = Figure((width, plan_height + 0.6), layout="constrained")
        ax = plan.add_subplot()
        _paths(ax, result, (0, 2), low, high)
        _true_paths(ax, truth, (0, 2))
        _view_directions(ax, result, float(max(size[0], size[2])))
        ax.set_xlabel("← x (left of the first camera), m")
        ax.set_ylabel("z (ahead of the first camera), m")
        _legend(ax, result, truth)
        ax.invert_xaxis()  # From above, with z up the page, x points to the left.
        along = 0 if size[0] >= size[2] else 2
        side_height = float(np.clip(width * size[1] / size[along], 1.2, 5.0))
        side = Figure((width, side_height + 0.6), layout="constrained")
        ax = side.add_subplot()
        _paths(ax, result, (along, 1), low, high)
        _true_paths(ax, truth, (along, 1))
        if along == 0:
            ax.invert_xaxis()
        ax.set_xlabel("← x, m" if along == 0 else "z, m")
        ax.set_ylabel("height y, m")
        return _svg(plan), _svg(side)


def over_time(
    times: np.ndarray,
    curves: Mapping[str, tuple[np.ndarray, str]],
    ylabel: str,
) -> str:
    """Draws curves `name -> (values, colour)` over time, from zero."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure((_WIDTH_IN, 2.6), layout="constrained")
        ax = figure.add_subplot()
        for name, (values, color) in curves.items():
            ax.plot(times, values, color=color, label=name, linewidth=1.4)
        finite = [v[np.isfinite(v)] for v, _ in curves.values()]
        top = max((float(v.max()) for v in finite if len(v)), default=1.0)
        ax.set_ylim(0, 1.08 * top if top > 0 else 1)
        ax.set_xlim(times[0], max(times[-1], times[0] + 1e-3))
        ax.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
        ax.yaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
        ax.grid(axis="y")
        ax.set_xlabel("time, s")
        ax.set_ylabel(ylabel)
        if len(curves) > 1:
            ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3)
        return _svg(figure)


def costs(stages: Sequence[Mapping[str, Any]]) -> str:
    """Draws the cost before and after each stage, on a logarithmic axis."""
    with matplotlib.rc_context(_STYLE):
        figure = Figure((_WIDTH_IN, 0.8 + 0.45 * len(stages)), layout="constrained")
        ax = figure.add_subplot()
        for row, stage in enumerate(stages):
            before, after = float(stage["cost_before"]), float(stage["cost_after"])
            ax.plot([before, after], [row, row], color=_GRID, linewidth=3)
            ax.plot(before, row, "o", color=_INK, fillstyle="none", markersize=7)
            ax.plot(after, row, "o", color=CAMERA_COLOUR, markersize=7)
            ax.annotate(
                f"{after:.4g}", (after, row), (0, 7), textcoords="offset points"
            )
        ax.set_yticks(range(len(stages)), [str(s["name"]) for s in stages])
        ax.set_ylim(len(stages) - 0.5, -0.7)
        ax.set_xscale("log")
        ax.margins(x=0.12)
        ax.grid(axis="x")
        ax.tick_params(axis="y", length=0)
        ax.set_xlabel("cost before (ring) and after (dot)")
        return _svg(figure)


def speeds(
    result: Result, camera: PathStatistics | None, people: Sequence[PathStatistics]
) -> str:
    """Draws the horizontal speed of people and of a moving camera."""
    curves = {} if camera is None else {"camera": (camera.speed, CAMERA_COLOUR)}
    for person, facts in enumerate(people):
        curves[f"person {person}"] = (facts.speed, person_color(person))
    return over_time(result.timestamps, curves, "speed, m/s")


def _extent(result: Result, truth: TruthBeside | None) -> tuple[np.ndarray, np.ndarray]:
    """Returns the box around camera and people, with a margin; it contains heights 0
    and 2 m."""
    points = [
        result.T_WC[:, :3, 3],
        *(
            joints[present].reshape(-1, 3)
            for joints, present in zip(result.joints, result.present, strict=True)
        ),
    ]
    if truth is not None:
        known = truth.pelvises.reshape(-1, 3)
        points += [truth.cameras, known[np.isfinite(known).all(axis=1)]]
    every = np.concatenate(points)
    low, high = every.min(0), every.max(0)
    margin = 0.08 * max(float((high - low).max()), 1.0)
    low, high = low - margin, high + margin
    low[1], high[1] = min(low[1], -0.1), max(high[1], 2.0)
    return low, high


def _paths(
    ax: Axes, result: Result, axes: tuple[int, int], low: np.ndarray, high: np.ndarray
) -> None:
    a, b = axes
    near = np.all((result.landmarks >= low - 1) & (result.landmarks <= high + 1), 1)
    points = result.landmarks[near]
    points = points[:: max(1, len(points) // 1500)]
    ax.scatter(points[:, a], points[:, b], 2, _POINTS, linewidths=0)
    if b == 1:
        ax.axhline(0, color=_INK, linewidth=1)
        _stick_figures(ax, result, a)
    ax.plot(*result.T_WC[:, axes, 3].T, color=CAMERA_COLOUR, label="camera")
    ax.plot(*result.T_WC[0, axes, 3], "o", color=CAMERA_COLOUR, markersize=6)
    for person, (joints, present) in enumerate(
        zip(result.joints, result.present, strict=True)
    ):
        color = person_color(person)
        for run in runs(present):
            ax.plot(*joints[run, 0][:, axes].T, color=color)
        if present.any():
            start = joints[np.argmax(present), 0]
            ax.plot(*start[list(axes)], "o", color=color, markersize=6)
    ax.set_aspect("equal", adjustable="box")
    ax.set_xlim(low[a], high[a])
    ax.set_ylim(low[b], high[b])
    size = max(high[a] - low[a], high[b] - low[b])
    steps = (0.25, 0.5, 1, 2, 5, 10, 20, 50)
    larger = 10 ** np.ceil(np.log10(size / 14))
    step = next((s for s in steps if size / s <= 14), larger)
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MultipleLocator(step))
    ax.grid(True)


_LIMBS = (
    (15, 12, 9, 0),
    (0, 1, 4, 7, 10),
    (0, 2, 5, 8, 11),
    (20, 18, 16, 9, 17, 19, 21),
)


def _stick_figures(ax: Axes, result: Result, along: int) -> None:
    """Draws nine stick figures of each person, evenly spaced over the person's frames.

    Axis `along` of the world (0: x, 2: z) is horizontal in the figure, y vertical.
    """
    for person, present in enumerate(result.present):
        frames = np.flatnonzero(present)
        if not len(frames):
            continue
        for frame in frames[np.linspace(0, len(frames) - 1, 9).round().astype(int)]:
            for limb in _LIMBS:
                joints = result.joints[person, frame, limb, :]
                ax.plot(
                    joints[:, along],
                    joints[:, 1],
                    color=person_color(person),
                    linewidth=1.2,
                    alpha=0.45,
                )
            middle, radius = head_ball(result.joints[person, frame])
            head = Circle(
                (middle[along], middle[1]),
                float(radius),
                facecolor=person_color(person),
                edgecolor="none",
                alpha=0.45,
            )
            ax.add_patch(head)


def _true_paths(ax: Axes, truth: TruthBeside | None, axes: tuple[int, int]) -> None:
    """Draws the true paths of camera and pelvises, dashed."""
    for path in [] if truth is None else (truth.cameras, *truth.pelvises):
        ax.plot(*path[:, axes].T, "--", color=_INK, linewidth=1.2)


def _view_directions(ax: Axes, result: Result, size: float) -> None:
    """Draws arrows of the camera's viewing direction at several frames."""
    every = max(1, len(result.T_WC) // 12)
    T_WC = result.T_WC[::every]
    centre, ahead = T_WC[:, [0, 2], 3], T_WC[:, [0, 2], 2]
    ax.quiver(
        *centre.T,
        *(ahead * 0.06 * size).T,
        color=CAMERA_COLOUR,
        angles="xy",
        scale_units="xy",
        scale=1,
        width=0.003,
        alpha=0.7,
    )


def _legend(ax: Axes, result: Result, truth: TruthBeside | None) -> None:
    for person in range(min(len(result.present), 8)):
        ax.plot([], [], color=person_color(person), label=f"person {person}")
    ax.plot([], [], "o", color=_INK, label="start", markersize=5)
    if truth is not None:
        ax.plot([], [], "--", color=_INK, label="truth", linewidth=1.2)
    if len(result.landmarks):
        ax.scatter([], [], 6, _POINTS, label="map")
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=3, columnspacing=1)


def labelled(svg: str, caption: str) -> str:
    """Returns a figure with its caption as label for screen readers, and with unique
    ids."""
    mark = f"f{zlib.crc32(caption.encode()):x}-"
    svg = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{mark}", svg)
    name = html.escape(caption)
    return svg.replace("<svg", f'<svg role="img" aria-label="{name}"', 1)


def _svg(figure: Figure) -> str:
    buffer = io.StringIO()
    figure.set_facecolor("none")
    for ax in figure.axes:
        ax.set_facecolor("none")
    FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    for name in ("width", "height"):
        text = re.sub(rf'(<svg[^>]*?) {name}="[^"]*"', r"\1", text, count=1)
    for color, variable in _VARIABLES.items():
        text = text.replace(color, variable)
    return text
