"""Experiments on small made-up problems: variants, perturbations, rows."""

import csv
import dataclasses
import json
import math
import shutil
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from matplotlib.figure import Figure

import bodyslam_jax.graph as g
from bodyslam_jax import cli, experiments, motion, simulation, solver
from bodyslam_jax.config import Config, Experiment
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.experiments import (
    ablation,
    figures,
    paper,
    plans,
    reports,
    tables,
)
from bodyslam_jax.experiments.ablation import shake
from bodyslam_jax.experiments.jobs import Journal
from bodyslam_jax.experiments.plans import PLANS
from bodyslam_jax.experiments.scenario import (
    NAMES,
    PLAUSIBILITY_FIGURES,
    simulations,
)

SHORT = (solver.Stage(("scale", "roots"), max_steps=8),)
"""Postures held: compiled in a few seconds."""


@pytest.fixture(scope="module")
def scene():
    """Twelve frames of one person, a start that is off, and the truth."""
    rng = np.random.default_rng(5)
    truth = scenes.truth(rng, frames=12, people=1, landmarks=30)
    factors = [scenes.reprojection(rng, truth), *scenes.person_factors(rng, truth)]
    problem = g.make_problem(factors, truth)
    return problem, truth, scenes.perturb(rng, problem, truth)


@pytest.mark.slow
def test_mapped_perturbations_are_single_solves(scene):
    problem, truth, start = scene
    held, bare = experiments.without_map(problem, start, hold_cameras=True)
    assert "cameras" not in held.variables and "landmarks" not in held.variables
    factors = jnp.array([0.5, 1.0, 3.0])
    traced = jax.jit(
        jax.vmap(
            lambda f: solver.trace(
                *g.rescaled(held, bare, f), lambda y: y.scale, schedule=SHORT
            )
        )
    )
    states, seen = traced(factors)
    assert seen.shape == (3, 9)
    np.testing.assert_array_equal(seen[:, 0], bare.scale)
    np.testing.assert_array_equal(seen[:, -1], states.scale)
    single = solver.solve(*g.rescaled(held, bare, 3.0), schedule=SHORT)
    # The same arithmetic in another order, eight steps long.
    np.testing.assert_allclose(states.scale[2], single.state.scale, rtol=1e-6)
    np.testing.assert_allclose(states.roots[2], single.state.roots, atol=1e-6)
    # Cameras have not moved, and a map of thrice the size has a third of the scale.
    np.testing.assert_array_equal(
        states.cameras[2, :, :3, 3], 3.0 * bare.cameras[:, :3, 3]
    )
    np.testing.assert_allclose(states.scale[2] * 3, states.scale[1], rtol=2e-2)


@pytest.mark.slow
def test_variants_leave_out_and_add_what_they_say(scene):
    problem, _, start = scene
    predictor = g.MotionPredictor(
        lambda *a: None, None, scenes.body_model(), jnp.ones((1, 12), bool)
    )
    problem = g.make_problem(problem.factors, start, motion=predictor)
    full = problem.cost_by_term(start, held=True)
    for name in ("no keypoints", "no motion model", "no regressed postures"):
        found = experiments.VARIANTS[name](problem, start)[0].cost_by_term(
            start, held=True
        )
        off = {k for k, v in found.items() if v != full[k]}
        assert len(off) == 1 and float(found[off.pop()]) == 0, name
    prior = scenes.landmark_prior(np.random.default_rng(6), start, problem.factors[0])
    also = g.make_problem([*problem.factors, prior], start, motion=predictor)
    blind, _ = experiments.VARIANTS["no landmarks"](also, start)
    found = blind.cost_by_term(start, held=True)
    assert found["landmarks"] == found["landmark_prior"] == 0
    assert not blind.free.landmarks.any() and blind.free.cameras.any()
    apart, _ = experiments.VARIANTS["no places seen again"](also, start)
    assert apart.cost_by_term(start, held=True) == {
        **also.cost_by_term(start, held=True),
        "landmark_prior": 0,
    }
    # Nothing of the kind is there to be left out.
    for name in ("no places seen again", "no ground", "no smooth path"):
        assert experiments.VARIANTS[name](problem, start)[0] is problem
    still, _ = experiments.VARIANTS["nothing that sees scale"](problem, start)
    assert not still.free.scale.any() and still.free.poses.all()
    held, state = experiments.VARIANTS["β held at the regressor's"](problem, start)
    assert not held.free.shapes.any() and held.free.poses.all()
    (said,) = (factor for factor in problem.factors if isinstance(factor, g.ShapePrior))
    regressed = said.shape[0][np.isfinite(np.asarray(said.sigma)[0]).all(axis=-1)]
    assert not np.allclose(start.shapes[0], regressed.mean(axis=0))
    np.testing.assert_allclose(state.shapes[0], regressed.mean(axis=0))


