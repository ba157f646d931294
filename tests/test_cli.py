import contextlib
import importlib.metadata
import inspect
import io
import json
import os
import re
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import tyro
from body_cases import make_raw, write

import bodyslam_jax
from bodyslam_jax import cli
from bodyslam_jax.cli import environment, estimate, folders, jax_setup
from bodyslam_jax.config import Config
from bodyslam_jax.export.summary import describe
from bodyslam_jax.types import Intrinsics, Sequence


def _run(monkeypatch, capsys, *argv):
    """The command in this process: exit code, standard output, standard error."""
    monkeypatch.setattr(sys, "argv", ["bodyslam", *map(str, argv)])
    monkeypatch.setattr("bodyslam_jax.cli.jax_setup.prepare", lambda device: None)
    with pytest.raises(SystemExit) as stopped:
        cli.main()
    out = capsys.readouterr()
    code = stopped.value.code
    if isinstance(code, str):
        return 1, out.out, code
    return code, out.out, out.err


def test_help_imports_no_jax():
    code = (
        "import sys; sys.argv = ['bodyslam', '--help']\n"
        "from bodyslam_jax import cli\n"
        "try:\n    cli.main()\nexcept SystemExit:\n    pass\n"
        "assert 'jax' not in sys.modules, 'jax was imported'"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)


def test_help_says_what_the_tool_does_and_its_commands(monkeypatch, capsys):
    code, out, _ = _run(monkeypatch, capsys, "--help")
    assert code == 0 and "in metres" in out and "bodyslam demo" in out
    for command in ("run", "demo", "evaluate", "body-model", "doctor"):
        assert f"\n  {command} " in out
    for command in cli.COMMANDS.values():
        first, *rest = inspect.getdoc(command.function).splitlines()
        assert not (rest and rest[0]), f"the list of commands has a part: {first}"
    code, out, _ = _run(monkeypatch, capsys, "body-model", "--help")
    assert code == 0 and "SMPL" in out and "\n  convert " in out
    assert _run(monkeypatch, capsys)[0] == 2


def test_version(monkeypatch, capsys):
    code, out, _ = _run(monkeypatch, capsys, "--version")
    assert code == 0 and out == f"bodyslam {bodyslam_jax.__version__}\n"


_FACTS = """height focal fov camera camera-path camera-path-metric static-camera gravity
fps start end person device""".split()


def test_help_shows_what_a_newcomer_needs_and_help_all_the_rest(monkeypatch, capsys):
    for command in cli.COMMANDS:
        code, short, _ = _run(monkeypatch, capsys, *command.split(), "--help")
        assert code == 0
        assert len(re.findall(r"^  --", short, re.MULTILINE)) <= 25, command
        code, long, _ = _run(monkeypatch, capsys, *command.split(), "--help-all")
        assert code == 0 and len(long) >= len(short)
    _, short, _ = _run(monkeypatch, capsys, "run", "--help")
    _, long, _ = _run(monkeypatch, capsys, "run", "--help-all")
    for name in _FACTS:
        assert re.search(rf"^  --(\[no-\])?{name}\b", short, re.MULTILINE), name
    assert "--weights.pixel-sigma" in long and "--weights.pixel-sigma" not in short


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_option_is_one_that_is_parsed(name):
    """`options` reads signatures by itself; tyro has the same ones, with defaults."""
    command = cli.COMMANDS[name].function
    found = cli.options(command)
    tyro_help = io.StringIO()
    with contextlib.redirect_stdout(tyro_help), pytest.raises(SystemExit):
        tyro.cli(command, args=["--help"])
    parsed = set(re.findall(r"--[a-z][\w.-]*", tyro_help.getvalue())) - {"--help"}
    declared = {flag for one in found for flag in one.flags}
    assert declared <= parsed
    assert all(one.about.endswith((".", ")")) for one in found)


