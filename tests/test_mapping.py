"""Batches on several devices and from several threads: each in a process of its own, as
how many devices there are is settled when JAX starts."""

import os
import subprocess
import sys
import textwrap

import jax
import jax.numpy as jnp
import pytest

from bodyslam_jax.solver import vmap_over_devices

SETUP = """
import jax
jax.config.update("jax_num_cpu_devices", 2)
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import numpy as np
import scenes
import bodyslam_jax.graph as g
from bodyslam_jax.solver.compilation import compiled
from bodyslam_jax.solver import Stage, vmap_over_devices, solve
"""


def in_new_process(tmp_path, body):
    """Runs a script; what it asserts must hold, and it must end."""
    script = tmp_path / "script.py"
    script.write_text(SETUP + textwrap.dedent(body))
    env = os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": os.path.dirname(__file__)}
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, timeout=300, env=env
    )
    assert done.returncode == 0, done.stderr


def scaled(x, rate, name):
    return {name: jnp.sum(x) * rate, "name": name}


def test_a_batch_on_one_device_is_vmap():
    spread = vmap_over_devices(scaled, (0, None, None))
    found = spread(jnp.arange(6.0).reshape(3, 2), jnp.array(2.0), "sum")
    assert found["name"] == "sum"
    assert found["sum"].tolist() == [2.0, 10.0, 18.0]


def test_what_cannot_be_shared_out_is_said():
    spread = vmap_over_devices(scaled, (0, 0, None))
    with pytest.raises(ValueError, match=r"leading axes.*\(2,\), \(3,\)"):
        spread(jnp.ones((3, 2)), jnp.ones(2), "sum")
    with pytest.raises(ValueError, match=r"leading axes.*\(\), \(3,\)"):
        spread(jnp.ones((3, 2)), jnp.ones(()), "sum")
    with pytest.raises(ValueError, match="2 arguments, expected 0 or None"):
        spread(jnp.ones((3, 2)), jnp.ones(3))
    with pytest.raises(ValueError, match="leading axes"):
        vmap_over_devices(jnp.sum, (None,))(jnp.ones(3))


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="devices of a CPU")
def test_every_device_takes_a_share_of_any_batch(tmp_path):
    in_new_process(
        tmp_path,
        """
        first, second = jax.devices()

        def one(x, shared):
            device = jax.lax.axis_index("device") if size > 1 else 0 * x[0]
            return {"sum": jnp.sum(x) * shared["rate"], "device": device, "name": "n"}

        for size in (1, 2, 5, 6):
            spread = vmap_over_devices(one, (0, None))
            x = np.arange(2.0 * size).reshape(size, 2)
            # What is put on a device is as welcome as what is not.
            found = spread(jax.device_put(x, second), {"rate": jnp.array(3.0)})
            np.testing.assert_array_equal(found["sum"], 3 * x.sum(1))
            # Dealt out one by one.
            assert found["device"].tolist() == [k % 2 for k in range(size)]
            assert found["sum"].devices() == {first} and found["name"] == "n"

        loss = lambda x, rate: spread(x, {"rate": rate})["sum"].sum()
        by_x, by_rate = jax.jit(jax.grad(loss, (0, 1)))(x, 3.0)
        assert (by_x == 3).all() and by_rate == x.sum()
        """,
    )


@pytest.mark.slow
def test_factorisations_of_two_threads_end(tmp_path):
    """LAPACK's batches do not on two cores: each waits for the other's threads."""
    in_new_process(
        tmp_path,
        """
        import os, threading
        from bodyslam_jax.solver.triangular import half_of

        square = np.random.default_rng(0).normal(size=(160, 69, 69))
        matrix = jnp.asarray(square @ square.transpose(0, 2, 1) + 69 * np.eye(69))
        half = jax.jit(half_of)
        inverse = half(matrix)
        product = inverse.swapaxes(1, 2) @ inverse @ matrix
        assert jnp.allclose(product, jnp.eye(69), atol=1e-9)
        work = lambda: [half(matrix).block_until_ready() for _ in range(40)]
        threads = [threading.Thread(target=work, daemon=True) for _ in range(2)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
        # A thread that hangs would keep the process from ending.
        os._exit(any(thread.is_alive() for thread in threads))
        """,
    )


@pytest.mark.slow
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="devices of a CPU")
def test_solves_on_two_devices_are_single_solves(tmp_path):
    in_new_process(
        tmp_path,
        """
        rng = np.random.default_rng(2)
        truth = scenes.truth(rng, 24, 0, 60)
        problem = g.make_problem([scenes.reprojection(rng, truth)], truth)
        starts = [scenes.perturb(rng, problem, truth, size=0.01) for _ in range(3)]
        one = lambda p, s: solve(p, s, schedule=(Stage(max_steps=6),))
        batch = jax.tree.map(lambda *x: jnp.stack(x), *starts)
        found = vmap_over_devices(one, (None, 0))(problem, batch)
        for k, start in enumerate(starts):
            alone = one(problem, start)
            np.testing.assert_allclose(found.cost[k], alone.cost, rtol=1e-8)
            assert found.num_steps[0][k] == alone.num_steps[0]
            np.testing.assert_allclose(
                found.state.cameras[k], alone.state.cameras, atol=1e-5
            )
        """,
    )