@pytest.mark.slow
def test_shaking_keeps_what_holds_the_map(scene):
    problem, _, start = scene
    shaken = shake(start, problem.free, jax.random.key(0), shift=0.1, turn=0.01)
    moved = float(start.scale) * (shaken.cameras - start.cameras)[:, :3, 3]
    assert 0.05 < np.abs(moved).max() <= 0.1
    np.testing.assert_array_equal(shaken.cameras[0], start.cameras[0])
    held = np.asarray(problem.free.cameras[1:, 3:]) == 0
    assert held.any() and not np.asarray(moved)[1:][held].any()


def test_rows_are_computed_once(tmp_path):
    journal = Journal(tmp_path / "rows")
    calls = []

    def compute():
        calls.append(1)
        return {"a": np.float64(1.5), "b": math.nan, "c": np.arange(2), "s": "text"}

    row = journal.row("table1", "M2-room", (1, "x"), compute)
    assert row == {"a": 1.5, "b": None, "c": [0, 1], "s": "text"}
    assert journal.row("table1", "M2-room", (1, "x"), compute) == row
    assert len(calls) == journal.computed == 1
    journal.row("table1", "M2-room", (2, "x"), compute)
    journal.row("table1", "no β", (1, "x"), compute)
    assert len(calls) == 3
    journal.path("table1", "M2-room", 1, "x").write_text("{")
    journal.row("table1", "M2-room", (1, "x"), compute)
    assert len(calls) == 4


def test_tables_as_text():
    columns = [
        tables.Column("sequence", "sequence"),
        tables.Column("error, mm", "error", 1e3),
        tables.Column("|1 - s|", "scale", digits=3),
        tables.Column("status", "status"),
    ]
    rows = [
        {"sequence": "E1", "error": 0.0443, "scale": 0.94, "status": "converged"},
        {"sequence": "E2", "error": 0.0508, "scale": None, "status": "converged"},
    ]
    assert tables.markdown(columns, rows, mean=True).splitlines() == [
        r"| sequence | error, mm | \|1 - s\| | status |",
        "| --- | --- | --- | --- |",
        "| E1 | 44.3 | 0.940 | converged |",
        "| E2 | 50.8 | – | converged |",
        "| **mean** | 47.5 |  |  |",
    ]
    lines = tables.to_csv(columns, rows).splitlines()
    assert lines[1].split(",") == ["E1", "44.3", "0.94", "converged"]
    told = tables.to_csv(columns, rows, "seed 3").splitlines()
    assert told[0].endswith(",data") and told[2].endswith(",converged,seed 3")


def test_papers_figures_are_the_papers():
    row = paper.table1_row("M3")
    assert row["no_mm/c_ate_se3"] == pytest.approx(0.3921)
    assert row["full/j_ate_sim3"] == pytest.approx(0.1719)
    assert row["no_mm/scale"] == 0.354 and row["full/scale"] == 0.985
    mean = np.mean([paper.table1_row(s)["full/c_ate_se3"] for s in paper.TABLE1])
    assert mean == pytest.approx(0.0837, abs=1e-4)  # what the issue quotes
    third = np.array(list(paper.STRUCTURE.values())).mean(axis=0)
    np.testing.assert_allclose(third[2:], [158.662, 155.572], atol=1e-3)


def test_choice_of_sequences():
    found = simulations(Experiment(family="both", frames=50), ("E2", "D1"), ("room",))
    assert [(s.sequence, s.family) for s in found] == [
        ("E2", "room"),
        ("D1", "room"),
        ("E2", "follow"),
        ("D1", "follow"),
    ]
    assert {s.length for s in found} == {50}
    one = simulations(Experiment(sequences=("M4", "M4")), ("E2",), ("room", "follow"))
    assert [(s.sequence, s.family) for s in one] == [("M4", "room"), ("M4", "follow")]


