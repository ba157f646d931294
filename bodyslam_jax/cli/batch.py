"""`bodyslam batch` and `collect`: many clips, and one table of their results."""

import collections
import functools
import logging
import sys
from pathlib import Path
from typing import Annotated, Any

import tyro

from bodyslam_jax.cli import jax_setup
from bodyslam_jax.cli.options import Flat, Input, Preset
from bodyslam_jax.config import Config, Distribution
from bodyslam_jax.config.errors import InputError

log = logging.getLogger(__name__)


def batch(
    inputs: tyro.conf.Positional[tuple[str, ...]],
    /,
    *,
    out: Path,
    shard: str | None = None,
    on: Annotated[Distribution, tyro.conf.arg(name="")] = Distribution(),
    preset: Preset = "default",
    settings: Path | None = None,
    config: Flat = Config(),
) -> int:
    """Estimates many clips, each into a run folder of its own.

    The same command continues a batch and leaves out what is finished.

    Args:
        inputs: Sequence folders, videos, folders of them, glob patterns in quotes, or a
            manifest (.csv) with the columns name, video, keypoints, bodies, camera,
            height, groundtruth, options.
        out: Folder for the run folders and failed.jsonl; clips that fail stop no
            others, and make the exit code 1.
        shard: I/N runs every N-th clip, from the I-th; for schedulers without an engine
            here.
        on: Where clips run.
        preset: `paper` selects the paper's weights, motion network and solver.
        settings: Settings file (config.yaml); it overrides the preset, options override
            both, and those of a manifest's line override all.
        config: Settings of every stage.
    """
    from bodyslam_jax.batch import find_inputs, run_many
    from bodyslam_jax.batch.inputs import shard as part_of

    try:
        found = find_inputs(inputs, config)
        total = len(found if shard is None else part_of(found, shard))
        log.info("batch: %d clips -> %s", total, out)
        setup = functools.partial(jax_setup.prepare, config.device)
        outcomes = run_many(found, config, on, out=out, part=shard, setup=setup)
        counts: collections.Counter[str] = collections.Counter()
        for number, outcome in enumerate(outcomes, 1):
            counts[outcome.status] += 1
            print(f"{number}/{total} {_line(outcome)}", flush=True)
    except InputError as error:
        return _refused(error)
    listed = ", ".join(f"{count} {status}" for status, count in counts.items())
    print(f"{total} clips: {listed or 'none'}")
    failed = counts["error"] + counts["failed"]
    if failed:
        print(f"failed: {out / 'failed.jsonl'}")
    log.info("one table of all: bodyslam collect %s", out)
    return 1 if failed else 0


def collect(folder: Input, /) -> None:
    """Writes one table, plots and a sortable page for all run folders in a folder.

    Args:
        folder: Folder of a batch, or any folder of run folders. table.csv, table.md,
            table.tex, plots.png and index.html are written into it.
    """
    from bodyslam_jax.batch import collect as collect_

    for path in collect_(folder):
        print(path)


def _line(outcome: Any) -> str:
    if outcome.was_finished:
        return f"{outcome.name}: {outcome.status}, finished before"
    text = f"{outcome.name}: {outcome.status}, {outcome.seconds:.0f} s"
    if outcome.message and outcome.is_failure:
        text += f": {outcome.message}"
    return text


def _refused(error: InputError) -> int:
    """Prints a line for each mistake; returns the exit code."""
    for line in error.lines:
        print(f"bodyslam: {line}", file=sys.stderr)
    return 1


def sweep(
    inputs: tyro.conf.Positional[tuple[str, ...]],
    /,
    *,
    grid: tyro.conf.UseAppendAction[tuple[str, ...]],
    out: Path,
    on: Annotated[Distribution, tyro.conf.arg(name="")] = Distribution(),
    preset: Preset = "default",
    settings: Path | None = None,
    config: Flat = Config(),
) -> int:
    """Solves clips over a grid of weights, start scales and settings; one table.

    Args:
        inputs: Clips, as of `bodyslam batch`.
        grid: NAME=VALUE,VALUE,... for each axis: weights.TERM (λ of a term of the cost,
            as weights.human_motion=10,100), scale (of the map that the solve starts
            from, as scale=0.2,1,5), or any setting.
        out: Folder for table.csv, table.md, table.tex and plots.png; finished rows are
            kept there.
        on: Where clips run.
        preset: `paper` selects the paper's weights, motion network and solver.
        settings: Settings file (config.yaml); options override it.
        config: Settings of every stage.
    """
    from bodyslam_jax import batch as batch_
    from bodyslam_jax.batch.engines import prepared
    from bodyslam_jax.batch.grid import parse_axes

    try:
        axes = parse_axes(grid, config)
        engine = batch_.make_engine(on, out.resolve(), config.device != "cpu")
        setup = prepared(functools.partial(jax_setup.prepare, config.device), True)
        paths, failed = batch_.sweep(inputs, axes, config, out, engine, setup)
    except InputError as error:
        return _refused(error)
    for path in paths:
        print(path)
    for line in failed:
        print(f"failed: {line}", file=sys.stderr)
    return 1 if failed else 0
