"""Figures of every benchmark by sequence, kept as JSON, and two such files compared.

    python benchmarks/figures_by_sequence.py measure FIGURES.json [--parts tens tripods]
        [--inputs pixels] [--frames 120] [--videos FOLDER] [--motion CMU.npz]
        [--keep FOLDER]
    python benchmarks/figures_by_sequence.py compare BEFORE.json AFTER.json

`measure` adds the rows that the file does not have; an interrupted run goes on. The
parts are `tens` (the ten sequences of both families, rendered: from pixels, simulated
keypoints, bodies), `others` (the same of people who do something else than walk),
`contacts` (standing feet, from simulated bodies and keypoints), `floors` (level, slope,
stairs, uneven, drift), `tripods` (one to three people before a camera that does not
move), `jumps` (recorded ones; needs `--motion`) and `clips` (real videos of `--videos`,
which have no truth: their figures of posture and ground).

`compare` pairs the rows of two files. An error is no worse if the mean of its paired
differences is within one standard error of the difference, and it is no more than a
quarter larger in any sequence, where an increase below `SMALL` is none. Exit code 1 if
any is worse.
"""

import argparse
import hashlib
import importlib.metadata
import json
import math
import sys
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

import bodyslam_jax

Row = dict[str, Any]
PARTS = ("tens", "others", "contacts", "floors", "tripods", "jumps", "clips")
TENS = ("E1", "E2", "E3", "M1", "M2", "M3", "M4", "D1", "D2", "D3")
WORSE = 1.25
"""Ratio of an error after to that before, in one sequence, from which it is worse."""
SMALL = {"degrees": 0.2, "mm": 2.0, "%": 0.5, "m/s": 0.02, "cm": 0.5, "m/s2": 0.5}
"""An increase below this is within what a change of rounding makes of one sequence:
half of the differences between two machines' runs of the tens are below it."""


def _above(value: str) -> Callable[[Row], float]:
    """|estimate - truth| of a figure that both sides have."""
    return lambda row: abs(row[value] - row[f"{value}_of_truth"])


_DEGREES, _MM = math.degrees(1.0), 1e3
ERRORS: dict[str, tuple[str, Callable[[Row], float]]] = {
    "c_ate_se3": ("mm", lambda row: _MM * row["c_ate_se3"]),
    "c_ate_sim3": ("mm", lambda row: _MM * row["c_ate_sim3"]),
    "h_ate_se3": ("mm", lambda row: _MM * row["h_ate_se3"]),
    "h_ate_sim3": ("mm", lambda row: _MM * row["h_ate_sim3"]),
    "j_ate_se3": ("mm", lambda row: _MM * row["j_ate_se3"]),
    "j_ate_sim3": ("mm", lambda row: _MM * row["j_ate_sim3"]),
    "pa_mpjpe": ("mm", lambda row: _MM * row["pa_mpjpe"]),
    "scale": ("%", lambda row: 100 * abs(1 - row["scale"])),
    "leg": ("%", lambda row: 100 * abs(1 - row["size"])),
    "gravity": ("degrees", lambda row: _DEGREES * row["gravity_error"]),
    "knee": ("degrees", lambda row: _DEGREES * _above("knee")(row)),
    "straighter_knee": (
        "degrees",
        lambda row: _DEGREES * _above("straighter_knee")(row),
    ),
    "standing_foot": ("m/s", _above("foot_speed")),
    "feet_low": ("cm", lambda row: 100 * _above("feet_low")(row)),
    "feet_high": ("cm", lambda row: 100 * _above("feet_high")(row)),
    "acceleration": ("m/s2", _above("joint_acceleration")),
}
"""Errors of a row with a truth: unit and value. Rows of other parts have theirs, and
those of real clips have figures that are errors by themselves (`POSTURE`)."""
OF_BENCHMARK = {
    "scale_error": "%",
    "up": "degrees",
    "foot": "m/s",
    "h_ate_se3_mm": "mm",
    "h_ate_sim3_mm": "mm",
    "pa_mpjpe_mm": "mm",
    "floors_apart": "mm",
    "sizes_apart": "%",
    "low": "mm",
    "high": "mm",
    "straighter_knee_error": "degrees",
}
"""Errors of rows of contacts, floors, tripods and jumps, in these units."""
POSTURE = {
    "straighter_knee_deg": "degrees",
    "feet_low_cm": "cm",
    "feet_high_cm": "cm",
    "foot_speed_ms": "m/s",
    "lean_deg": "degrees",
}
"""Figures of real clips, which have no truth: smaller is better for people who walk."""


