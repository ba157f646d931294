"""The command line: plain typed functions, their docstrings the help.

JAX is imported inside the commands, never for `--help`. Exit codes: 0 done; 1 bad
input, one line; 2 wrong usage; 3 the estimate failed or is not to be trusted.
"""

import contextlib
import dataclasses
import functools
import inspect
import logging
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from bodyslam_jax.config import Config, Experiment, MotionTraining, Simulation

_Input = tyro.conf.Positional[Path]
_Preset = Literal["default", "paper"]
_Experiment = Literal["table1", "scale", "landmarks", "motion", "ablation", "weights"]
_Flat = Annotated[Config, tyro.conf.arg(name="")]
log = logging.getLogger("bodyslam_jax")


def run(
    input: _Input,
    /,
    *,
    out: Path,
    keypoints: Path | None = None,
    bodies: Path | None = None,
    camera: Path | None = None,
    tracks: Path | None = None,
    masks: Path | None = None,
    preset: _Preset = "default",
    settings: Path | None = None,
    config: _Flat = Config(),
) -> int:
    """Estimates cameras, people and map, in metres, from a video or sequence folder.

    Args:
        input: Sequence folder, video file or folder of images.
        out: Run folder to write; an interrupted one is finished.
        keypoints: OpenPose folder, COCO/AlphaPose JSON or .npz, if not in the input.
        bodies: Regressed bodies of any supported tool, if not in the input.
        camera: camera.json, if not in the input.
        tracks: tracks.npz made elsewhere, if not in the input.
        masks: Folder of person masks, if not in the input.
        preset: `paper` has the weights and the first-order schedule of the paper.
        settings: A config.yaml to start from; options beside it prevail.
        config: Settings of every stage.
    """
    from bodyslam_jax import frontend, pipeline

    sequence = frontend.read_sequence(
        input,
        keypoints=keypoints,
        bodies=bodies,
        camera=camera,
        tracks=tracks,
        masks=masks,
        config=config.association,
    )
    return _finish(pipeline.run_to_folder(sequence, out, config), out)


def demo(
    *,
    out: Path = Path("bodyslam_demo"),
    preset: _Preset = "default",
    settings: Path | None = None,
    config: _Flat = Config(),
) -> int:
    """Renders a walker filmed by a moving camera and runs the whole pipeline on it.

    Args:
        out: Run folder to write.
        preset: `paper` has the weights and the first-order schedule of the paper.
        settings: A config.yaml to start from; options beside it prevail.
        config: Settings of every stage.
    """
    from bodyslam_jax import pipeline

    return _finish(pipeline.demo(out, config), out)


def _finish(result: Any, out: Path) -> int:
    for line in result.summary["headline"]:
        print(line)
    for warning in result.summary["warnings"]:
        print(f"warning: {warning}")
    print(f"{out / 'report.html'}")
    return 0 if result.summary["status"] == "ok" else 3


def evaluate(
    run: _Input, groundtruth: tyro.conf.Positional[Path], /, *, json: bool = False
) -> None:
    """Errors of a run folder against a ground truth: cameras, people, joints, scale.

    Args:
        run: Run folder.
        groundtruth: Folder with camera.txt (TUM) and body.npz (AMASS style).
        json: Print JSON instead of a table.
    """
    import bodyslam_jax as bs
    from bodyslam_jax import evaluation

    truth = evaluation.read_groundtruth(groundtruth, bs.load_body_model())
    found = evaluation.evaluate(evaluation.read_result(run), truth)
    print(evaluation.to_json(found) if json else evaluation.to_table(found))


def simulate(
    out: _Input,
    /,
    *,
    config: Annotated[Simulation, tyro.conf.arg(name="")] = Simulation(),
) -> None:
    """Writes a simulated sequence folder with ground truth.

    Args:
        out: Sequence folder to write.
        config: What to simulate.
    """
    from bodyslam_jax import synthetic

    out.mkdir(parents=True, exist_ok=True)  # or it is said now, not after a minute
    synthetic.write_sequence(out, synthetic.simulate(config))
    print(out)


