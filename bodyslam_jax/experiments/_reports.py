"""Tables and figures of finished rows: Markdown, CSV and PNG beside one another."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from bodyslam_jax import body as body_
from bodyslam_jax import motion, synthetic
from bodyslam_jax.config import Config
from bodyslam_jax.experiments import _figures as figures
from bodyslam_jax.experiments import _paper as paper
from bodyslam_jax.experiments._comparison import METHODS
from bodyslam_jax.experiments._tables import Column, markdown, to_csv, write_text

Row = dict[str, Any]
CLIPS = Path(synthetic.__file__).parent / "assets" / "walking.npz"
"""The clips that ship."""
_MM = 1e3


def _intro(title: str, noise: str, *lines: str) -> str:
    about = f"Simulated sequences, noise level `{noise}`. {paper.OTHER_DATA}"
    return "\n".join([f"# {title}", "", about, *lines, "", ""])


def _write(
    out: Path,
    name: str,
    head: str,
    parts: Sequence[tuple[str, list[Column], list[Row]]],
) -> list[Path]:
    """`name.md` with all parts under their titles, `name.csv` with the first."""
    text = head
    for title, columns, rows in parts:
        text += f"## {title}\n\n{markdown(columns, rows, mean=len(rows) > 1)}\n"
    write_text(out / f"{name}.md", text)
    write_text(out / f"{name}.csv", to_csv(parts[0][1], parts[0][2]))
    return [out / f"{name}.md", out / f"{name}.csv"]


def errors_of(method: str, groups: Sequence[str] = ("se3", "sim3")) -> list[Column]:
    """C-, H- and J-ATE of one method, mm."""
    names = {"se3": "SE(3)", "sim3": "Sim(3)"}
    return [
        Column(f"{e.upper()}-ATE {names[g]}, mm", f"{method}/{e}_ate_{g}", _MM)
        for g in groups
        for e in "chj"
    ]


def table1_columns() -> list[Column]:
    """No motion model and full side by side, as in the paper."""
    columns = [Column("sequence", "sequence")]
    for error in "chj":
        for group, label in (("se3", "SE(3)"), ("sim3", "Sim(3)")):
            for method, short in (("no_mm", "no MM"), ("full", "full")):
                title = f"{error.upper()}-ATE {label} {short}, mm"
                columns.append(Column(title, f"{method}/{error}_ate_{group}", _MM))
    columns.append(Column("scale no MM", "no_mm/scale", digits=3))
    columns.append(Column("scale full", "full/scale", digits=3))
    return columns


def write_table1(out: Path, rows: list[Row], *, noise: str) -> list[Path]:
    """Table 1, what is behind it, and the baselines."""
    for row in rows:
        row["scale_error"] = abs(1 - row["full/scale"])
        row["share"] = row["full/c_ate_se3"] / row["radius"]
    papers = [paper.table1_row(row["sequence"].split("-")[0]) for row in rows]
    once = {p: {"sequence": p, **paper.table1_row(p)} for p in paper.TABLE1}
    named = [row["sequence"].split("-")[0] for row in rows]
    theirs = [once[name] for name in dict.fromkeys(named)]
    behind = [
        Column("sequence", "sequence"),
        Column("frames", "frames", digits=0),
        Column("camera's RMS radius, m", "radius", digits=2),
        Column("C-ATE SE(3), % of it", "share", 100.0, 2),
        Column("start / true scale", "start_ratio", digits=3),
        Column("its standard error", "start_sigma", digits=3),
        Column("estimated / true scale", "scale_ratio", digits=3),
        Column("|1 − s|", "scale_error", digits=3),
        Column("leg / true leg", "full/leg_ratio", digits=3),
        Column("steps", "steps", digits=0),
        Column("status", "status"),
    ]
    parts = []
    families = list(dict.fromkeys(row["sequence"].split("-")[1] for row in rows))
    for family in families:
        own = [row for row in rows if row["sequence"].endswith(family)]
        parts.append((f"Family `{family}`", table1_columns(), own))
        parts.append((f"Family `{family}`: behind it", behind, own))
        for method, meaning in METHODS.items():
            if method in ("no_mm", "full"):
                continue
            columns = [Column("sequence", "sequence"), *errors_of(method)]
            columns.append(Column("scale", f"{method}/scale", digits=3))
            parts.append((f"Family `{family}`: {meaning}", columns, own))
    parts.append(("The paper's table 1, its own data", table1_columns(), theirs))
    head = _intro(
        "Table 1: with and without a motion model",
        noise,
        "Means over frames. `scale` is that of the Sim(3) alignment of the cameras "
        "(truth per estimate, best 1); without a motion model it is the unit of the "
        "reconstruction, hence arbitrary. "
        + "; ".join(f"`{name}`: {meaning}" for name, meaning in METHODS.items())
        + ".",
    )
    written = _write(out, "table1", head, parts)
    write_text(out / "table1.csv", to_csv([*table1_columns(), *behind[1:]], rows))
    figures.draw_table(out / "table1.png", rows, papers)
    figures.draw_paths(out / "table1_paths.png", rows)
    return [*written, out / "table1.png", out / "table1_paths.png"]


def write_scale(out: Path, rows: list[Row], *, noise: str) -> list[Path]:
    """Deviation by perturbation, and convergence."""
    flat = []
    for row in rows:
        for i, p in enumerate(row["perturbation"]):
            flat.append(
                {
                    "sequence": row["sequence"],
                    "perturbation": p,
                    "scale": row["scale"][i],
                    "deviation": row["deviation"][i],
                    "h_before": row["h_ate"][i][0],
                    "h_after": row["h_ate"][i][-1],
                    "paper": paper.SCALE[p][0] if p in paper.SCALE else None,
                    "paper_deviation": paper.SCALE[p][1] if p in paper.SCALE else None,
                }
            )
    columns = [
        Column("sequence", "sequence"),
        Column("perturbation 1/s'", "perturbation"),
        Column("estimated s", "scale", digits=4),
        Column("deviation, %", "deviation", 100.0, 2),
        Column("H-ATE before, mm", "h_before", _MM),
        Column("H-ATE after, mm", "h_after", _MM),
        Column("the paper's s, its own data", "paper", digits=3),
        Column("the paper's deviation, %", "paper_deviation"),
    ]
    spread = [
        Column("sequence", "sequence"),
        Column("largest difference between answers, %", "spread", 100.0, 4),
    ]
    head = _intro(
        "Scale recovery from perturbed cameras",
        noise,
        "Cameras of bundle adjustment at their true size, made 1/p as large and held; "
        "no landmarks; s starts at 1; s and people are free. The answer should not "
        "depend on the start. Deviation is signed: the motion model's bias on the "
        "sequence.",
    )
    parts = [("By perturbation", columns, flat), ("Spread", spread, rows)]
    written = _write(out, "scale", head, parts)
    figures.draw_scale(out / "scale.png", rows)
    return [*written, out / "scale.png"]


def write_structure(out: Path, rows: list[Row], *, noise: str) -> list[Path]:
    """C-ATE of shaken cameras with and without landmarks."""
    names = ("original", "perturbed", "no_landmarks", "landmarks")
    theirs: list[Row | None] = []
    for row in rows:
        known = paper.STRUCTURE.get(row["sequence"].split("-")[0])
        values = None if known is None else [1e-3 * v for v in known]
        theirs.append(values and dict(zip(names, values, strict=True)))
    columns = [
        Column("sequence", "sequence"),
        Column("original (map's unit), mm", "original", _MM),
        Column("scale in closed form, mm", "start", _MM),
        Column("perturbed, mm", "perturbed", _MM),
        Column("optimised, no landmarks, mm", "no_landmarks", _MM),
        Column("optimised, landmarks, mm", "landmarks", _MM),
        Column("scale, no landmarks", "no_landmarks/scale", digits=3),
        Column("scale, landmarks", "landmarks/scale", digits=3),
        Column("status, no landmarks", "status_no_landmarks"),
        Column("status, landmarks", "status"),
    ]
    listed = [
        {"sequence": r["sequence"], **p} for r, p in zip(rows, theirs, strict=True) if p
    ]
    own = [Column("sequence", "sequence")]
    own += [Column(f"{n.replace('_', ' ')}, mm", n, _MM) for n in names]
    head = _intro(
        "Structural landmarks",
        noise,
        "C-ATE, SE(3), mean over frames. Every camera is moved by up to 100 mm and "
        "0.01 rad in each coordinate, then everything is optimised.",
    )
    parts = [("Ours", columns, rows)]
    if listed:
        parts.append(("The paper's, its own data", own, listed))
    written = _write(out, "landmarks", head, parts)
    figures.draw_structure(out / "landmarks.png", rows, theirs)
    return [*written, out / "landmarks.png"]


def write_motion(out: Path, rows: list[Row], source: str, config: Config) -> list[Path]:
    """The motion model's errors in the paper's form, and their histograms."""
    found = rows[0]
    error, step = paper.MOTION
    ours = next(r for r in found["rows"] if r["class"] == "all" and r["drift"] == 0)
    which = "held out of training" if found["held_out"] else "of one person"
    head = (
        "# Prediction of motion\n\n"
        f"{found['clips']} clips of `{Path(source).name}`, {which}. "
        f"Mean error {ours['error_mm']:.1f} mm at a mean step of {ours['step_mm']:.1f} "
        f"mm a frame (ratio {ours['ratio']:.3f}). The paper's, on AMASS, other data: "
        f"{error} mm at {step} mm (ratio {error / step:.3f}).\n\n"
    )
    nan = float("nan")
    table = [{k: nan if v is None else v for k, v in r.items()} for r in found["rows"]]
    write_text(out / "motion.md", head + motion.write_table(table))
    names = list(found["rows"][0])
    columns = [Column(name, name) for name in names]
    write_text(out / "motion.csv", to_csv(columns, found["rows"]))
    model = motion.load_motion_model(config.motion_model)
    training, held = motion.split(motion.read_motion(source))
    picture = out / "motion.png"
    body = body_.load_body_model(config.body_model)
    motion.draw_errors(model, body, held or training, picture)
    return [out / "motion.md", out / "motion.csv", picture]


def write_ablation(out: Path, rows: list[Row], *, noise: str) -> list[Path]:
    """Every variant's errors, sequence by sequence."""
    columns = [
        Column("variant", "label"),
        Column("C-ATE SE(3), mm", "c_ate_se3", _MM),
        Column("H-ATE SE(3), mm", "h_ate_se3", _MM),
        Column("J-ATE SE(3), mm", "j_ate_se3", _MM),
        Column("J-ATE Sim(3), mm", "j_ate_sim3", _MM),
        Column("estimated / true scale", "scale_ratio", digits=3),
        Column("leg / true leg", "leg_ratio", digits=3),
        Column("steps", "steps", digits=0),
        Column("seconds", "seconds"),
        Column("cost", "cost", digits=0),
        Column("status", "status"),
    ]
    parts, written = [], []
    for sequence in dict.fromkeys(row["sequence"] for row in rows):
        own = [row for row in rows if row["sequence"] == sequence]
        parts.append((sequence, columns, own))
        picture = out / f"ablation_{sequence}.png"
        measures = (
            ("c_ate_se3", "C-ATE, mm", _MM),
            ("j_ate_se3", "J-ATE, mm", _MM),
            ("scale_ratio", "estimated / true scale", 1.0),
        )
        figures.draw_bars(picture, own, measures)
        written.append(picture)
    head = _intro(
        "Ablations",
        noise,
        "`seconds` are wall time with compilation, but processor time without it for "
        "the three rows on orders.",
    )
    everything = [("All", [Column("sequence", "sequence"), *columns], rows)]
    files = _write(out, "ablation", head, [*parts])
    write_text(out / "ablation.csv", to_csv(everything[0][1], rows))
    return [*files, *written]