def errors_of(row: Row) -> dict[str, tuple[str, float]]:
    """Every error of a row, with its unit; those that are not finite are left out."""
    found: dict[str, tuple[str, float]] = {}
    if row["part"] in ("tens", "others"):
        for name, (unit, value) in ERRORS.items():
            try:
                found[name] = unit, float(value(row))
            except (KeyError, TypeError):
                continue
    else:
        units = POSTURE if row["part"] == "clips" else OF_BENCHMARK
        for name, unit in units.items():
            if isinstance(row.get(name), int | float):
                found[name] = unit, abs(float(row[name]))
    return {name: x for name, x in found.items() if math.isfinite(x[1])}


def compare(before: list[Row], after: list[Row]) -> tuple[list[str], bool]:
    """Lines of a table of paired differences, and whether any error is worse."""
    key = lambda row: (row["part"], row["input"], row["sequence"])
    pairs = {key(row): [row] for row in before}
    for row in after:
        if key(row) in pairs:
            pairs[key(row)].append(row)
    pairs = {k: v for k, v in pairs.items() if len(v) == 2}
    lines, any_worse = [], False
    groups = dict.fromkeys((part, which) for part, which, _ in pairs)
    for part, which in groups:
        both = [pair for (p, i, _), pair in pairs.items() if (p, i) == (part, which)]
        lines += [f"## {part}, {which}: {len(both)} sequences", "", HEADER, RULE]
        names = dict.fromkeys(name for pair in both for name in errors_of(pair[0]))
        for name in names:
            line, worse = _compared(name, both)
            lines.append(line)
            any_worse |= worse
        changed = [
            f"{a['sequence']} {a.get('status')} -> {b.get('status')}"
            for a, b in both
            if a.get("status") != b.get("status")
        ]
        lines += ["", f"Status changed: {'; '.join(changed) or 'none'}.", ""]
    missing = len(before) - len(pairs)
    lines.append(f"{len(pairs)} pairs; {missing} rows of the first file have none.")
    return lines, any_worse


HEADER = (
    "| error | before | after | difference ± its standard error | worse by a quarter "
    "in | verdict |"
)
RULE = "|---|---|---|---|---|---|"


def _compared(name: str, both: list[list[Row]]) -> tuple[str, bool]:
    values, where, unit = [], [], ""
    for pair in both:
        first, second = (errors_of(row).get(name) for row in pair)
        if first is None or second is None:
            continue
        unit = first[0]
        values.append((first[1], second[1]))
        where.append(pair[0]["sequence"])
    x, y = np.array(values).reshape(-1, 2).T
    change = y - x
    count = max(len(change), 1)
    error = change.std(ddof=1) / math.sqrt(count) if count > 1 else 0.0
    far = [w for w, a, b in zip(where, x, y) if b > WORSE * a and b - a > SMALL[unit]]
    worse = bool(far) or change.mean() > max(error, 1e-9 * abs(x.mean()))
    verdict = "worse" if worse else "no worse"
    line = (
        f"| {name}, {unit} | {x.mean():.3g} | {y.mean():.3g} | {change.mean():+.3g} "
        f"± {error:.2g} | {' '.join(far) or 'none'} | {verdict} |"
    )
    return line, worse


def provenance() -> Row:
    """Versions, and hashes of everything learnt that ships."""
    root = Path(bodyslam_jax.__file__).parent
    files = sorted([*root.rglob("*.npz"), *root.rglob("*.onnx")])
    digest = lambda file: hashlib.sha256(file.read_bytes()).hexdigest()[:16]
    code = zlib.crc32(b"".join(f.read_bytes() for f in sorted(root.rglob("*.py"))))
    return {
        "version": bodyslam_jax.__version__,
        "code": f"{code:08x}",
        "jax": importlib.metadata.version("jax"),
        "numpy": np.__version__,
        "assets": {str(f.relative_to(root)): digest(f) for f in files},
    }