@pytest.mark.parametrize(
    "argv, message",
    [
        ("rnu x", "no command 'rnu'; did you mean run?"),
        ("body-model chek x", "body-model: no command 'chek'; did you mean check?"),
        ("run x --strat 3", "run: no option --strat; did you mean --start?"),
        ("run x --hieght=1.8", "run: no option --hieght; did you mean --height?"),
        ("run x --pixel-sigma 1", "did you mean --weights.pixel-sigma?"),
        ("run x --weights.pixel-sgima 1", "did you mean --weights.pixel-sigma?"),
        (
            "run x --people-fit.no-walking-knees",
            "--people-fit.no-walking-knees no longer exists: knees are as measured.",
        ),
        (
            "evaluate a b --start 3",
            "it is an option of bodyslam run, demo, live, batch, sw",
        ),
        ("run x --nosuch", "`bodyslam run --help-all` lists all."),
    ],
)
def test_the_option_that_was_meant_is_suggested(monkeypatch, capsys, argv, message):
    code, _, err = _run(monkeypatch, capsys, *argv.split())
    assert code == 2 and message in err and len(err.splitlines()) == 1


def test_docs_of_the_command_line_are_up_to_date():
    """`python tools/make_cli_docs.py` writes them."""
    file = Path(__file__).parents[1] / "docs" / "cli.md"
    assert file.read_text() == cli.reference()


def _a_sequence(name="walk", frames=8):
    return Sequence(
        name=name,
        frames=None,
        timestamps=np.arange(frames) / 30,
        intrinsics=Intrinsics(np.array([500.0, 500.0, 320.0, 240.0]), 640, 480),
    )


def test_a_run_without_a_folder_goes_to_a_free_or_unfinished_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first, second = Path("runs/walk"), Path("runs/walk-2")
    assert folders.default_folder(_a_sequence()) == first
    (first / ".cache").mkdir(parents=True)
    assert folders.default_folder(_a_sequence()) == first
    (first / ".cache" / "source.json").write_text(json.dumps(describe(_a_sequence())))
    assert folders.default_folder(_a_sequence()) == first
    assert folders.default_folder(_a_sequence(frames=9)) == second
    (first / "summary.json").write_text("{}")
    assert folders.default_folder(_a_sequence()) == second


def test_what_is_run_and_where_it_goes_is_the_first_line(
    monkeypatch, capsys, caplog, tmp_path
):
    summary = {"status": "ok", "headline": ["walk: ok"], "warnings": [], "reasons": []}
    monkeypatch.setattr("bodyslam_jax.io.read_sequence", lambda *_, **__: _a_sequence())
    monkeypatch.setattr(
        "bodyslam_jax.pipeline.run_to_folder",
        lambda *_: types.SimpleNamespace(summary=summary),
    )
    monkeypatch.chdir(tmp_path)
    code, out, _ = _run(monkeypatch, capsys, "run", "walk.mp4")
    assert code == 0
    assert caplog.messages == ["run: walk.mp4, 8 frames -> runs/walk"]
    assert out.splitlines()[-1].endswith(" runs/walk/report.html")
    caplog.clear()
    code, out, _ = _run(monkeypatch, capsys, "run", "walk.mp4", "--quiet")
    assert code == 0 and not caplog.messages and "walk: ok" in out


def test_a_reader_that_leaves_is_no_error():
    """As `head` does, once it has its lines."""
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        [sys.executable, "-m", "bodyslam_jax", "--help"],
        stdout=write,
        stderr=subprocess.PIPE,
    )
    os.close(write)
    assert done.stderr == b"" and done.returncode == 141


def test_output_that_is_closed_is_no_error():
    """As daemons have it."""
    command = f"exec {sys.executable} -m bodyslam_jax --help >&-"
    done = subprocess.run(["sh", "-c", command], stderr=subprocess.PIPE)
    assert done.stderr == b"" and done.returncode == 0


@pytest.mark.parametrize(
    "argv",
    [["run"], ["nosuch"], ["run", "x", "--out", "y", "--nosuch", "1"], ["evaluate"]],
)
def test_wrong_usage_is_exit_code_2(monkeypatch, capsys, argv):
    assert _run(monkeypatch, capsys, *argv)[0] == 2


