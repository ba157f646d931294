"""Engines: every item is finished once, whatever becomes of processes and nodes."""

import collections
import importlib.util
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import batch_stubs
import pytest

from bodyslam_jax.batch import Failure
from bodyslam_jax.batch.local_engine import LocalEngine
from bodyslam_jax.batch.slurm_engine import (
    Share,
    SlurmEngine,
    read_values,
    run_share,
)

WITH_RAY = importlib.util.find_spec("ray") is not None
WITH_SLURM = importlib.util.find_spec("submitit") is not None


def _logged(folder, word):
    """Names of the items that were so, with their numbers."""
    lines = (folder / "log").read_text().splitlines()
    return collections.Counter(
        line.rpartition(" ")[0].removesuffix(f" {word}")
        for line in lines
        if f" {word} " in line
    )


def _battery(engine, folder):
    """Items that fail in every way, among others."""
    words = [*map(str, range(6)), "raise", "kill once", "kill always"]
    items = [(word, str(folder), 0.02) for word in words]
    found = dict(engine.map(batch_stubs.obey, items, batch_stubs.nothing))
    assert set(found) == set(items)
    values = {item[0]: value for item, value in found.items()}
    assert "raise went wrong" in values["raise"].message
    assert "lost" in values["kill always"].message or (
        "SIGKILL (out of memory?), 2 times" in values["kill always"].message
    )
    good = {*map(str, range(6)), "kill once"}
    assert {word for word, v in values.items() if not isinstance(v, Failure)} == good
    assert all(values[word][0] == word for word in good)
    assert dict(_logged(folder, "done")) == dict.fromkeys(good, 1)
    begun = _logged(folder, "begun")
    assert begun["kill once"] == begun["kill always"] == 2 and begun["raise"] == 1
    return values


def test_processes_that_die_are_replaced_and_their_items_run_again(tmp_path):
    values = _battery(LocalEngine(workers=2, retries=1), tmp_path)
    # A process keeps what it has compiled: two of them, and one for each that died.
    pids = {value[1] for value in values.values() if not isinstance(value, Failure)}
    assert len(pids) <= 5
    assert not multiprocessing.active_children()


def test_an_engine_says_what_keeps_processes_from_starting():
    engine = LocalEngine(workers=1)
    with pytest.raises(ValueError, match="JAX finds no GPU"):
        list(engine.map(batch_stubs.twice, [1, 2, 3], batch_stubs.refuse))


def test_closing_the_iterator_ends_the_processes(tmp_path):
    items = [(str(k), str(tmp_path), 0.0 if k == 0 else 60.0) for k in range(3)]
    found = LocalEngine(workers=2).map(batch_stubs.obey, items, batch_stubs.nothing)
    item, _ = next(found)
    assert item[0] == "0"
    start = time.monotonic()
    found.close()
    assert not multiprocessing.active_children()
    assert time.monotonic() - start < 10


_DRIVER = """
    import sys, batch_stubs
    from bodyslam_jax.batch.local_engine import LocalEngine
    if __name__ == "__main__":
        items = [(str(k), sys.argv[1], 0.1 if k < 2 else 60.0) for k in range(4)]
        for item, value in LocalEngine(2).map(
            batch_stubs.obey, items, batch_stubs.nothing
        ):
            print(item[0], flush=True)
"""


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL")
def test_processes_end_with_a_driver_that_is_killed(tmp_path):
    script = tmp_path / "driver.py"
    script.write_text(textwrap.dedent(_DRIVER))
    here = str(Path(__file__).parent)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([here, *sys.path])}
    driver = subprocess.Popen(
        [sys.executable, script, tmp_path], stdout=subprocess.PIPE, env=environment
    )
    assert driver.stdout is not None
    for _ in range(2):
        driver.stdout.readline()
    until = time.monotonic() + 60
    while _logged(tmp_path, "begun").total() < 4 and time.monotonic() < until:
        time.sleep(0.05)
    lines = (tmp_path / "log").read_text().splitlines()
    workers = {int(line.split()[-1]) for line in lines}
    driver.kill()
    driver.communicate()
    while any(_is_alive(pid) for pid in workers) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(_is_alive(pid) for pid in workers)


def _is_alive(pid):
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


def test_values_of_a_share_are_read_up_to_what_is_complete(tmp_path):
    file = tmp_path / "values"
    assert read_values(file, 0) == ([], 0)
    whole = pickle.dumps((0, "a"))
    file.write_bytes(whole + pickle.dumps((1, "b"))[:-3])
    assert read_values(file, 0) == ([(0, "a")], len(whole))
    file.write_bytes(whole + pickle.dumps((1, "b")))
    assert read_values(file, len(whole))[0] == [(1, "b")]