def test_sequences_of_one_seed_are_not_copies_of_one_another():
    on = Experiment(seed=1, frames=2)
    settings = simulations(on, ("E1", "M1"), ("room", "follow"))
    shapes = [simulation.simulate(s).person.shape for s in settings]
    for i, shape in enumerate(shapes):
        assert all(np.abs(shape - other).max() > 0.1 for other in shapes[:i])
    assert simulations(on, ("E1", "M1"), ("room", "follow")) == settings
    others = simulations(Experiment(seed=2, frames=2), ("E1",), ("room",))
    assert others[0].seed != settings[0].seed
    assert simulations(Experiment(), ("E1",), ("room",))[0].seed is None


def test_seed_goes_for_what_is_shaken_too(tmp_path, monkeypatch):
    seeds = []

    def by_sequence(*given):
        (compute,) = (x for x in given if callable(x))
        seeds.append(compute.keywords["seed"])
        return []

    monkeypatch.setattr(plans, "by_sequence", by_sequence)
    for seed in (None, 3):
        PLANS["landmarks"](Experiment(seed=seed), Config(), tmp_path)
    assert seeds == [0, 3]


def test_rows_follow_what_files_hold(tmp_path):
    """A motion model that was trained anew gives other rows."""
    file = tmp_path / "walk.npz"
    on, config = Experiment(motion=str(file)), Config(motion_model=str(file))
    paths = set()
    for content in (b"one", b"two"):
        file.write_bytes(content)
        for name in ("table1", "motion"):
            for job in PLANS[name](on, config, tmp_path).jobs:
                paths.add(Journal(tmp_path).path(name, job.label, *job.key))
    assert len(paths) == 2 * (20 + 1)


def test_missing_files_are_told_before_anything_is_computed(tmp_path):
    gone = str(tmp_path / "gone.npz")
    for on, config in (
        (Experiment(motion_models=(gone,)), Config()),
        (Experiment(motion=gone), Config()),
        (Experiment(), Config(motion_model=gone)),
    ):
        with pytest.raises(InputError, match="gone.npz: no such"):
            experiments.run_experiment("ablation", tmp_path / "out", on, config)
    (tmp_path / "bad.npz").write_bytes(b"")
    bad = Experiment(motion_models=(str(tmp_path / "bad.npz"),))
    with pytest.raises(ValueError, match="bad.npz: not a motion model"):
        experiments.run_experiment("ablation", tmp_path / "out", bad)
    assert not (tmp_path / "out").exists()


def test_unknown_experiment_and_folder(tmp_path):
    with pytest.raises(ValueError, match="nosuch.*table1"):
        experiments.run_experiment("nosuch", tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match="cannot be written"):
        experiments.run_experiment("motion", tmp_path / "file" / "out")


def _made_up(label):
    """A row as `compare_methods` gives it, of no real sequence."""
    row = {"sequence": label, "frames": 300, "radius": 0.5, "registered": 1.0}
    row |= {"start_ratio": 1.1, "start_sigma": 0.1, "scale_ratio": 1.25, "steps": 40}
    row |= {"status": "converged", "seconds": 9.0}
    for method in experiments.METHODS:
        row |= {f"{method}/{name}": 0.0125 for name in NAMES} | {f"{method}/scale": 0.8}
    row |= {f"full/{name}": 0.5 for name in PLAUSIBILITY_FIGURES}
    circle = np.array([[0.0, 1.0], [1.0, 0.0], [0.0, -1.0]]).tolist()
    names = ("truth", "no_mm", "full")
    paths = {f"{k}/{n}": circle for k in ("camera", "human") for n in names}
    return {**row, "paths": paths}


def _run(monkeypatch, argv):
    monkeypatch.setattr(sys, "argv", ["bodyslam", "experiment", *argv])
    monkeypatch.setattr("bodyslam_jax.cli.jax_setup.prepare", lambda device: None)
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    return stopped.value.code