def test_no_such_input_is_one_line(monkeypatch, capsys, tmp_path):
    out = tmp_path / "run"
    code, _, err = _run(monkeypatch, capsys, "run", tmp_path / "none.mp4", "--out", out)
    assert code == 1 and not out.exists()
    assert "none.mp4" in err and len(err.strip().splitlines()) == 1


def test_check_says_what_a_file_is_not(monkeypatch, capsys, tmp_path):
    path = tmp_path / "model.pkl"
    path.write_text("not a pickle")
    code, _, err = _run(monkeypatch, capsys, "body-model", "check", path)
    assert code == 1 and "model.pkl" in err and len(err.strip().splitlines()) == 1


def test_doctor_reports(monkeypatch, capsys):
    code, out, _ = _run(monkeypatch, capsys, "doctor")
    assert code == 0
    for word in ("jax", "BRISK", "body model", "motion model", "devices"):
        assert word in out
    last = out.splitlines()[-1].split(None, 1)
    assert last == ["verdict", "ready: `bodyslam demo`, `bodyslam run VIDEO`"]


@pytest.mark.parametrize(
    "name, finding, words",
    [
        ("optimistix", "not installed", "install again: optimistix"),
        ("body in use", "none: No neutral body model found", "no run works"),
        ("body in use", "smpl, but the motion model was trained", "another body"),
        ("video writer VP90", "absent", "no overlay.webm"),
    ],
)
def test_the_last_line_of_doctor_says_what_does_not_work(name, finding, words):
    rows = dict(environment.report()) | {name: finding}
    assert words in environment.verdict(list(rows.items()))


def _body_in_use():
    return dict(environment.report())["body in use"]


def test_doctor_tells_of_a_body_that_is_not_there_or_does_not_fit(
    monkeypatch, tmp_path, no_body_models
):
    assert _body_in_use() == "default_body"
    monkeypatch.setenv("BODYSLAM_BODY_MODEL", str(tmp_path / "none"))
    found = _body_in_use()
    assert "none: No neutral body model found (BODYSLAM_BODY_MODEL is set)" in found
    assert str(tmp_path / "none") in found and len(found) < 400 + 2 * len(str(tmp_path))
    path = write(make_raw(), tmp_path / "SMPL_NEUTRAL.npz")
    monkeypatch.setenv("BODYSLAM_BODY_MODEL", str(path))
    assert "SMPL_NEUTRAL, but the motion model was trained on body" in _body_in_use()


def test_body_model_takes_the_gender_that_is_asked_for(monkeypatch, capsys, tmp_path):
    write(make_raw(), tmp_path / "SMPL_FEMALE.npz")
    command = lambda *argv: _run(monkeypatch, capsys, "body-model", *argv)
    code, _, err = command("check", tmp_path)
    assert code == 1 and "No neutral body model found" in err
    code, out, _ = command("check", tmp_path, "--gender", "female")
    assert code == 0 and "SMPL_FEMALE.npz: SMPL" in out
    made, drawn = tmp_path / "made.npz", tmp_path / "drawn.png"
    assert command("convert", tmp_path, made, "--gender", "female")[0] == 0
    assert command("show", tmp_path, "--out", drawn, "--gender", "female")[0] == 0
    assert made.is_file() and drawn.is_file()


@pytest.mark.parametrize("name", ["out.pkl", "none/out.npz"])
def test_what_cannot_be_written_is_named_as_it_was_given(
    monkeypatch, capsys, tmp_path, name
):
    file = write(make_raw(), tmp_path / "in.npz")
    argv = ("body-model", "convert", file, tmp_path / name)
    code, _, err = _run(monkeypatch, capsys, *argv)
    assert code == 1 and f"{tmp_path / name}: " in err and ".part" not in err


def test_preset_and_settings_are_where_options_start(tmp_path):
    assert cli.base_config([]) == Config()
    paper = cli.base_config(["--preset", "paper"])
    assert (paper.solver, paper.motion_model) == ("adam", "paper")
    path = tmp_path / "config.yaml"
    path.write_text("solver: adam\nweights:\n  pixel_sigma: 2\n")
    found = cli.base_config([f"--settings={path}"])
    assert found.solver == "adam" and found.weights.pixel_sigma == 2.0
    # What is given twice counts as it is given last.
    twice = ["--preset=paper", "--settings", str(path), "--preset", "default"]
    assert cli.option(twice, "--preset") == "default"
    other = tmp_path / "other.yaml"
    other.write_text("weights:\n  pixel_sigma: 3\n")
    found = cli.base_config([*twice, f"--settings={other}"])
    assert found.weights.pixel_sigma == 3.0 and found.solver != "adam"