Task = tuple[str, str, str, Callable[[], Row]]
"""Part, input, sequence, and what computes the row."""


def tens(
    options: argparse.Namespace, part: str = "tens", motion: str | None = None
) -> Iterator[Task]:
    from bodyslam_jax.config import Config, Experiment
    from bodyslam_jax.experiments import video
    from bodyslam_jax.experiments.scenario import simulations

    config = Config(overlay=False).for_simulated_people()
    experiment = Experiment(
        frames=options.frames, family="both", seed=options.seed, motion=motion
    )
    for plain in simulations(experiment, options.sequences or TENS, ("room", "follow")):
        settings = video.filmed(plain)
        for which in video.INPUTS:
            row = lambda s=settings, w=which: video.video_row(
                s, w, config, options.keep / part
            )
            yield part, which, video.named(settings), row


def others(options: argparse.Namespace) -> Iterator[Task]:
    yield from tens(options, "others", "other")


def contacts(options: argparse.Namespace) -> Iterator[Task]:
    import bench_contact

    for name in options.sequences or ("E1", "E3", "M1", "D2"):
        for family in ("room", "follow"):
            for which in ("bodies", "keypoints"):
                sequence = f"{name}-{family}"
                make = lambda s=sequence, w=which: bench_contact.result_row(
                    s, options.frames, w == "keypoints"
                )
                row = lambda make=make: _renamed(_of_contact(make()))
                yield "contacts", which, sequence, row


def _of_contact(row: Row) -> Row:
    """A row of `bench_contact` under the names of the other benchmarks."""
    return row | {
        "scale": 100 * (row["scale"] - 1),
        "up": row["gravity"],
        "foot": row["foot_speed"],
        "foot_true": row["true"],
    }


def floors(options: argparse.Namespace) -> Iterator[Task]:
    import bench_ground

    for name in options.sequences or ("E2-room", "D1-follow"):
        for floor in bench_ground.FLOORS:
            make = lambda n=name, f=floor: bench_ground.figures(
                bench_ground.kept_case(n, f, options.frames, options.keep / "floors")
            )
            row = lambda make=make: _renamed(make())
            yield "floors", "bodies", f"{name}-{floor}", row


def tripods(options: argparse.Namespace) -> Iterator[Task]:
    import bench_static

    for people in (1, 2, 3):
        for name in options.sequences or ("E1", "E2", "M2", "M4", "D1"):
            row = lambda n=name, p=people: _renamed(
                bench_static.row(n, p, options.frames, 1.5)
            )
            yield "tripods", "keypoints", f"{name}-{people}", row


def jumps(options: argparse.Namespace) -> Iterator[Task]:
    if options.motion is None:
        print("jumps: left out, they need --motion CMU.npz", file=sys.stderr)
        return
    import bench_jumps

    from bodyslam_jax import motion

    clips = {clip.name: clip for clip in motion.read_motion(options.motion)}
    for name in options.sequences or bench_jumps.JUMPS:
        for static in (False, True):
            for which in ("bodies", "keypoints"):
                label = f"{name}-{'static' if static else 'moving'}"
                row = lambda n=name, s=static, w=which: _renamed(
                    bench_jumps.figures(
                        bench_jumps.scene(clips[n], options.frames, s)[0], w, s
                    )
                )
                yield "jumps", which, label, row


def clips(options: argparse.Namespace) -> Iterator[Task]:
    if options.videos is None:
        print("clips: left out, they need --videos FOLDER", file=sys.stderr)
        return
    for video in sorted(options.videos.glob("*/video.mp4")):
        yield "clips", "pixels", video.parent.name, lambda v=video: clip_row(v)


