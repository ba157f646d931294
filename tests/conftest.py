"""Settings and fixtures of all tests: 64 bit, strict promotion, little compilation.

Most of the suite's time is compiling, so XLA optimises little (`optimised` undoes that
for a test file). The tests of a file run in one process (`--dist loadfile`) and share
what is traced; processes share machine code through JAX's persistent cache, also of the
thousands of small programs of single operations, which take half as long to find there
as to compile. Compiled programs are dropped at the end of each file, and where a
process exceeds `_MEMORY`.
"""

import ctypes
import gc
import os
import platform
import sys
from pathlib import Path

import equinox as eqx
import jax
import jaxlib.version
import pytest

if jaxlib.version.__version__.startswith("0.10."):
    # As the package compiles its own large programs: compiling is what most tests wait
    # for, and takes two thirds of the time so. Of a version that does not know it, the
    # flag would end the program.
    flags = ("--xla_cpu_use_fusion_emitters=false", os.environ.get("XLA_FLAGS", ""))
    os.environ["XLA_FLAGS"] = " ".join(flags)

_MEMORY = 1.5e9
"""Resident memory of a process, bytes, from which compiled programs are dropped after
a test: two processes stay below 4 GB."""

_LONGEST = (
    *("solver", "docs", "online", "marginalisation", "experiments", "toolkit"),
    *("posture_basis", "frontend_lens", "online_fixed", "motion_training"),
    *("evaluation", "camera_evidence", "pipeline", "stack_cases", "given_facts"),
    *("contact",),
    *("compilation", "experiments_video", "mixed_precision", "synthetic_writing"),
    *("batch", "motion_coupling", "frontend_motion", "people_floor", "graph"),
    *("people_noise", "path_clock", "interruption", "fuzz", "globals", "safe_pickle"),
)
"""Files of which the slow tests take half a minute or more, the longest first."""

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_disable_most_optimizations", True)
# In child processes too, which then share machine code with the tests' own.
os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "true"
jax.config.update("jax_numpy_dtype_promotion", "strict")
if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
    folder = Path(__file__).parents[1] / ".pytest_cache" / "jax"
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
# As in the command: Python's 700 new objects cost a seventh of tracing time.
gc.set_threshold(50_000)


def pytest_collection_modifyitems(items):
    """Long files begin first: the last one would leave a process idle."""
    order = {f"test_{name}.py": k for k, name in enumerate(_LONGEST)}
    items.sort(key=lambda item: order.get(item.path.name, len(order)))


def pytest_collection_finish():
    """What is imported by now stays: a collection of garbage, of which each file ends
    with one, takes 0.4 s of half a million objects that are never freed."""
    gc.collect()
    gc.freeze()


def drop_programs() -> None:
    """Frees compiled programs and what was traced for them, and gives their memory
    back to the system: it would seem used after the next test, too."""
    eqx.clear_caches()
    jax.clear_caches()
    gc.collect()
    if platform.libc_ver()[0] == "glibc":
        ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture(scope="session", autouse=True)
def memory_returned():
    """Freed memory goes back to the system, as in the command."""
    from bodyslam_jax.cli import jax_setup  # not before XLA's flags are set

    jax_setup.return_memory()


@pytest.fixture(scope="module", autouse=True)
def programs_of_one_module():
    """Drops compiled programs at the end of each test file."""
    yield
    drop_programs()


@pytest.fixture(autouse=True)
def programs_within_memory():
    """Drops compiled programs after a test where they take too much memory."""
    yield
    pages = Path("/proc/self/statm")
    if pages.exists():
        resident = int(pages.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        if resident > _MEMORY:
            drop_programs()


@pytest.fixture
def forget():
    """Drops compiled programs within a test that needs several large ones."""
    return drop_programs


@pytest.fixture
def key() -> jax.Array:
    """A fixed random key; a test that wants another one says why."""
    return jax.random.key(0)


@pytest.fixture(scope="module")
def optimised():
    """XLA optimises as usual in this test file: for programs that run for long, or that
    unoptimised code gets wrong.

    With the older emitters, unoptimised code once took the wrong branch of a `where`
    (jaxlib 0.10.2): use this where a test fails without sense.
    """
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", True)


@pytest.fixture(scope="module")
def bodies(tmp_path_factory):
    """A folder of made-up SMPL and SMPL-X models of every gender."""
    import dataset_cases  # not before XLA's flags are set

    return dataset_cases.make_bodies(tmp_path_factory.mktemp("models"))


@pytest.fixture
def no_body_models(monkeypatch, tmp_path):
    """Hides those of whoever runs the tests."""
    monkeypatch.delenv("BODYSLAM_BODY_MODEL", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "share"))


@pytest.fixture
def command(monkeypatch, capsys):
    """Runs `bodyslam` with these arguments in this process.

    Returns the exit code and all output, standard error last.
    """
    from bodyslam_jax import cli  # not before XLA's flags are set

    monkeypatch.setattr("bodyslam_jax.cli.jax_setup.prepare", lambda device: None)

    def run(*argv) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["bodyslam", *map(str, argv)])
        with pytest.raises(SystemExit) as stopped:
            cli.main()
        code, printed = stopped.value.code, capsys.readouterr()
        text = printed.out + printed.err
        return (1, text + code) if isinstance(code, str) else (code or 0, text)

    return run
