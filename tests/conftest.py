"""What every test stands on: 64-bit, strict promotion, programs shared and dropped.

Most of the suite's time is compiling. The tests of a file run in one process
(`--dist loadfile`), so that they share what is traced; processes share machine code
through JAX's persistent cache; what a file compiled is dropped at its end, which keeps
each process below 2 GB.
"""

import gc
import os
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

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_dtype_promotion", "strict")
if not os.environ.get("JAX_COMPILATION_CACHE_DIR"):
    folder = Path(__file__).parents[1] / ".pytest_cache" / "jax"
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


@pytest.fixture(scope="module", autouse=True)
def programs_of_one_module():
    """Drops compiled programs at the end of each test file: memory stays bounded."""
    yield
    eqx.clear_caches()
    jax.clear_caches()
    gc.collect()


@pytest.fixture
def key() -> jax.Array:
    """A fixed random key; a test that wants another one says why."""
    return jax.random.key(0)


@pytest.fixture(scope="module")
def quick_compilation():
    """For modules whose programs run once: compiling is what takes their time.

    With the older emitters, unoptimised code once took the wrong branch of a `where`
    (jaxlib 0.10.2): where a test fails without sense, leave this out.
    """
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


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
