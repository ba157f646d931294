"""A batch: what is run, what is left out, what is said of failures."""

import csv
import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import batch_stubs
import pytest

from bodyslam_jax import batch, simulation
from bodyslam_jax.batch import Failure, failures, find_inputs, grid, run_many
from bodyslam_jax.batch.engine import attempt
from bodyslam_jax.batch.inputs import shard
from bodyslam_jax.config import (
    Config,
    Distribution,
    Experiment,
    Simulation,
    with_options,
)
from bodyslam_jax.experiments.jobs import Job, Plan
from bodyslam_jax.experiments.plans import PLANS, run_experiment


class InProcess:
    """An engine without processes; the items named in `lost` are lost."""

    def __init__(self, lost=()):
        self.lost, self.items = lost, []

    def map(self, function, items, setup):
        for item in items:
            self.items.append(item.name)
            lost = item.name in self.lost
            yield item, Failure("its node was lost.") if lost else function(item)


@pytest.fixture
def clips(tmp_path):
    folder = tmp_path / "clips"
    folder.mkdir()
    contents = {"a": "good", "b": "bad", "c": "doubtful", "d": "good"}
    for name, content in contents.items():
        (folder / f"{name}.mp4").write_text(content)
    return folder


def run(clips, out, config=Config(), engine=None, **more):
    """Outcomes by name, and the names that went to the engine."""
    engine = engine or InProcess()
    outcomes = run_many(
        clips, config, engine, out=out, estimate=batch_stubs.estimate, **more
    )
    return {one.name: one for one in outcomes}, engine.items


def test_a_batch_runs_every_clip_and_lists_failures(clips, tmp_path):
    out = tmp_path / "out"
    found, ran = run(clips, out)
    assert ran == ["a", "b", "c", "d"]
    statuses = {name: outcome.status for name, outcome in found.items()}
    assert statuses == {"a": "ok", "b": "error", "c": "doubtful", "d": "ok"}
    assert found["c"].message == "feet slide." and not found["c"].is_failure
    (line,) = failures.read(out)
    assert line["name"] == "b" and line["message"].endswith("b.mp4: no frames in it.")
    assert "Traceback" in (out / line["log"]).read_text()
    assert not (out / "runs" / "b").exists()


def test_only_what_changed_is_run_again(clips, tmp_path):
    out = tmp_path / "out"
    run(clips, out)
    found, ran = run(clips, out)
    assert ran == ["b"] and found["a"].was_finished and found["c"].status == "doubtful"
    # New dates and the same content: looked at, and not run.
    (clips / "a.mp4").write_text("good")
    found, ran = run(clips, out)
    assert ran == ["a", "b"] and found["a"].was_finished
    # Another content, of a clip that failed and of one that did not.
    (clips / "b.mp4").write_text("good")
    (clips / "d.mp4").write_text("doubtful")
    found, ran = run(clips, out)
    assert ran == ["b", "d"] and found["d"].status == "doubtful"
    assert not failures.read(out)
    # Other settings.
    found, ran = run(clips, out, Config(fps=25.0))
    assert ran == ["a", "b", "c", "d"] and not found["a"].was_finished
    # A run that is not as the batch left it.
    (out / "runs" / "a" / "summary.json").write_text("{}")
    assert run(clips, out, Config(fps=25.0))[1] == ["a"]
    # Another version of the package.
    assert run(clips, out, Config(fps=25.0))[1] == []


BATCH_FILES = ("failed.jsonl", "batch.json", "table.csv", "table.md", "index.html")
BATCH_FILES += ("plots.png", "logs", "thumbnails", "runs", "table.tex", "a.mp4")


def test_clips_may_have_the_names_of_the_files_of_a_batch(clips, tmp_path, command):
    out = tmp_path / "out"
    lines = [f"{name},{clips / 'a.mp4'}" for name in BATCH_FILES]
    (tmp_path / "clips.csv").write_text("\n".join(["name,video", *lines]))
    found, _ = run(tmp_path / "clips.csv", out)
    assert {one.status for one in found.values()} == {"ok"}
    assert run(tmp_path / "clips.csv", out)[1] == []
    code, text = command("collect", out)
    assert code == 0, text
    with (out / "table.csv").open() as file:
        assert {row["clip"] for row in csv.DictReader(file)} == set(BATCH_FILES)
    assert (out / "runs" / "table.csv" / "summary.json").is_file()
    assert run(tmp_path / "clips.csv", out)[1] == []


