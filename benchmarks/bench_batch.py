"""Engines under load and under failures, with clips that take no time or sleep.

`python benchmarks/bench_batch.py stubs --count 1000`: what a driver holds and what the
file system sees. `python benchmarks/bench_batch.py losses --engine ray`: processes, a
node and the driver are killed while clips run; every clip must be finished once.
"""

import argparse
import json
import os
import pickle
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections import Counter
from pathlib import Path

from bodyslam_jax.batch import run_many
from bodyslam_jax.config import Distribution
from bodyslam_jax.io import atomic


def nothing() -> None:
    pass


def estimate(job) -> dict:
    """Sleeps as long as the clip's content says, then writes a summary.

    Holds the run folder as a real run does. `log` of the batch has a line at the
    beginning and at the end of each.
    """
    from bodyslam_jax import export

    seconds, _, word = job.source.path.read_text().partition(" ")
    with export.locked(job.out):
        _note(job.batch / "log", f"begun {job.name} {os.getpid()}")
        time.sleep(float(seconds))
        if word == "kill" and not (job.out / "tried").exists():
            (job.out / "tried").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        summary = {"status": "ok", "reasons": [], "filling": "x" * 20_000}
        atomic.write_text(job.out / "summary.json", json.dumps(summary))
        _note(job.batch / "log", f"done {job.name} {os.getpid()}")
    return summary


def _note(path: Path, line: str) -> None:
    with path.open("a") as file:
        file.write(f"{line}\n")


def make_clips(folder: Path, count: int, seconds: float, kills: int = 0) -> None:
    folder.mkdir(parents=True)
    for k in range(count):
        word = " kill" if k % 5 == 2 and k // 5 < kills else ""
        (folder / f"clip{k:05d}.mp4").write_text(f"{seconds}{word}")


def stubs(args: argparse.Namespace, folder: Path) -> None:
    """Clips that take no time."""
    make_clips(folder / "clips", args.count, 0.0)
    on = Distribution(engine=args.engine, workers=args.workers)
    for attempt in ("first", "again"):
        start, cpu = time.perf_counter(), time.process_time()
        outcomes = run_many(
            folder / "clips",
            engine=on,
            out=folder / "out",
            setup=nothing,
            estimate=estimate,
        )
        found = Counter((o.status, o.was_finished) for o in outcomes)
        seconds, used = time.perf_counter() - start, time.process_time() - cpu
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        files = sum(1 for path in (folder / "out").rglob("*") if path.is_file())
        print(
            f"{attempt}: {dict(found)}, {seconds:.1f} s ({used:.1f} s of the driver's "
            f"processor time), driver's peak {peak:.0f} MB, {files} files",
            flush=True,
        )


def growth(args: argparse.Namespace, folder: Path) -> None:
    """What a driver holds of so many clips, and how long it looks for finished ones."""
    from bodyslam_jax.batch.driver import plan
    from bodyslam_jax.batch.job import finished
    from bodyslam_jax.config import Config

    make_clips(folder / "clips", args.count, 0.0)
    tracemalloc.start()
    start = time.process_time()
    jobs = plan(folder / "clips", Config(), folder / "out")
    planned = time.process_time() - start
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    size = len(pickle.dumps(jobs[0]))
    start = time.process_time()
    assert not any(map(finished, jobs))
    looked = time.process_time() - start
    print(
        f"{args.count} clips: planned in {planned:.1f} s of processor time, "
        f"{held / args.count / 1e3:.1f} kB a clip; {looked:.1f} s to find that none is "
        f"finished; a job is {size} bytes on its way to a worker"
    )


def losses(args: argparse.Namespace, folder: Path) -> None:
    """Kills workers, then the driver; with Ray also a node. Checks the outcome."""
    make_clips(folder / "clips", args.count, args.seconds, kills=2)
    cluster = None
    drive = [sys.executable, __file__, "drive", "--folder", str(folder)]
    drive += ["--engine", args.engine, "--workers", str(args.workers)]
    if args.engine == "ray":
        from ray.cluster_utils import Cluster

        _wait_longer_for_nodes()
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
        node = cluster.add_node(num_cpus=1)
        drive += ["--address", cluster.address]
    log = folder / "out" / "log"
    driver = subprocess.Popen(drive)
    _wait(log, args.count // 3)
    if cluster is not None:
        print(f"a node is killed after {_done(log)} clips", flush=True)
        cluster.remove_node(node, allow_graceful=False)
    _wait(log, args.count // 2)
    print(f"the driver is killed after {_done(log)} clips", flush=True)
    driver.kill()
    driver.wait()
    code = subprocess.run(drive).returncode
    done = Counter(
        line.split()[1]
        for line in log.read_text().splitlines()
        if line.startswith("done")
    )
    recorded = len(list((folder / "out").glob("*/.job.json")))
    partial = [p for p in (folder / "out").rglob("*partial*")]
    print(
        f"exit code {code}; {len(done)} of {args.count} clips finished, "
        f"{sum(n > 1 for n in done.values())} more than once, {recorded} records, "
        f"{len(partial)} files half-written"
    )
    if cluster is not None:
        cluster.shutdown()


def _wait_longer_for_nodes() -> None:
    """Ray gives a node 30 s to start, which is little on a machine that is busy."""
    import ray._private.services as services

    os.environ.setdefault("RAY_worker_register_timeout_seconds", "600")
    os.environ.setdefault("RAY_worker_niceness", "0")
    look = services.get_node

    def patient(*args):
        until = time.monotonic() + 300
        while True:
            try:
                return look(*args)
            except RuntimeError:
                if time.monotonic() > until:
                    raise
                time.sleep(1)

    services.get_node = patient


def _done(log: Path) -> int:
    try:
        return log.read_text().count("done ")
    except FileNotFoundError:
        return 0


def _wait(log: Path, count: int) -> None:
    while _done(log) < count:
        time.sleep(0.1)


def drive(args: argparse.Namespace, folder: Path) -> None:
    """The driver of `losses`, a process of its own."""
    on = Distribution(
        engine=args.engine, workers=args.workers, ray_address=args.address
    )
    engine = on
    if args.engine == "slurm":
        from bodyslam_jax.batch.slurm_engine import SlurmEngine

        engine = SlurmEngine(folder / "out", args.workers, cluster="local")
    outcomes = run_many(
        folder / "clips",
        engine=engine,
        out=folder / "out",
        setup=nothing,
        estimate=estimate,
    )
    start = time.perf_counter()
    found = Counter((o.status, o.was_finished) for o in outcomes)
    print(f"driver: {dict(found)}, {time.perf_counter() - start:.0f} s", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("stubs", "growth", "losses", "drive"))
    parser.add_argument("--engine", default="local")
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=0.5)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--address")
    parser.add_argument("--folder", type=Path)
    args = parser.parse_args()
    folder = args.folder or Path(tempfile.mkdtemp())
    globals()[args.what](args, folder)
    if args.folder is None:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
