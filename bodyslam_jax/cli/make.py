"""`bodyslam simulate`, `train-motion` and `experiment`."""

import contextlib
import functools
import logging
import os
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from bodyslam_jax.cli import jax_setup
from bodyslam_jax.cli.options import Flat, Input, Preset
from bodyslam_jax.config import (
    Config,
    Distribution,
    Experiment,
    MotionTraining,
    Simulation,
)

_Experiment = Literal[
    "table1",
    "scale",
    "landmarks",
    "motion",
    "ablation",
    "video",
    "calibration",
]
log = logging.getLogger(__name__)


def simulate(
    out: Input,
    /,
    *,
    config: Annotated[Simulation, tyro.conf.arg(name="")] = Simulation(),
) -> None:
    """Writes a simulated sequence folder with ground truth.

    Args:
        out: Sequence folder to write; an earlier simulation in it is replaced.
        config: What to simulate.
    """
    from bodyslam_jax import simulation

    log.info("simulate: %s, %s -> %s", config.sequence, config.family, out)
    simulation.check_folder(out, config)  # before a minute of simulating
    simulation.write_sequence(out, simulation.simulate(config))
    print(out)
    log.info("estimate it: bodyslam run %s", shlex.quote(str(out)))


def train_motion(
    data: Input,
    /,
    *,
    out: Path,
    body_model: Path | None = None,
    preset: Preset = "default",
    config: Annotated[MotionTraining, tyro.conf.arg(name="")] = MotionTraining(),
) -> None:
    """Trains a motion model on AMASS folders, BVH folders or CMU .npz files.

    Args:
        data: File or folder of motion.
        out: Weights to write (.npz); an interrupted training in it is continued.
        body_model: Body model to train for; without it the one that `bodyslam doctor`
            names.
        preset: `paper` selects its network, loss, optimiser and choice of motion.
        config: Architecture and training.
    """
    from bodyslam_jax import motion

    log.info("train-motion: %s, %s network -> %s", data, config.network, out)
    with _progress() as report:
        motion.train_from_data(data, out, config, report, body_model)
    print(out)
    log.info("use it: bodyslam run VIDEO --motion-model %s", shlex.quote(str(out)))


@contextlib.contextmanager
def _progress() -> Iterator[Callable[[int, int, dict[str, float]], None]]:
    """Yields a function that reports epochs: as a bar on a terminal, else as a log line
    per epoch."""
    from rich import console, progress

    terminal = console.Console(stderr=True)
    columns = (
        progress.TextColumn("epoch"),
        progress.MofNCompleteColumn(),
        progress.BarColumn(bar_width=16),
        progress.TimeRemainingColumn(),
        progress.TextColumn("{task.description}"),
    )
    with progress.Progress(
        *columns, console=terminal, disable=not terminal.is_terminal
    ) as bar:
        task = bar.add_task("", total=None)

        def report(epoch: int, epochs: int, measures: dict[str, float]) -> None:
            told = ", ".join(f"{name} {value:.3f}" for name, value in measures.items())
            ratios = [f"{v:.2f}" for name, v in measures.items() if "ratio" in name]
            brief = " ".join([f"loss {measures['loss']:.3g}", *ratios])
            bar.update(task, completed=epoch, total=epochs, description=brief)
            if not terminal.is_terminal:
                log.info("epoch %d of %d: %s", epoch, epochs, told)

        yield report


def experiment(
    name: tyro.conf.Positional[_Experiment],
    /,
    *,
    out: Path,
    preset: Preset = "default",
    settings: Path | None = None,
    on: Annotated[Experiment, tyro.conf.arg(name="")] = Experiment(),
    engine: Literal["local", "ray"] | None = None,
    workers: int | None = None,
    ray_address: str | None = None,
    config: Flat = Config(),
) -> None:
    """Runs one of the paper's or the project's experiments on simulated sequences.

    Args:
        name: Name of the experiment.
        out: Folder for tables and figures; finished rows are kept there.
        preset: `paper` selects the paper's weights, motion network and solver.
        settings: Settings file (config.yaml); options override it.
        on: Data that it runs on.
        engine: Computes rows in processes of this machine or of a Ray cluster, as
            `bodyslam batch`. Without it, one after another.
        workers: Rows that are computed at once.
        ray_address: Address of a running Ray cluster.
        config: Settings of every stage.
    """
    if name == "scale" and engine is None:
        _make_each_core_a_device()
    from bodyslam_jax import batch, experiments
    from bodyslam_jax.batch.engines import prepared

    log.info("experiment: %s -> %s", name, out)
    elsewhere, setup = None, None
    if engine is not None:
        by = Distribution(engine=engine, workers=workers, ray_address=ray_address)
        elsewhere = batch.make_engine(by, out.resolve(), config.device != "cpu")
        setup = prepared(functools.partial(jax_setup.prepare, config.device), True)
    for path in experiments.run_experiment(name, out, on, config, elsewhere, setup):
        print(path)


def _make_each_core_a_device() -> None:
    """Lets mapped solves run in parallel; has no effect once JAX has started."""
    import jax

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 1
    with contextlib.suppress(RuntimeError):
        options: Any = jax.config  # whose class declares no options
        if options.jax_num_cpu_devices < 1:
            jax.config.update("jax_num_cpu_devices", cores)