def test_command_takes_finished_rows(tmp_path, monkeypatch, capsys, caplog):
    on = Experiment(sequences=("E1", "M2"), family="room", frames=300)
    plan = PLANS["table1"](on, Config().for_simulated_people(), tmp_path / "stages")
    journal = Journal(tmp_path / "rows")
    for job in plan.jobs:
        journal.row("table1", job.label, job.key, lambda j=job: _made_up(j.label))
    argv = "table1 --sequences E1 M2 --family room --frames 300 --out".split()
    caplog.set_level("INFO")
    assert not _run(monkeypatch, [*argv, str(tmp_path)])
    assert "2 rows, 2 of them done; about 0 min" in caplog.text
    assert not (tmp_path / "stages").exists()
    written = capsys.readouterr().out.split()
    names = ["table1.md", "table1.csv", "table1.png", "table1_paths.png"]
    assert [p.rsplit("/", 1)[1] for p in written] == names
    text = (tmp_path / "table1.md").read_text()
    assert "Simulated sequences" in text and "other data" in text
    # Ours in mm, the paper's beside each of them.
    theirs = [108.1, 44.3, 114.0, 56.3, 154.8, 118.8]
    both = "".join(f" 12.5 | {x} |" for x in theirs) + " 0.800 | 0.671 | 0.800 | 0.940"
    assert text.count(f"| E1-room |{both} |") == 1
    first, _ = csv.DictReader((tmp_path / "table1.csv").read_text().splitlines())
    assert first["the paper's J-ATE Sim(3) full, mm"] == "115.9"
    for words in ("Simulated", "noise level `real`", "300 frames each"):
        assert words in first["data"]
    for method in ("depth", "start", "scale_only", "per_frame", "published"):
        assert first[f"H-ATE Sim(3) {method}, mm"] == "12.5"
        assert first[f"scale {method}"] == "0.8"
    (tmp_path / "table1.md").unlink()
    code = _run(monkeypatch, ["nosuch", "--out", str(tmp_path)])
    assert code == 2 and not (tmp_path / "table1.md").exists()


@pytest.fixture
def made_up(monkeypatch):
    """Two sequences of `table1`, computed at once: their settings, and which were."""
    real, computed, lifters = PLANS["table1"], [], []

    def plan(*given):
        lifters.append(given[1].people_fit.lifter)
        found = real(*given)

        def compute(job):
            computed.append(job.label)
            return _made_up(job.label)

        jobs = [
            dataclasses.replace(job, compute=lambda j=job: compute(j))
            for job in found.jobs
        ]
        return dataclasses.replace(found, jobs=jobs)

    monkeypatch.setitem(PLANS, "table1", plan)
    yield Experiment(sequences=("E1", "M2"), family="room", frames=300), computed
    # Simulated people are never estimated by a network that has learnt from them.
    assert set(lifters) == {"held-out"}


@pytest.fixture
def undrawn(monkeypatch):
    """Pictures take longer than all else."""
    for name in ("draw_table", "draw_paths"):
        monkeypatch.setattr(figures, name, lambda *given: None)


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("text", ["null", "[]", '{"a": '])
def test_files_that_are_no_rows_are_computed_again(tmp_path, made_up, caplog, text):
    on, computed = made_up
    experiments.run_experiment("table1", tmp_path, on)
    (file,) = (tmp_path / "rows").glob("table1-E1*")
    whole = file.read_text()
    file.write_text(text)
    computed.clear()
    caplog.set_level("INFO")
    experiments.run_experiment("table1", tmp_path, on)
    assert computed == ["E1-room"] and file.read_text() == whole
    assert "2 rows, 1 of them done" in caplog.text
    (warning,) = (r.getMessage() for r in caplog.records if r.levelname == "WARNING")
    assert warning == f"{file}: not a row as expected; computed again"


def test_what_is_not_finite_stays_missing(tmp_path, made_up):
    on, computed = made_up
    experiments.run_experiment("table1", tmp_path, on)
    for file in (tmp_path / "rows").glob("table1-E1*"):
        row = json.loads(file.read_text())
        row |= {"full/scale": None, "scale_ratio": None, "full/c_ate_se3": None}
        file.write_text(json.dumps(row))
    experiments.run_experiment("table1", tmp_path, on)
    assert len(computed) == 2
    first, second = csv.DictReader((tmp_path / "table1.csv").read_text().splitlines())
    for name in ("|1 − s|", "C-ATE SE(3), % of it", "scale full"):
        assert not first[name] and second[name], name


