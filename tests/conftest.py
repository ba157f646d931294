"""What every test stands on: 64-bit, strict promotion, no silent recompiles."""

import os
import sys

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


@pytest.fixture
def key() -> jax.Array:
    """A fixed random key; a test that wants another one says why."""
    return jax.random.key(0)


@pytest.fixture(scope="module")
def quick_compilation():
    """For modules whose programs run once: compiling is what takes their time.

    With the older emitters, unoptimised code once took the wrong branch of a `where`
    (`bodyslam_jax/compilation.py`): where a test fails without sense, leave this out.
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