@pytest.mark.parametrize(
    "text", ["[1, 2", "- a list", "nosuch: 1", "weights: 3", "solver: [adam]"]
)
def test_bad_settings_name_file(tmp_path, text):
    path = tmp_path / "config.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match="config.yaml"):
        cli.base_config(["--settings", str(path)])


def test_written_settings_are_read_back(tmp_path):
    from bodyslam_jax import export

    config = Config.paper()
    path = tmp_path / "config.yaml"
    path.write_text(export.to_yaml(config))
    assert cli.read_settings(path, Config()) == config


def test_a_dataset_becomes_a_sequence_folder(monkeypatch, capsys, tmp_path):
    trajectory, motion = tmp_path / "camera.txt", tmp_path / "walk.npz"
    trajectory.write_text("0.0 0 0 0 0 0 0 1\n0.1 1 0 0 0 0 0 1\n")
    arrays = {"poses": np.zeros((2, 156)), "trans": np.zeros((2, 3))}
    np.savez(motion, **arrays)
    out = tmp_path / "sequence"
    argv = ("convert-dataset", "tum-amass", trajectory, motion, out)
    code, _, err = _run(monkeypatch, capsys, *argv)
    assert code == 1 and "walk.npz: no array betas, mocap_framerate" in err
    assert not out.exists()
    np.savez(motion, **arrays, betas=np.zeros(16), mocap_framerate=120.0)
    code, said, _ = _run(monkeypatch, capsys, *argv)
    assert code == 0 and str(out) in said
    truth = out / "groundtruth"
    assert (truth / "camera.txt").read_text() == trajectory.read_text()
    assert (truth / "body.npz").read_bytes() == motion.read_bytes()
    argv = ("convert-dataset", "3dpw", tmp_path / "none.pkl", tmp_path / "other")
    code, _, err = _run(monkeypatch, capsys, *argv)
    assert code == 1 and "none.pkl: not there; 3DPW is given to researchers" in err
    assert not (tmp_path / "other").exists()
    assert _run(monkeypatch, capsys, "convert-dataset", "nosuch")[0] == 2


def test_how_to_compile_is_set_once_where_it_is_known(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--a=1")
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "0.10.9")
    for _ in range(2):
        jax_setup.set_compiler_flags()
        wanted = "--a=1 --xla_cpu_use_fusion_emitters=false"
        assert os.environ["XLA_FLAGS"] == wanted
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "1.2.3")
    jax_setup.set_compiler_flags()
    assert os.environ["XLA_FLAGS"] == ""


@pytest.mark.parametrize("status, code", [("ok", 0), ("doubtful", 3), ("failed", 3)])
def test_what_makes_a_result_doubtful_is_printed(capsys, tmp_path, status, code):
    reason = {
        "name": "knee",
        "message": "knees are bent by 60 degrees.",
        "figure": 60.0,
    }
    reason |= {"status": status, "advice": "look at the overlay"}
    summary = {"status": status, "headline": [f"walk: {status}"], "warnings": []}
    summary["reasons"] = [] if status == "ok" else [reason]
    assert estimate.finish(types.SimpleNamespace(summary=summary), tmp_path) == code
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"walk: {status}"
    told = f"{status}: knees are bent by 60 degrees. What to do: look at the overlay."
    assert (told in lines) == (status != "ok")


def test_a_gpu_that_is_not_there_is_no_traceback(monkeypatch, capsys):
    def none(kind):
        raise RuntimeError(f"no {kind}")

    monkeypatch.setattr("jax.devices", none)
    monkeypatch.setattr(sys, "argv", ["bodyslam", "run", "x", "--device", "gpu"])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert "--device gpu: JAX finds no GPU" in str(end.value)