@pytest.mark.usefixtures("undrawn")
def test_tables_say_what_is_not_as_by_default(tmp_path, made_up, monkeypatch):
    named = lambda setting: setting and Path(setting)
    monkeypatch.setattr(reports, "body_model_file", named)
    plain = reports.about(Experiment(), Config())
    assert plain == (
        "Simulated sequences, noise level `real`, lifting network `everybody`."
    )
    weights = dataclasses.replace(Config().weights, pixel_sigma=2.0)
    config = Config(weights=weights, motion_model="m.npz", body_model="b.npz")
    assert reports.about(Experiment(motion="walk.npz"), config) == (
        f"{plain} Not as by default: motion of `walk.npz`; `body_model` b.npz; "
        "`motion_model` m.npz; `weights.pixel_sigma` 2.0."
    )
    paper = dataclasses.replace(Config.paper(), motion_coupling="refreshed")
    told = "Not as by default: preset `paper`; `motion_coupling` refreshed."
    assert reports.deviations(Experiment(), paper) == told
    on, _ = made_up
    for seed in (3, 4):
        again = dataclasses.replace(on, seed=seed)
        experiments.run_experiment("table1", tmp_path, again)
        text = (tmp_path / "table1.md").read_text()
        assert "noise level `real`, lifting network `held-out`." in text
        assert f"Not as by default: seed {seed}; 300 frames each. Ours:" in text


@pytest.mark.parametrize("frames", [0, 1, -3])
def test_too_few_frames_are_refused(tmp_path, frames):
    on = Experiment(sequences=("E1",), frames=frames)
    with pytest.raises(ValueError, match=f"--frames {frames}: .* 2 frames or more"):
        experiments.run_experiment("table1", tmp_path / "out", on)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["motion", "table1"])
def test_file_without_motion_is_refused(tmp_path, name):
    file = tmp_path / "tracks.npz"
    np.savez(file, frame=np.arange(3))
    with pytest.raises(ValueError, match="tracks.npz: no motion.*expected.*AMASS"):
        experiments.run_experiment(name, tmp_path / "out", Experiment(motion=str(file)))
    assert not (tmp_path / "out").exists()


def test_axes_of_figures(tmp_path):
    assert figures.log_limits_mm([5.0, np.nan, 80.0]) == (1.0, 120.0)
    assert figures.log_limits_mm([0.03, 2.0]) == pytest.approx((0.01, 10.0))
    assert figures.log_limits_mm([np.nan, 0.0]) == (1.0, 10.0)
    axis = Figure().subplots()
    figures.draw_ratios(axis, np.arange(3), np.array([0.98, 7.3, np.nan]))
    assert axis.get_xlim() == pytest.approx((0.945, 1.055))
    assert [text.get_text() for text in axis.texts] == ["7.30"]


def test_reports_of_made_up_rows(tmp_path):
    p = [5.0, 0.1]
    curve = [[0.9, 0.1], [2.0, 0.1]]
    row = {"sequence": "M2-room", "perturbation": p, "scale": [5.1, 0.102]}
    row |= {"deviation": [0.02, 0.02], "spread": 1e-5}
    row |= {"history": [[1.0, 5.1], [1.0, 0.102]], "h_ate": curve}
    reports.write_scale(tmp_path, [row], about="Simulated.")
    text = (tmp_path / "scale.md").read_text()
    assert "| M2-room | 5.0 | 5.1000 | 2.00 | 900.0 | 100.0 | 3.673 | 26.5 |" in text
    # Six perturbations have no mean, nor have the answers to them.
    assert "| **mean** |  |  | 2.00 | 1450.0 | 100.0 |  |" in text

    row = {"sequence": "E2-room", "status": "converged", "status_no_landmarks": "-"}
    stages = ("original", "start", "perturbed", "no_landmarks", "landmarks")
    row |= {name: 0.1 for name in stages} | {f"{n}/scale": 1.0 for n in stages}
    reports.write_structure(tmp_path, [row], about="Simulated.")
    text = (tmp_path / "landmarks.md").read_text()
    both = "100.0 | 193.0 | 100.0 | 100.0 | 213.1 | 100.0 | 139.7 | 100.0 | 138.5"
    assert f"| E2-room | {both} |" in text
    assert "193.0" in (tmp_path / "landmarks.csv").read_text()

    row = {"sequence": "M2-room", "label": "no keypoints", "status": "converged"}
    row |= {name: 0.02 for name in NAMES} | {"scale_ratio": None, "cost": 12.0}
    short = {"sequence": "M2-room", "label": "no ground", "status": "no such term"}
    more = {**row, "label": "motion model short", "past": 2.0}
    rows = [row, short, more]
    (*_, picture) = reports.write_ablation(tmp_path, rows, about="Simulated.")
    assert picture.name == "ablation_M2-room.png" and picture.stat().st_size > 0
    text = (tmp_path / "ablation.md").read_text()
    assert "| no keypoints | 20.0 | 20.0 | 20.0 | 20.0 | – | – | – |" in text
    assert "| motion model short | 20.0 | 20.0 | 20.0 | 20.0 | – | – | 2 |" in text
    assert "| no ground |" + 10 * " – |" + " no such term |" in text
    assert "mean" not in text.split("M2-room")[1]