@pytest.mark.parametrize("name", ["../x", "a/b", "", ".x", "a\n", "x" * 200])
def test_names_that_lead_out_of_the_batch_are_refused(clips, tmp_path, name):
    one = batch.Input(name, clips / "a.mp4")
    with pytest.raises(ValueError, match="name: "):
        run([one], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_batch_of_before_is_continued(clips, tmp_path):
    """Its run folders were beside its own files."""
    out = tmp_path / "out"
    run(clips, out)
    for name in ("a", "c", "d"):
        (out / "runs" / name).rename(out / name)
    (out / "runs").rmdir()
    batch.collect(out)
    with (out / "table.csv").open() as file:
        rows = {row["clip"]: row["status"] for row in csv.DictReader(file)}
    assert rows == {"a": "ok", "b": "error", "c": "doubtful", "d": "ok"}
    assert run(clips, out)[1] == ["b"]
    assert (out / "runs" / "a").is_dir() and not (out / "a").exists()


DAMAGE = {
    "empty": b"",
    "not JSON": b"{",
    "not text": b"\xff\xfe\xfd",
    "deep": b"[" * 100_000,
    "long number": b'{"status": ' + b"9" * 5000 + b"}",
    "list": b"[1, 2]",
    "number": b"3",
    "wrong types": b'{"status": {}, "message": [], "source": 1, "settings": [[]]}',
    "people of no kind": b'{"status": "ok", "people": [3]}',
    "frames of no kind": b'{"status": "ok", "input": {"frames": [], "fps": {}}}',
    "huge": b'{"status": "ok", "input": {"frames": 1e308, "fps": 1e-308}}',
    "reasons of no kind": b'{"status": "ok", "reasons": {"a": 1}}',
    "durations of no kind": b'{"status": "ok", "durations_s": {"a": "b"}}',
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_record_stops_no_other_clip(clips, tmp_path, damage, caplog, command):
    out = tmp_path / "out"
    run(clips, out)
    content, record = DAMAGE[damage], out / "runs" / "a" / ".job.json"
    record.write_bytes(content)
    assert run(clips, out)[1] == ["a", "b"]
    # A record that fits its summary, and is none otherwise.
    summary = out / "runs" / "a" / "summary.json"
    mark = hashlib.sha256(summary.read_bytes()).hexdigest()[:16]
    record.write_text(json.dumps({"summary": mark, "status": ["ok"]}))
    assert run(clips, out)[1] == ["a", "b"]
    summary.write_bytes(content)
    (out / "failed.jsonl").write_bytes(content + b"\n")
    (out / "batch.json").write_bytes(content)
    caplog.clear()
    code, text = command("collect", out)
    assert code == 0, text
    with (out / "table.csv").open() as file:
        rows = {row["clip"]: row["status"] for row in csv.DictReader(file)}
    assert rows == {"c": "doubtful", "d": "ok"}
    assert any(str(summary) in line for line in caplog.messages), caplog.messages
    assert all("\n" not in line for line in caplog.messages)
    assert run(clips, out)[1] == ["a", "b"]


def test_what_is_no_file_is_no_record(clips, tmp_path):
    out = tmp_path / "out"
    run(clips, out)
    (out / "runs" / "p").mkdir()
    os.mkfifo(out / "runs" / "p" / "summary.json")
    (out / "runs" / "q" / "summary.json").mkdir(parents=True)
    (out / "runs" / "d" / "overlay.webm").write_bytes(b"no film")
    assert len(batch.collect(out)) == 5
    (out / "runs" / "a" / "summary.json").unlink()
    os.mkfifo(out / "runs" / "a" / "summary.json")
    assert run(clips, out)[1] == ["a", "b"]


NAMES = ("=1+1", "@SUM(1+1)*cmd", "-2+3+cmd|' -C calc'!A0", "+1+2", "\t=1", "\r=1")
NAMES += ("<img src=x onerror=alert(1)>", "a|b", "x\ny", "[a](https://x.example)")
NAMES += ("`a`", "<!--ROWS-->", "\uff1d1+1", " =1", "$x$", "[5mm]", "https://x.example")


def test_text_of_others_is_text_in_every_table(tmp_path):
    for name in NAMES:
        folder = tmp_path / name.replace("/", "_")
        folder.mkdir()
        summary = _summary("=1+1", name) | {"camera_motion": name}
        summary["reasons"] = [{"message": name}]
        (folder / "summary.json").write_text(json.dumps(summary))
    batch.collect(tmp_path)
    with (tmp_path / "table.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    assert len(rows) == len(NAMES) + 1 and {len(row) for row in rows} == {len(rows[0])}
    cells = [cell for row in rows for cell in row]
    assert not [c for c in cells if c.strip()[:1] in "=+-@\uff1d" and c.strip()]
    assert "'=1+1" in cells and "2.0" in cells
    markdown = (tmp_path / "table.md").read_text()
    assert len(markdown.splitlines()) == len(NAMES) + 3  # head, rule, median
    plain = markdown.replace("\\\\", "").replace("\\|", "").replace("\\`", "")
    plain = plain.replace("\\[", "").replace("\\]", "")
    assert len({line.count("|") for line in plain.splitlines()}) == 1
    assert not set("<`[]") & set(plain) and "https://" not in plain
    page = (tmp_path / "index.html").read_text()
    assert "<img src=x" not in page and page.count("<tbody") == 1
    latex = (tmp_path / "table.tex").read_text()
    rows = latex.split("\\midrule\n")[1].splitlines()
    assert len(rows) == len(NAMES) and not [r for r in rows if r.startswith(("[", "*"))]


def test_a_run_folder_of_the_name_of_a_table_is_named(finished, command):
    (finished / "table.csv").mkdir()
    code, text = command("collect", finished)
    assert code == 1 and "table.csv: a folder of the name" in text


def test_rows_of_a_sweep_that_are_none_are_solved_again(clips, tmp_path):
    out, inputs = tmp_path / "sweep", [clips / "a.mp4"]
    axes = grid.parse_axes(["weights.human_motion=10,100", "scale=1,2"])
    given = inputs, axes, Config(), out
    batch.sweep(*given, Rows(), batch_stubs.nothing)
    (kept,) = (out / "rows").iterdir()
    rows = json.loads(kept.read_text())
    harm = [b"[" * 10_000, b"{}", b"[]", json.dumps(rows[:1]).encode(), b""]
    harm += [json.dumps([rows[0] | {"cost": {}}, *rows[1:]]).encode()]
    harm += [json.dumps([rows[0] | {"name": "x"}, *rows[1:]]).encode()]
    for content in harm:
        kept.write_bytes(content)
        engine = Rows()
        batch.sweep(*given, engine, batch_stubs.nothing)
        assert len(engine.labels) == 1 and json.loads(kept.read_text()) == rows
    engine = Rows()
    batch.sweep(*given, engine, batch_stubs.nothing)
    assert not engine.labels


def test_another_version_of_the_package_runs_all_again(clips, tmp_path, monkeypatch):
    out = tmp_path / "out"
    run(clips, out)
    monkeypatch.setattr("bodyslam_jax.batch.record.fingerprint", lambda *_: "other")
    batch.record.settings_hash.cache_clear()
    assert len(run(clips, out)[1]) == 4
    batch.record.settings_hash.cache_clear()


def test_a_clip_whose_process_was_lost_is_a_failure_and_is_run_next_time(
    clips, tmp_path
):
    out = tmp_path / "out"
    found, _ = run(clips, out, engine=InProcess(lost=("a",)))
    assert found["a"].status == "error" and "node was lost" in found["a"].message
    assert {line["name"] for line in failures.read(out)} == {"a", "b"}
    found, ran = run(clips, out)
    assert ran == ["a", "b"] and found["a"].status == "ok"
    assert {line["name"] for line in failures.read(out)} == {"b"}


def test_an_interrupted_batch_is_continued(clips, tmp_path):
    out = tmp_path / "out"
    outcomes = run_many(
        clips, engine=InProcess(), out=out, estimate=batch_stubs.estimate
    )
    assert next(outcomes).name == "a"
    outcomes.close()
    assert run(clips, out)[1] == ["b", "c", "d"]
    assert (out / "log").read_text().split() == ["a", "c", "d"]


def test_shards_are_all_clips_once(clips, tmp_path):
    out = tmp_path / "out"
    first, second = (run(clips, out, part=part)[1] for part in ("1/2", "2/2"))
    assert first == ["a", "c"] and second == ["b", "d"]
    inputs = find_inputs(clips)
    parts = [shard(inputs, f"{k}/3") for k in (1, 2, 3)]
    assert sorted(one.name for part in parts for one in part) == ["a", "b", "c", "d"]
    for wrong in ("0/2", "3/2", "1", "a/b", "1/0"):
        with pytest.raises(ValueError, match="expected I/N"):
            shard(inputs, wrong)


def test_two_drivers_of_one_folder_run_a_clip_once(tmp_path):
    clips, out = tmp_path / "clips", tmp_path / "out"
    clips.mkdir()
    (clips / "a.mp4").write_text("good")
    (job,) = batch.driver.plan(clips, Config(), out)
    from bodyslam_jax import export
    from bodyslam_jax.batch.job import run_job

    def held(job):
        """Another driver's process has it, and finishes it meanwhile."""
        if not (out / "log").exists():
            assert run_job(job, estimate=batch_stubs.estimate).status == "ok"
            raise export.FolderInUse(f"{job.out}: another process is writing this run.")
        raise AssertionError("run twice")

    outcome = run_job(job, estimate=held)
    assert outcome.was_finished and (out / "log").read_text().split() == ["a"]


def test_inputs_are_found_and_named(clips, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    (other / "a.mp4").write_text("good")
    sequence = other / "walk 1"
    (sequence / "images").mkdir(parents=True)
    finished = other / "run"
    finished.mkdir()
    for name in ("summary.json", "overlay.webm"):
        (finished / name).touch()
    (other / "notes.txt").touch()
    found = find_inputs([clips, other])
    names = ["clips-a", "b", "c", "d", "other-a", "walk_1"]
    assert [one.name for one in found] == names
    assert [one.name for one in find_inputs(str(clips / "[ab].mp4"))] == ["a", "b"]
    assert [one.name for one in find_inputs([sequence])] == ["walk_1"]
    twice = [one.name for one in find_inputs([clips / "a.mp4", clips / "a.mp4"])]
    assert twice == ["clips-a", "clips-a-2"]
    for wrong, message in (
        (tmp_path / "none", "no such file or folder"),
        (str(clips / "*.avi"), "matches no folder, video or manifest"),
        (finished, "no clip, nor a folder of clips"),
        ([], "no inputs"),
    ):
        with pytest.raises(ValueError, match=message):
            find_inputs(wrong)


def test_options_of_a_clip_are_those_of_the_command_line():
    changed = with_options(Config(), "--camera-path-metric --camera-path 'my path.txt'")
    assert changed.camera_path == "my path.txt" and changed.camera_path_metric
    assert (
        with_options(changed, "--camera-path none --no-camera-path-metric") == Config()
    )


def test_settings_of_engines_are_checked():
    slurm = Distribution(slurm=("mem_gb=8", "slurm_partition=gpu"))
    assert slurm.slurm_parameters() == {"mem_gb": 8, "slurm_partition": "gpu"}
    for wrong in ({"slurm": ("mem",)}, {"workers": 0}, {"retries": -1}):
        with pytest.raises(ValueError):
            Distribution(**wrong)


_COMPILE = """
import sys, time
from pathlib import Path
import jax, jax.numpy as jnp
from bodyslam_jax.batch import program_cache
folder = Path(sys.argv[1])
jax.config.update("jax_compilation_cache_dir", str(folder / "cache"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
program_cache.share()
count = program_cache.Compilations()
x = jnp.ones(8)
before = count.count
(folder / f"ready-{sys.argv[2]}").touch()
while len(list(folder.glob("ready-*"))) < 2:
    time.sleep(0.01)
def f(x):
    for k in range(60):
        x = jnp.sin(x) @ jnp.cos(jnp.outer(x, x + k))
    return x
jax.jit(f)(x)
print(count.count - before)
"""


@pytest.mark.slow
def test_processes_that_start_together_compile_a_program_once(tmp_path):
    start = [sys.executable, "-c", _COMPILE, tmp_path]
    processes = [
        subprocess.Popen([*start, str(k)], stdout=subprocess.PIPE, text=True)
        for k in range(2)
    ]
    printed = [process.communicate(timeout=300)[0] for process in processes]
    assert sorted(map(int, printed)) == [0, 1]
    assert not list((tmp_path / "cache").glob(".*.partial*"))


def test_a_program_that_nobody_stores_keeps_nobody_waiting(tmp_path):
    from bodyslam_jax.batch.program_cache import ProgramCache

    cache = ProgramCache(tmp_path)
    assert cache.get("jit_f-1") is None
    # Its compilation failed: the thread goes on with another program.
    assert cache.get("jit_g-2") is None
    start = time.monotonic()
    code = (
        "import sys; from bodyslam_jax.batch.program_cache import ProgramCache\n"
        f"cache = ProgramCache({str(tmp_path)!r})\n"
        "assert cache.get('jit_f-1') is None; cache.put('jit_f-1', b'program')\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert time.monotonic() - start < 60
    assert cache.get("jit_f-1") == b"program"


def _summary(status, name, **more):
    return {
        "status": status,
        "input": {"name": name, "frames": 60, "fps": 30.0},
        "reasons": [{"message": "feet | slide & more."}] if status != "ok" else [],
        "camera_motion": "moving",
        "camera_path_m": 2.5,
        "scale": {"value": 2.0, "sigma": 0.1},
        "people": [
            {"stature_m": 1.7, "stature_sigma_m": 0.03, "speed_m_s": 1.1, "frames": 60}
        ],
        "durations_s": {"joint": 3.0, "cameras": 2.0},
        **more,
    }


@pytest.fixture
def finished(tmp_path):
    errors = {
        "joint estimate, in metres": {"c_ate_se3": 0.05, "h_ate_se3": "no people"}
    }
    runs = {
        "a": _summary("ok", "a", errors=errors),
        "b<c>": _summary("doubtful", "b"),
        "d": _summary("ok", "d"),
    }
    for name, summary in runs.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "summary.json").write_text(json.dumps(summary))
        (tmp_path / name / "report.html").touch()
    line = {"name": "e", "status": "error", "message": "e.mp4: no frames."}
    (tmp_path / "failed.jsonl").write_text(json.dumps(line) + '\n{"name": "cut')
    clips = dict.fromkeys([*runs, "e", "f"], "clip.mp4")
    (tmp_path / "batch.json").write_text(json.dumps({"clips": clips}))
    (tmp_path / "strange").mkdir()
    (tmp_path / "strange" / "summary.json").write_text("[1, 2]")
    return tmp_path


def test_collect_makes_one_table_of_all(finished, command):
    code, text = command("collect", finished)
    assert code == 0
    names = ("table.csv", "table.md", "table.tex", "plots.png", "index.html")
    assert all(str(finished / name) in text for name in names)
    with (finished / "table.csv").open() as file:
        rows = {row["clip"]: row for row in csv.DictReader(file)}
    assert list(rows) == ["a", "b<c>", "d", "e", "f"]
    assert rows["a"]["C-ATE, SE(3), mm"] == "50.0" and rows["a"]["video, s"] == "2.0"
    assert float(rows["a"]["scale's standard error, %"]) == pytest.approx(5.0)
    assert (
        rows["e"]["status"] == "error" and rows["e"]["reasons"] == "e.mp4: no frames."
    )
    assert rows["f"]["status"] == "not run" and rows["f"]["frames"] == ""
    assert "H-ATE, SE(3), mm" not in rows["a"]
    markdown = (finished / "table.md").read_text()
    assert "feet \\| slide" in markdown and "**median**" in markdown
    latex = (finished / "table.tex").read_text()
    assert r"scale's standard error, \%" in latex and "feet" not in latex
    page = (finished / "index.html").read_text()
    assert 'href="a/report.html"' in page and "b&lt;c&gt;" in page
    assert (
        "<!--" not in page and "5 clips: 2 ok, 1 doubtful, 1 error, 1 not run" in page
    )


def test_collect_of_a_folder_without_runs_is_refused(tmp_path, command):
    code, text = command("collect", tmp_path)
    assert code == 1 and "no run folders in it" in text
    code, text = command("collect", Path(tmp_path, "none"))
    assert code == 1 and "no such folder" in text


class Rows:
    """An engine that has the rows of a sweep without computing them."""

    def __init__(self):
        self.labels = []

    def map(self, function, items, setup):
        for job in items:
            self.labels.append(job.label)
            if job.source.name == "b":
                yield job, Failure("ValueError: weights: no term 'ground'.")
                continue
            rows = []
            for point in job.points:
                cost = point["weights.human_motion"] * point["scale"]
                row = {"name": job.source.name, **job.setting, **point, "cost": cost}
                rows.append(row | {"status": "converged", "error.c_ate_se3": 0.01})
            yield job, rows


def test_a_sweep_is_one_table_over_its_axes_and_continues(clips, tmp_path):
    out, inputs = tmp_path / "sweep", [clips / "a.mp4", clips / "b.mp4"]
    texts = ["weights.human_motion=10,100", "scale=0.5,1,2", "weights.pixel-sigma=1,2"]
    axes = grid.parse_axes(texts)
    assert [axis.is_setting for axis in axes] == [False, False, True]
    for labels in (4, 2):  # the second time, what failed
        engine = Rows()
        paths, failed = batch.sweep(
            inputs, axes, Config(), out, engine, batch_stubs.nothing
        )
        assert len(engine.labels) == labels and len(failed) == 2
        assert "b weights.pixel_sigma=1: ValueError: weights: no term" in failed[0]
    with (out / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 3 * 2 and {row["clip"] for row in rows} == {"a"}
    assert {row["λ of human_motion"] for row in rows} == {"10.0", "100.0"}
    assert {row["weights.pixel_sigma"] for row in rows} == {"1", "2"}
    assert all(path.stat().st_size for path in paths)
    # Other settings are other rows.
    engine = Rows()
    batch.sweep(inputs[:1], axes, Config(fps=25.0), out, engine, batch_stubs.nothing)
    assert len(engine.labels) == 2


@pytest.mark.parametrize(
    "texts, message",
    [
        ([], "found none, expected NAME=VALUE"),
        (["scale"], "expected NAME=VALUE"),
        (["scale=0,1"], "found '0', expected a number above 0"),
        (["weights.human_motion=much"], "found 'much', expected a number above 0"),
        (["weights.pixel_sigma=x"], "found 'x', expected a number"),
        (["nosuch=1"], "no option --nosuch"),
        (["scale=1", "scale=2"], "given twice"),
    ],
)
def test_axes_that_cannot_be_are_refused(texts, message):
    with pytest.raises(ValueError, match=message):
        grid.parse_axes(texts)


def test_rows_of_an_experiment_are_computed_by_an_engine(tmp_path, monkeypatch):
    def plan(experiment, config, stages):
        def bad():
            raise ValueError("no motion.")

        compute = {"good": lambda: {"value": 3}, "bad": bad}
        jobs = [Job(name, (name,), 1.0, one) for name, one in compute.items()]
        return Plan(jobs, lambda out, rows: [out / f"{len(rows)} rows"])

    class Engine:
        def map(self, function, items, setup):
            for item in items:
                yield item, attempt(function, item)

    monkeypatch.setitem(PLANS, "table1", plan)
    given = Experiment(), Config(), Engine(), batch_stubs.nothing
    (written,) = run_experiment("table1", tmp_path, *given)
    assert written == tmp_path / "1 rows"
    assert len(list((tmp_path / "rows").glob("*.json"))) == 1


@pytest.mark.slow
def test_real_clips_a_good_and_a_bad_one(tmp_path):
    clips, out = tmp_path / "clips", tmp_path / "out"
    settings = Simulation(sequence="M1", family="follow", length=40)
    simulation.write_sequence(clips / "walk", simulation.simulate(settings))
    shutil.copytree(clips / "walk", clips / "cut")
    (clips / "cut" / "tracks.npz").write_bytes(b"PK cut off")

    class Here(InProcess):
        def map(self, function, items, setup):
            yield from ((item, function(item)) for item in items)

    config = Config(overlay=False, uncertainty=False)
    found = {o.name: o for o in run_many(clips, config, Here(), out=out)}
    assert found["walk"].status in ("ok", "doubtful")
    assert found["walk"].result().joints.shape[1] == 40
    assert found["cut"].status == "error" and "tracks.npz" in found["cut"].message
    batch.collect(out)
    with (out / "table.csv").open() as file:
        rows = {row["clip"]: row for row in csv.DictReader(file)}
    assert float(rows["walk"]["C-ATE, SE(3), mm"]) < 500
    assert rows["cut"]["status"] == "error"
    again = {o.name: o for o in run_many(clips, config, Here(), out=out)}
    assert again["walk"].was_finished and again["cut"].status == "error"