def clip_row(video: Path) -> Row:
    """Figures of posture and ground of a real clip, from its video alone: means over
    people."""
    import jax.numpy as jnp

    from bodyslam_jax import io, pipeline
    from bodyslam_jax.body.skeleton import NECK, PELVIS
    from bodyslam_jax.config import Config
    from bodyslam_jax.evaluation.errors import posture_figures

    config = Config(overlay=False)
    sequence = pipeline.find_people(io.read_sequence(video), config)
    result = pipeline.run(sequence, config)
    fps = 1 / np.median(np.diff(result.timestamps))
    up = jnp.array([0.0, 1.0, 0.0])
    rows = []
    for joints, present in zip(result.joints, result.present):
        found = posture_figures(
            jnp.asarray(joints), jnp.asarray(present), up, jnp.asarray(fps)
        )
        trunk = (joints[:, NECK] - joints[:, PELVIS])[present]
        lean = np.degrees(np.arccos(trunk[:, 1] / np.linalg.norm(trunk, axis=1)))
        rows.append(
            {
                "straighter_knee_deg": _DEGREES * float(found["straighter_knee"]),
                "feet_low_cm": 100 * float(found["feet_low"]),
                "feet_high_cm": 100 * float(found["feet_high"]),
                "foot_speed_ms": float(found["foot_speed"]),
                "lean_deg": float(lean.mean()),
            }
        )
    summary = result.summary
    mean = (
        {n: float(np.mean([row[n] for row in rows])) for n in POSTURE} if rows else {}
    )
    reasons = [reason["name"] for reason in summary.get("reasons", [])]
    return {**mean, "people": len(rows), "status": summary["status"], "why": reasons}


_NAMES = {
    "h_ate_se3": "h_ate_se3_mm",
    "h_ate_sim3": "h_ate_sim3_mm",
    "pa_mpjpe": "pa_mpjpe_mm",
    "straighter_knee": "straighter_knee_error",
}


def _renamed(row: Row) -> Row:
    """A benchmark's row with units in names, and errors in place of values."""
    row = {_NAMES.get(name, name): value for name, value in row.items()}
    if "scale" in row:
        row["scale_error"] = abs(row["scale"])
    elif "size" in row:
        row["scale_error"] = abs(row["size"])
    for name, true in (("foot", "foot_true"), ("straighter_knee_error", "true_knee")):
        if name in row and true in row:
            row[name] = abs(row[name] - row[true])
    return row


def measure(options: argparse.Namespace) -> None:
    import jax

    jax.config.update("jax_enable_x64", True)
    sys.path.insert(0, str(Path(__file__).parent))
    about = provenance() | {"frames": options.frames, "seed": options.seed}
    kept = json.loads(options.file.read_text()) if options.file.exists() else {}
    if kept and kept["about"] != json.loads(json.dumps(about)):
        sys.exit(f"{options.file}: of another version or settings; give another file.")
    rows: list[Row] = kept.get("rows", [])
    done = {(row["part"], row["input"], row["sequence"]) for row in rows}
    for part in options.parts:
        for name, which, sequence, compute in globals()[part](options):
            wanted = not options.inputs or which in options.inputs
            if not wanted or (name, which, sequence) in done:
                continue
            row = {"part": name, "input": which, "sequence": sequence, **compute()}
            rows.append(row)
            text = json.dumps({"about": about, "rows": rows}, indent=1, default=float)
            options.file.write_text(text)
            shown = {n: round(v, 3) for n, (_, v) in errors_of(row).items()}
            print(name, which, sequence, row.get("status", ""), shown, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    one = commands.add_parser("measure")
    one.add_argument("file", type=Path)
    one.add_argument("--parts", nargs="*", choices=PARTS, default=list(PARTS))
    one.add_argument("--inputs", nargs="*", default=[], help="of `tens` and others")
    one.add_argument("--sequences", nargs="*", default=[])
    one.add_argument("--frames", type=int, default=120)
    one.add_argument("--seed", type=int)
    one.add_argument("--videos", type=Path)
    one.add_argument("--motion", type=Path)
    one.add_argument("--keep", type=Path, default=Path("figures_kept"))
    two = commands.add_parser("compare")
    two.add_argument("before", type=Path)
    two.add_argument("after", type=Path)
    options = parser.parse_args()
    if options.command == "measure":
        measure(options)
        return
    before, after = (
        json.loads(file.read_text())["rows"] for file in (options.before, options.after)
    )
    lines, worse = compare(before, after)
    print("\n".join(lines))
    sys.exit(1 if worse else 0)


if __name__ == "__main__":
    main()