@pytest.mark.slow
@pytest.mark.skipif(not WITH_SLURM, reason="needs submitit")
def test_slurm_without_sbatch_is_refused_in_a_line(tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    engine = SlurmEngine(tmp_path)
    with pytest.raises(ValueError, match="no sbatch on this machine"):
        list(engine.map(batch_stubs.twice, [1], batch_stubs.nothing))
    assert not (tmp_path / ".slurm").exists()


_SBATCH = """#!{python}
import sys
from pathlib import Path
whole = Path({copy!r} + ".part")
whole.write_text(Path(sys.argv[1]).read_text())
whole.rename({copy!r})
print("Submitted batch job 77")
"""


@pytest.mark.slow
@pytest.mark.skipif(not WITH_SLURM, reason="needs submitit")
def test_the_script_for_sbatch_is_a_job_array_with_what_was_asked_for(
    tmp_path, monkeypatch
):
    programs = tmp_path / "bin"
    programs.mkdir()
    copy = tmp_path / "script.sh"
    for name in ("sbatch", "sacct", "scancel", "srun"):
        text = _SBATCH.format(python=sys.executable, copy=str(copy))
        if name != "sbatch":
            text = f"#!{sys.executable}\n"
        (programs / name).write_text(text)
        (programs / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(programs), prepend=os.pathsep)
    monkeypatch.setattr("bodyslam_jax.batch.slurm_engine._POLL_PERIOD_S", 0.01)
    parameters = {"slurm_partition": "gpu", "mem_gb": 8, "gpus_per_node": 1}
    engine = SlurmEngine(tmp_path, 4, minutes=90, parameters=parameters)
    found = engine.map(batch_stubs.twice, list(range(10)), batch_stubs.nothing)
    values = []
    following = threading.Thread(target=lambda: values.append(next(found)), daemon=True)
    following.start()
    until = time.monotonic() + 30
    while not copy.exists() and time.monotonic() < until:
        time.sleep(0.05)
    lines = copy.read_text().splitlines()
    for option in (
        *("--array=0-3%4", "--time=90", "--partition=gpu", "--mem=8GB"),
        *("--gpus-per-node=1", "--cpus-per-task=1", "--job-name=bodyslam"),
    ):
        assert f"#SBATCH {option}" in lines, option
    assert any("submitit.core._submit" in line for line in lines)
    # The tasks, as the script would run them: each its share, here in this process.
    tasks = lambda: sorted((tmp_path / ".slurm").glob("*/77/*_submitted.pkl"))
    while len(tasks()) < 4 and time.monotonic() < until:
        time.sleep(0.05)
    for file in tasks():
        submission = pickle.loads(file.read_bytes())
        (share,) = submission.args
        submission.function(share)
    following.join(30)
    ((item, value),) = values
    assert value == 2 * item
    found.close()


def test_a_requeued_share_continues(tmp_path):
    done = []
    values, items = tmp_path / "values", [(3, "x"), (7, "y")]
    share = Share(done.append, batch_stubs.nothing, items, values)
    run_share(share)
    values.write_bytes(values.read_bytes()[:-2])
    run_share(share)
    assert done == ["x", "y", "y"]
    assert [number for number, _ in read_values(values, 0)[0]] == [3, 7]


@pytest.mark.slow
@pytest.mark.skipif(not WITH_SLURM, reason="needs submitit")
def test_tasks_of_an_array_that_die_are_submitted_again(tmp_path, monkeypatch):
    here = str(Path(__file__).parent)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([here, *sys.path]))
    engine = SlurmEngine(tmp_path, 3, retries=1, cluster="local")
    _battery(engine, tmp_path)


@pytest.mark.slow
@pytest.mark.skipif(not WITH_RAY, reason="needs ray")
@pytest.mark.filterwarnings("ignore")
def test_actors_that_die_are_restarted_by_ray_and_their_items_run_again(
    tmp_path, monkeypatch
):
    from bodyslam_jax.batch.ray_engine import RayEngine

    here = str(Path(__file__).parent)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([here, *sys.path]))
    _battery(RayEngine(workers=2, retries=1), tmp_path)
    engine = RayEngine(workers=1)
    with pytest.raises(ValueError, match="JAX finds no GPU"):
        list(engine.map(batch_stubs.twice, [1, 2], batch_stubs.refuse))
