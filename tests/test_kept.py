"""Programs kept on disk say what they said, and are not traced again."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scenes
from jax.experimental.compilation_cache import compilation_cache

import bodyslam_jax.graph as g
from bodyslam_jax import kept as kept_
from bodyslam_jax.kept import FOLDER, kept
from bodyslam_jax.solver import solve

traced: list[object] = []


def squares(x, *, power=2, name="sum"):
    """Counts how often it is traced."""
    traced.append(x.shape)
    return {name: jnp.sum(x**power), "power": power, "rows": (x[0], None)}


@pytest.fixture
def folder(tmp_path):
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    traced.clear()
    yield tmp_path / FOLDER
    jax.config.update("jax_compilation_cache_dir", before)


def fresh():
    """As a new process has it: nothing in memory."""
    return kept(squares, lambda: None)


def test_a_kept_program_is_not_traced_again_and_says_the_same(folder):
    x = jnp.arange(6.0).reshape(3, 2)
    first, second = fresh()(x, power=3), fresh()(x, power=3)
    assert len(traced) == 1 and len(list(folder.iterdir())) == 1
    assert first["power"] == second["power"] == 3 and second["rows"][1] is None
    np.testing.assert_array_equal(second["sum"], 225.0)
    np.testing.assert_array_equal(first["rows"][0], second["rows"][0])


def test_another_kind_of_argument_is_another_program(folder):
    x = jnp.arange(4.0)
    program = fresh()
    found = [
        program(x),
        program(x, power=3),
        program(x, name="total"),
        program(x[:3]),
        program(x.astype(jnp.float32)),
    ]
    assert len(traced) == len(list(folder.iterdir())) == 5
    assert found[2]["total"] == 14.0 and found[3]["sum"] == 5.0
    assert found[4]["sum"].dtype == jnp.float32
    program(x + 1)
    assert len(traced) == 5


def test_other_settings_and_another_source_are_another_program(folder, monkeypatch):
    x = jnp.arange(4.0)
    fresh()(x)
    with jax.debug_nans(True):
        fresh()(x)
    assert len(traced) == 2
    monkeypatch.setattr(kept_, "_source", lambda file: b"changed")
    fresh()(x)
    assert len(traced) == 3


@pytest.mark.parametrize("content", [b"", b"short", b"0" * 100])
def test_a_damaged_file_is_made_anew(folder, content):
    x = jnp.arange(4.0)
    fresh()(x)
    (file,) = folder.iterdir()
    whole = file.read_bytes()
    file.write_bytes(content)
    assert fresh()(x)["sum"] == 14.0 and len(traced) == 2
    file.write_bytes(whole[:-1])
    assert fresh()(x)["sum"] == 14.0 and len(traced) == 3
    assert fresh()(x)["sum"] == 14.0 and len(traced) == 3


@pytest.fixture
def jax_keeps_all(folder):
    """JAX's own cache takes short compilations too."""
    names = (
        "jax_persistent_cache_min_compile_time_secs",
        "jax_persistent_cache_min_entry_size_bytes",
    )
    before = [getattr(jax.config, name) for name in names]
    for name in names:
        jax.config.update(name, 0)
    compilation_cache.reset_cache()
    yield
    for name, value in zip(names, before, strict=True):
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def test_what_jax_had_compiled_is_not_written_again(folder, jax_keeps_all):
    """Written again it lacks functions, which shows when it runs."""
    x = jnp.arange(4.0)
    fresh()(x)
    (file,) = folder.iterdir()
    file.unlink()
    for count in (2, 3):
        assert fresh()(x)["sum"] == 14.0
        assert len(traced) == count and not list(folder.iterdir())


def probing(x):
    """Runs a small program while it is traced."""
    with jax.ensure_compile_time_eval():
        known = jax.jit(lambda y: 3 * y + 1)(jnp.arange(5.0))
    return x + known[1]


def test_what_tracing_runs_by_itself_does_not_count(folder, jax_keeps_all):
    kept(probing, lambda: None)(jnp.ones(4))
    jax.clear_caches()
    # The small program now comes from JAX's cache, the large one is new.
    assert kept(probing, lambda: None)(jnp.ones(3))[0] == 5.0
    assert len(list(folder.iterdir())) == 2


def test_what_cannot_be_kept_runs_all_the_same(folder):
    shift = 1.0
    assert kept(lambda x: x + shift, lambda: None)(jnp.ones(())) == 2.0
    unpicklable = kept(lambda x, f: f(x), lambda: None)
    assert unpicklable(jnp.ones(()), lambda x: 3 * x) == 3.0
    assert not folder.exists()


def test_nothing_is_kept_without_a_folder(monkeypatch, tmp_path):
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.chdir(tmp_path)
    assert fresh()(jnp.arange(4.0))["sum"] == 14.0
    assert not list(tmp_path.iterdir())
    jax.config.update("jax_compilation_cache_dir", before)


def test_the_solver_from_disk_finds_the_same_and_says_so(folder, monkeypatch):
    rng = np.random.default_rng(0)
    truth = scenes.truth(rng, 4, people=0, landmarks=20)
    problem = g.make_problem([scenes.reprojection(rng, truth)], truth)
    start = scenes.perturb(rng, problem, truth)
    found = []
    for _ in range(2):
        program = kept(solve._run, lambda: None)
        monkeypatch.setattr(solve, "_program", lambda alone, p=program: p)
        found.append(solve(problem, start))
    assert len(list(folder.iterdir())) == 1
    first, second = found
    assert first.status == second.status == "converged"
    np.testing.assert_array_equal(first.state.cameras, second.state.cameras)
    assert first.num_steps == second.num_steps


def test_a_program_that_calls_lapack_runs_in_a_new_process(tmp_path):
    script = tmp_path / "factors.py"
    script.write_text(
        "import jax, jax.numpy as jnp\n"
        f"jax.config.update('jax_compilation_cache_dir', {str(tmp_path)!r})\n"
        "from bodyslam_jax.kept import kept\n"
        "def factor(x):\n"
        "    print('traced')\n"
        "    return jnp.linalg.cholesky(x)\n"
        "print(kept(factor, lambda: None)(4 * jnp.eye(2))[1, 1])\n"
    )
    said = [
        subprocess.run(
            [sys.executable, script], capture_output=True, text=True, check=True
        ).stdout.split()
        for _ in range(2)
    ]
    assert said == [["traced", "2.0"], ["2.0"]]