def train_motion(
    data: _Input,
    /,
    *,
    out: Path,
    body_model: Path | None = None,
    preset: _Preset = "default",
    config: Annotated[MotionTraining, tyro.conf.arg(name="")] = MotionTraining(),
) -> None:
    """Trains a motion model on AMASS folders, BVH folders or CMU .npz files.

    Args:
        data: File or folder of motion.
        out: Weights to write (.npz); an interrupted training is continued.
        body_model: Body to train for, if not the one that `doctor` names.
        preset: `paper` is its network, loss, optimiser and choice of motion.
        config: Architecture and training.
    """
    from bodyslam_jax import motion

    with _progress() as report:
        motion.train_from_data(data, out, config, report, body_model)
    print(out)


@contextlib.contextmanager
def _progress() -> Iterator[Callable[[int, int, dict[str, float]], None]]:
    """A bar on a terminal, a line an epoch in a file."""
    from rich import console, progress

    terminal = console.Console(stderr=True)
    columns = (
        progress.TextColumn("epoch"),
        progress.MofNCompleteColumn(),
        progress.BarColumn(),
        progress.TimeRemainingColumn(),
        progress.TextColumn("{task.description}"),
    )
    with progress.Progress(
        *columns, console=terminal, disable=not terminal.is_terminal
    ) as bar:
        task = bar.add_task("", total=None)

        def report(epoch: int, epochs: int, measures: dict[str, float]) -> None:
            told = ", ".join(f"{name} {value:.3f}" for name, value in measures.items())
            bar.update(task, completed=epoch, total=epochs, description=told)
            if not terminal.is_terminal:
                log.info("epoch %d of %d: %s", epoch, epochs, told)

        yield report


def experiment(
    name: tyro.conf.Positional[_Experiment],
    /,
    *,
    out: Path,
    preset: _Preset = "default",
    settings: Path | None = None,
    on: Annotated[Experiment, tyro.conf.arg(name="")] = Experiment(),
    config: _Flat = Config(),
) -> None:
    """Repeats one of the paper's experiments, or of ours, on simulated sequences.

    Args:
        name: Which one.
        out: Folder for tables and figures; finished rows are kept there.
        preset: `paper` has the weights and the first-order schedule of the paper.
        settings: A config.yaml to start from; options beside it prevail.
        on: What it runs on.
        config: Settings of every stage.
    """
    from bodyslam_jax import experiments

    for path in experiments.run_experiment(name, out, on, config):
        print(path)


def doctor() -> None:
    """Versions, devices, BRISK, codecs, and where body models were looked for."""
    from bodyslam_jax import doctor as _doctor

    rows = _doctor.report()
    width = max(len(name) for name, _ in rows)
    for name, finding in rows:
        print(f"{name:<{width}}  {finding}")


def body_show(
    file: tyro.conf.Positional[Path | None] = None,
    /,
    *,
    out: Path = Path("body_model.png"),
) -> None:
    """Draws a body model: shape components at ±2σ and a few postures.

    Args:
        file: Body model; without it the default one.
        out: Picture to write.
    """
    from bodyslam_jax import body

    body.save_picture(body.load_body_model(file), out)
    print(out)


def body_convert(file: _Input, out: tyro.conf.Positional[Path], /) -> None:
    """Writes a body model in SMPL's own .npz layout, readable without chumpy.

    Args:
        file: Any supported body model file.
        out: The .npz to write.
    """
    from bodyslam_jax import body

    body.write_npz(body.load_body_model(file), out)
    print(out)


def body_check(file: _Input, /) -> None:
    """Says what a body model file is, or why it is not usable.

    Args:
        file: Body model file or folder.
    """
    from bodyslam_jax import body

    print(body.check(file))


_BODY = {"show": body_show, "convert": body_convert, "check": body_check}


def body_model(
    action: tyro.conf.Positional[Literal["show", "convert", "check"]],
) -> None:
    """Shows, converts or checks a body model file; see `bodyslam body-model --help`."""
    raise AssertionError(f"dispatched before tyro saw it: {action}")


_COMMANDS: dict[str, Callable[..., Any]] = {
    "run": run,
    "demo": demo,
    "evaluate": evaluate,
    "simulate": simulate,
    "train-motion": train_motion,
    "experiment": experiment,
    "body-model": body_model,
    "doctor": doctor,
}


def base_config(argv: list[str]) -> Config:
    """The settings that `--preset` and `--settings` start from.

    **Raises:** `ValueError` if the file is not a config.yaml.
    """

    config = Config.paper() if _option(argv, "--preset") == "paper" else Config()
    path = _option(argv, "--settings")
    return config if path is None else read_settings(Path(path), config)