@pytest.mark.slow
def test_command_with_a_subset_resumes(tmp_path, monkeypatch, caplog):
    argv = "table1 --sequences M1 --family follow --frames 40 --noise low --out"
    argv = [*argv.split(), str(tmp_path)]
    caplog.set_level("INFO")
    assert not _run(monkeypatch, argv)
    assert "1 rows, 0 of them done" in caplog.text
    (row,) = (json.loads(p.read_text()) for p in (tmp_path / "rows").glob("*.json"))
    assert row["full/scale"] == pytest.approx(1, abs=0.2)
    assert row["full/j_ate_se3"] < row["per_frame/j_ate_se3"]
    for name in ("table1.md", "table1.csv", "table1.png", "table1_paths.png"):
        assert (tmp_path / name).stat().st_size > 0
    assert "| M1-follow |" in (tmp_path / "table1.md").read_text()
    (cells,) = csv.DictReader((tmp_path / "table1.csv").read_text().splitlines())
    assert all(cells.values())
    assert 0.7 < row["depth/scale"] < 1.5  # what is seen at the feet is about as far
    caplog.clear()
    assert not _run(monkeypatch, argv)
    assert "1 rows, 1 of them done" in caplog.text
    assert "taken from an earlier run" in caplog.text
    assert "joint: cost" not in caplog.text


@pytest.fixture
def few(tmp_path, monkeypatch):
    """Less of everything that is many times the same; a motion model of one's own."""
    names = ("full", "no landmarks", "no places seen again")
    chosen = {name: experiments.VARIANTS[name] for name in names}
    monkeypatch.setattr(plans, "VARIANTS", chosen)
    name = "errors of frames independent"
    monkeypatch.setattr(ablation, "SETTINGS", {name: ablation.SETTINGS[name]})
    monkeypatch.setattr(plans, "NOISE_LEVELS", ("low",))
    file = tmp_path / "own.npz"
    shutil.copy(Path(motion.__file__).parent / "assets" / "default.npz", file)
    return str(file)


@pytest.mark.slow
def test_every_plan_on_forty_frames(tmp_path, few, caplog):
    """Each row is computed, has all that its report says, and is kept."""
    caplog.set_level("INFO")

    settings = Experiment(
        sequences=("E2",),  # one of the paper's for `landmarks`
        family="follow",
        frames=40,
        noise="low",
        motion_models=(few,),
    )
    rows = {}
    for name in ("scale", "landmarks", "motion", "ablation"):
        experiments.run_experiment(name, tmp_path, settings)
        jobs = PLANS[name](
            settings, Config().for_simulated_people(), tmp_path / "stages"
        ).jobs
        journal = Journal(tmp_path / "rows")
        paths = [journal.path(name, job.label, *job.key) for job in jobs]
        rows[name] = [json.loads(path.read_text()) for path in paths]
        table = (tmp_path / f"{name}.csv").read_text().splitlines()
        for column, *cells in zip(*csv.reader(table), strict=True):
            assert any(cells), (name, column)
        assert (tmp_path / f"{name}.md").stat().st_size > 0
        caplog.clear()
        experiments.run_experiment(name, tmp_path, settings)
        assert f"{len(jobs)} rows, {len(jobs)} of them done" in caplog.text

    (scale,) = rows["scale"]
    assert scale["perturbation"] == list(experiments.PERTURBATIONS)
    assert scale["spread"] < 0.02 and np.abs(scale["deviation"]).max() < 0.15

    (shaken,) = rows["landmarks"]
    assert shaken["landmarks"] < 0.01 < 0.05 < shaken["perturbed"]

    ablated = {row["label"]: row for row in rows["ablation"]}
    full, own = ablated["full"], ablated["motion model own"]
    assert own["past"] == full["past"] == motion.load_motion_model(few).past
    assert own["j_ate_se3"] == pytest.approx(full["j_ate_se3"], rel=1e-3)
    assert full["c_ate_se3"] < 0.01 < ablated["no landmarks"]["c_ate_se3"]
    known = {"converged", "no such term"}
    solved = [row for name, row in ablated.items() if name != ablation.PUBLISHED]
    assert {row["status"] for row in solved} <= known
