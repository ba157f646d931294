"""Progress of a run as lines, JSON or a bar, and completion in real shells."""

import contextlib
import io
import json
import logging
import shutil
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import pytest
from rich.console import Console

from bodyslam_jax.cli import main, progress
from bodyslam_jax.pipeline import progress as stages
from bodyslam_jax.pipeline.progress import Counter, Stopwatch, compiling, counted

PACKAGE = logging.getLogger("bodyslam_jax")


@pytest.fixture
def records():
    """The package's records of all levels, while a test runs."""
    found = []
    handler = logging.Handler()
    handler.emit = found.append
    level = PACKAGE.level
    PACKAGE.addHandler(handler)
    PACKAGE.setLevel(logging.DEBUG)
    yield found
    PACKAGE.removeHandler(handler)
    PACKAGE.setLevel(level)


def a_stage(watch):
    with watch("cameras"):
        counter = Counter("cameras", 40)
        counter(20)
        time.sleep(0.25)
        counter(30)
        counter(40)


def test_a_stage_reports_its_frames_time_and_compilation(records):
    watch = Stopwatch()
    a_stage(watch)
    with watch("joint"):
        jax.jit(lambda x: jnp.cumsum(jnp.sin(x)) @ jnp.tan(x))(jnp.arange(7.0))
    done = [record.done for record in records if hasattr(record, "done")]
    assert done == [30, 40]  # The first came within the interval between updates.
    ends = [record for record in records if hasattr(record, "seconds")]
    assert [record.stage for record in ends] == ["cameras", "joint"]
    assert ends[0].seconds >= 0.25 and ends[0].compile_seconds == 0
    assert 0 < ends[1].compile_seconds <= ends[1].seconds + 0.1
    assert ends[1].peak_mb is None or ends[1].peak_mb > 10


def test_a_json_log_is_one_object_a_line(records):
    a_stage(Stopwatch())
    PACKAGE.warning("50 %% of %s", "it")
    lines = [json.loads(progress.JsonLine().format(record)) for record in records]
    assert lines[0]["message"] == "cameras ..." and lines[0]["stage"] == "cameras"
    assert lines[1]["done"] == 30 and lines[1]["total"] == 40
    assert lines[-2]["seconds"] > 0 and lines[-2]["level"] == "info"
    assert lines[-1] == lines[-1] | {"message": "50 % of it", "level": "warning"}


def test_a_bar_shows_the_stage_and_leaves_its_last_line(records):
    a_stage(Stopwatch())
    bar, out = progress.Bar(), io.StringIO()
    bar._console = Console(file=out, force_terminal=True, width=100)
    for record in records:
        bar.handle(record)
    bar.close()
    shown = out.getvalue()
    assert "30 of 40 frames" in shown and "s left" in shown
    last = [line for line in shown.splitlines() if "cameras: " in line]
    assert len(last) == 1 and last[0].rstrip().endswith(" s")
    assert "\x1b[?25h" in shown  # The cursor is shown again.


@pytest.fixture
def programs(tmp_path):
    """A folder of compiled programs, empty at first."""
    kept = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "compiled"))
    yield tmp_path / "compiled"
    jax.config.update("jax_compilation_cache_dir", kept)


def compiled_stage(watch, size, seconds=9.0):
    with watch("joint"), compiling("joint", size):
        PACKAGE.info("working")
        # As JAX reports what its compiler took.
        jax.monitoring.record_event_duration_secs(COMPILED, seconds)


COMPILED = "/jax/core/compile/backend_compile_duration"


def test_compiling_is_said_before_the_stage_and_once(records, programs):
    said = lambda: [r.getMessage() for r in records if "seconds" not in vars(r)]
    compiled_stage(Stopwatch(), "60 frames, 1 people")
    expected = "joint: compiling, about 26 s, once"
    assert said() == ["joint ...", expected, "working"]
    records.clear()
    compiled_stage(Stopwatch(), "60 frames, 1 people")
    assert said() == ["joint ...", "working"]
    records.clear()
    # Programs of another size take about what those took.
    compiled_stage(Stopwatch(), "120 frames, 1 people")
    assert said()[1] == "joint: compiling, about 9 s, once"
    records.clear()
    # Programs that were deleted are compiled again, and so is said.
    for file in programs.iterdir():
        file.write_text("{broken")
    compiled_stage(Stopwatch(), "60 frames, 1 people")
    assert said()[1] == expected


def test_without_a_folder_of_programs_a_process_says_it_once(records, monkeypatch):
    monkeypatch.setattr(stages, "_of_process", {})
    kept = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    try:
        for _ in range(2):
            compiled_stage(Stopwatch(), "60 frames, 1 people")
    finally:
        jax.config.update("jax_compilation_cache_dir", kept)
    lines = [r.getMessage() for r in records]
    assert [x for x in lines if "about" in x] == ["joint: compiling, about 26 s"]


def test_a_bar_leaves_the_line_about_compiling_above_it(records, programs):
    compiled_stage(Stopwatch(), "60 frames, 1 people")
    bar, out = progress.Bar(), io.StringIO()
    bar._console = Console(file=out, force_terminal=True, highlight=False)
    for record in records[:2]:
        bar.handle(record)
    assert bar._bar is not None
    bar.close()
    assert "joint: compiling, about 26 s, once" in out.getvalue()


def test_a_stage_that_goes_through_frames_counts_them(records):
    with Stopwatch()("overlay"):
        for k in counted(range(3), "overlay", 3):
            time.sleep(0.15 if k == 0 else 0.21)
    done = [r.done for r in records if hasattr(r, "done")]
    assert done[-1] == 3 and all(r.stage == "overlay" for r in records)


def test_general_options_are_taken_from_any_place():
    argv = ["run", "--quiet", "x", "--json-log"]
    level = PACKAGE.level
    with progress.handled(argv) as rest:
        assert rest == ["run", "x"] and PACKAGE.level == logging.WARNING
    PACKAGE.setLevel(level)


@pytest.fixture(scope="module")
def completion():
    """The script of `bodyslam completion bash`."""
    out = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out):
        patch.setattr(sys, "argv", ["bodyslam", "completion", "bash"])
        patch.setattr("bodyslam_jax.cli.jax_setup.prepare", lambda device: None)
        with pytest.raises(SystemExit):
            main()
    return out.getvalue()


@pytest.mark.slow
@pytest.mark.parametrize(
    "typed, expected, refused",
    [
        ("bodyslam ru", "run", "demo"),
        ("bodyslam run --keyp", "--keypoints", "--out"),
        ("bodyslam body-model ", "convert", "--out"),
        ("bodyslam body-model convert --qu", "--quiet", "--detect"),
    ],
)
def test_bash_completes_commands_and_options(completion, typed, expected, refused):
    bash = shutil.which("bash")
    if bash is None:
        pytest.skip("bash is not installed")
    words = typed.split(" ")
    given = " ".join(f"'{word}'" for word in words)
    script = completion + (
        f"COMP_WORDS=({given}); COMP_CWORD={len(words) - 1}; _bodyslam; "
        'printf "%s\\n" "${COMPREPLY[@]}"'
    )
    done = subprocess.run(
        [bash, "-c", script], capture_output=True, text=True, check=True
    )
    assert expected in done.stdout.split() and refused not in done.stdout.split()