def write_weights(out: Path, rows: list[Row], *, noise: str) -> list[Path]:
    """Learnt factors, and errors before and after on training and test sequences."""
    found = rows[0]
    factors = [
        {"weight": n, "factor": f, "lambda": f**-2}
        for n, f in zip(found["names"], found["factor"], strict=True)
    ]
    columns = [
        Column("sequence", "sequence"),
        Column("set", "set"),
        Column("error before, 1", "before/error", digits=2),
        Column("after", "after/error", digits=2),
        Column("scale before", "before/scale", digits=3),
        Column("scale after", "after/scale", digits=3),
        Column("J-ATE before, mm", "before/j_ate_se3", _MM),
        Column("J-ATE after, mm", "after/j_ate_se3", _MM),
    ]
    learnt = [
        Column("weight", "weight"),
        Column("factor on σ (or robust scale)", "factor", digits=2, average=False),
        Column("factor on λ", "lambda", digits=2, average=False),
    ]
    head = _intro("Weights learnt through the solver", noise)
    parts = [
        (f"{name} sequences", columns, [r for r in found["rows"] if r["set"] == name])
        for name in ("training", "test")
    ]
    parts = [part for part in parts if part[2]]
    files = _write(out, "weights", head, [*parts, ("Learnt", learnt, factors)])
    write_text(out / "weights.csv", to_csv(columns, found["rows"]))
    figures.draw_learning(out / "weights.png", found)
    return [*files, out / "weights.png"]