def _option(argv: list[str], flag: str) -> str | None:
    joined = [a.partition("=")[2] for a in argv if a.startswith(f"{flag}=")]
    after = [argv[i + 1] for i, a in enumerate(argv[:-1]) if a == flag]
    return (joined + after + [None])[0]


def read_settings(path: Path, base: Config) -> Config:
    """`base` with what a config.yaml says.

    **Raises:** `ValueError`, naming file and key, if it is not one.
    """
    import yaml

    try:
        found = yaml.safe_load(path.read_text())
    except yaml.YAMLError as error:
        raise ValueError(f"{path}: not YAML ({error}).") from error
    return _merged(found, base, str(path))


def _merged(found: Any, base: Any, where: str) -> Any:
    if not isinstance(found, dict):
        raise ValueError(f"{where}: found {found!r}, expected settings by name.")
    known = {field.name for field in dataclasses.fields(base)}
    changes = {}
    for name, value in found.items():
        if name not in known:
            raise ValueError(
                f"{where}: no setting `{name}`; expected one of {sorted(known)}."
            )
        old = getattr(base, name)
        if dataclasses.is_dataclass(old):
            value = _merged(value, old, f"{where}: {name}")
        elif isinstance(old, tuple) and isinstance(value, list):
            value = tuple(value)
        elif old is not None and value is not None and type(value) is not type(old):
            if not (isinstance(old, float) and type(value) is int):
                raise ValueError(
                    f"{where}: {name}: found {value!r}, expected "
                    f"{type(old).__name__} as in {old!r}."
                )
            value = float(value)
        changes[name] = value
    return dataclasses.replace(base, **changes)


def _starting_from(
    command: Callable[..., Any], config: Config | MotionTraining
) -> Callable[..., Any]:
    """The same command with another default of its `config`, if it is of that kind."""
    signature = inspect.signature(command)
    if "config" not in signature.parameters:
        return command
    if not isinstance(signature.parameters["config"].default, type(config)):
        return command

    @functools.wraps(command)
    def started(*args: Any, **kwargs: Any) -> Any:
        return command(*args, **kwargs)

    parameters = [
        p.replace(default=config) if p.name == "config" else p
        for p in signature.parameters.values()
    ]
    started.__signature__ = signature.replace(parameters=parameters)  # pyright: ignore
    return started


def main() -> None:
    """Runs one command and turns its outcome into an exit code."""
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    logging.getLogger("jax").setLevel(logging.WARNING)
    argv = sys.argv[1:]
    commands, prog = _COMMANDS, "bodyslam"
    if argv[:1] == ["body-model"]:
        commands, prog, argv = _BODY, "bodyslam body-model", argv[1:]
    try:
        base = base_config(argv)
        if _option(argv, "--preset") == "paper":
            training = MotionTraining.paper()
        else:
            training = MotionTraining()
        commands = {
            name: _starting_from(_starting_from(c, base), training)
            for name, c in commands.items()
        }
        if argv and not any(flag in argv for flag in ("-h", "--help")):
            _prepare_jax()
        code = tyro.extras.subcommand_cli_from_dict(
            commands, prog=prog, description=(__doc__ or "").split("\n")[0], args=argv
        )
    except KeyboardInterrupt:
        print("bodyslam: interrupted; the same command continues it", file=sys.stderr)
        sys.exit(130)
    except Exception as error:
        if os.environ.get("BODYSLAM_DEBUG"):
            raise
        if isinstance(error, (OSError, ValueError)):
            sys.exit(f"bodyslam: {_one_line(error)}")
        # Memory, the linear algebra library, a bug: no fault of the input.
        print(f"bodyslam: failed: {_one_line(error)}; {_WHERE}", file=sys.stderr)
        sys.exit(3)
    sys.exit(code or 0)


_WHERE = "BODYSLAM_DEBUG=1 says where"


def _one_line(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'file'}: {error.strerror}."
    text = " ".join(str(error).split())
    if isinstance(error, (OSError, ValueError)) and text:
        return text
    return f"{type(error).__name__}: {text[:300]}"


def _prepare_jax() -> None:
    """64-bit, and compiled programs kept between runs."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    import jax

    jax.config.update("jax_enable_x64", True)
    cache = os.environ.get("BODYSLAM_CACHE") or Path(
        os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "bodyslam_jax"
    )
    jax.config.update("jax_compilation_cache_dir", str(Path(cache) / "compiled"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)
