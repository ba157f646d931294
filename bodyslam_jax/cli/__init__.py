"""The command line: plain typed functions, their docstrings the help.

JAX is imported inside the commands, never for `--help`. Exit codes: 0 done; 1 bad
input, one line; 2 wrong usage; 3 the estimate failed or is not to be trusted.
"""

import _thread
import atexit
import contextlib
import gc
import importlib.metadata
import logging
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NoReturn

import tyro

from bodyslam_jax.cli.body import ACTIONS
from bodyslam_jax.cli.datasets import DATASETS
from bodyslam_jax.cli.estimate import demo, evaluate, run
from bodyslam_jax.cli.make import experiment, simulate, train_motion
from bodyslam_jax.cli.memory import return_memory
from bodyslam_jax.cli.settings import base_config, option, starting_from
from bodyslam_jax.cli.settings import read_settings as read_settings
from bodyslam_jax.config import MotionTraining


def doctor() -> None:
    """Versions, devices, BRISK, codecs, networks, and body models that were found."""
    from bodyslam_jax.cli import environment

    rows = environment.report()
    width = max(len(name) for name, _ in rows)
    for name, finding in rows:
        print(f"{name:<{width}}  {finding}")


def body_model(
    action: tyro.conf.Positional[Literal["show", "convert", "check"]],
) -> None:
    """Shows, converts or checks a body model file; see `bodyslam body-model --help`."""
    raise AssertionError(f"dispatched before tyro saw it: {action}")


def convert_dataset(
    dataset: tyro.conf.Positional[Literal["emdb", "3dpw", "rich", "tum-amass"]],
) -> None:
    """Makes a sequence folder of a dataset's; see `bodyslam convert-dataset --help`."""
    raise AssertionError(f"dispatched before tyro saw it: {dataset}")


_COMMANDS: dict[str, Callable[..., Any]] = {
    "run": run,
    "demo": demo,
    "evaluate": evaluate,
    "simulate": simulate,
    "train-motion": train_motion,
    "experiment": experiment,
    "convert-dataset": convert_dataset,
    "body-model": body_model,
    "doctor": doctor,
}
_GROUPS: dict[str, dict[str, Callable[..., Any]]] = {
    "body-model": ACTIONS,
    "convert-dataset": DATASETS,
}


_ABOUT = {
    "bodyslam": """\
Cameras, people and a map in metres, from a video that one moving camera took of people.

Without any file: `bodyslam demo`. A video of your own: `bodyslam run VIDEO.mp4 --out
RUN`. What a command takes: `bodyslam COMMAND --help`.""",
    "bodyslam body-model": "Body model files: SMPL-shaped, SMPL, SMPL-H, SMPL-X.",
    "bodyslam convert-dataset": "Sequence folders with ground truth from datasets.",
}


def main() -> None:
    """Runs one command and turns its outcome into an exit code."""
    if sys.stdout is None:
        # Closed, as daemons have it: what would be printed goes nowhere.
        sys.stdout = open(os.devnull, "w")
    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    argv = sys.argv[1:]
    commands, prog = _COMMANDS, "bodyslam"
    if argv and argv[0] in _GROUPS:
        commands, prog, argv = _GROUPS[argv[0]], f"bodyslam {argv[0]}", argv[1:]
    try:
        base = base_config(argv)
        if option(argv, "--preset") == "paper":
            training = MotionTraining.paper()
        else:
            training = MotionTraining()
        commands = {
            name: starting_from(starting_from(c, base), training)
            for name, c in commands.items()
        }
        if argv and not any(flag in argv for flag in ("-h", "--help")):
            _prepare_jax()
            _choose_device(option(argv, "--device"))
        code = _call(commands, prog, argv)
    except BrokenPipeError:
        # Whoever read our output has left, as in `bodyslam ... | head`: no error, and
        # nothing that the interpreter should try to write once more at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(_CLOSED_PIPE)
    except KeyboardInterrupt:
        _leave_interrupted()
    except Exception as error:
        if _INTERRUPTS:
            # Ctrl-C within code that makes an error of its own of it, as an import of
            # half a compiled module is.
            _leave_interrupted()
        if os.environ.get("BODYSLAM_DEBUG"):
            raise
        if isinstance(error, (OSError, ValueError)):
            sys.exit(f"bodyslam: {_one_line(error)}")
        # Memory, the linear algebra library, a bug: no fault of the input.
        print(f"bodyslam: failed: {_one_line(error)}; {_WHERE}", file=sys.stderr)
        sys.exit(3)
    sys.exit(code or 0)


def program() -> NoReturn:
    """`main` as a process of its own."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    try:
        main()
    except SystemExit as end:
        if end.code == _INTERRUPTED:
            # Not Python's way out: it waits for threads that compile, and what they
            # still call is then gone.
            sys.stderr.flush()
            os._exit(_INTERRUPTED)
        raise
    raise AssertionError("main exits.")


_COLLECT_AFTER = 50_000
"""New objects after which Python looks for what only refers to itself. Tracing makes
millions that are all in use: looking every 700, as Python does, takes a tenth of it."""
_INTERRUPTS: list[bool] = []
"""That this process was interrupted, whatever has become of `KeyboardInterrupt`."""
_INTERRUPTED = 130
"""What a shell says of a program that Ctrl-C ended."""
_WHERE = "BODYSLAM_DEBUG=1 says where"
_CLOSED_PIPE = 128 + 13
"""What a shell says of a program that SIGPIPE ended."""


def _interrupt(*_: object) -> NoReturn:
    """Python's own answer to Ctrl-C, and that it came."""
    _INTERRUPTS.append(True)
    raise KeyboardInterrupt


def _leave_interrupted() -> NoReturn:
    print("bodyslam: interrupted; the same command continues it", file=sys.stderr)
    sys.exit(_INTERRUPTED)


def _call(commands: dict[str, Callable[..., Any]], prog: str, argv: list[str]) -> Any:
    """The command that `argv` names; all that it printed has left when it returns."""
    try:
        return tyro.extras.subcommand_cli_from_dict(
            commands, prog=prog, description=_ABOUT[prog], args=argv
        )
    finally:
        sys.stdout.flush()


def _one_line(error: BaseException) -> str:
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or 'file'}: {error.strerror}."
    text = " ".join(str(error).split())
    if isinstance(error, (OSError, ValueError)) and text:
        return text
    return f"{type(error).__name__}: {text[:300]}"


def _prepare_jax() -> None:
    """64-bit, compiled programs kept between runs, and every Ctrl-C heard."""
    sys.unraisablehook = _interrupt_again
    # What was asked for is done by then: Ctrl-C could only change what is said of it.
    atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)
    _compile_quickly()
    # XLA's alarms about slow compilation are no error, and errors are raised as well.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    with _interrupts_held():
        import jax
        import jax.numpy

    # Not before: JAX makes the level that it finds when it is imported XLA's, too.
    logging.getLogger("jax").setLevel(logging.WARNING)
    gc.set_threshold(_COLLECT_AFTER)
    return_memory()
    jax.config.update("jax_enable_x64", True)
    cache = os.environ.get("BODYSLAM_CACHE") or Path(
        os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "bodyslam_jax"
    )
    jax.config.update("jax_compilation_cache_dir", str(Path(cache) / "compiled"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", 0)


def _choose_device(device: str | None) -> None:
    """Has JAX compute there.

    **Raises:** `ValueError` if a GPU is asked for and JAX sees none.
    """
    if device is None:
        return
    import jax

    if device == "cpu":
        jax.config.update("jax_platforms", "cpu")
    if device == "gpu":
        try:
            jax.config.update("jax_default_device", jax.devices("gpu")[0])
        except RuntimeError:
            raise ValueError(
                "--device gpu: JAX sees no GPU; install its build for one "
                "(pip install 'jax[cuda13]'), or leave the option out."
            ) from None


@contextlib.contextmanager
def _interrupts_held() -> Iterator[None]:
    """Ctrl-C is heard at the end: while jaxlib is loaded it would crash Python."""
    before = signal.getsignal(signal.SIGINT)
    heard = []
    if callable(before):
        signal.signal(signal.SIGINT, lambda *_: heard.append(True))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if heard and callable(before):
        before(signal.SIGINT, None)


def _compile_quickly() -> None:
    """Has XLA's older code generator used, which compiles a third faster and runs as
    fast; where XLA is known to have it, as a flag that it does not know ends it."""
    flag = "--xla_cpu_use_fusion_emitters"
    given = os.environ.get("XLA_FLAGS", "")
    if importlib.metadata.version("jaxlib").startswith("0.10.") and flag not in given:
        os.environ["XLA_FLAGS"] = f"{given} {flag}=false".strip()


def _interrupt_again(unraisable: Any) -> None:
    """Ctrl-C that came within JAX's callback of the garbage collector, where Python
    drops exceptions, comes once more."""
    if unraisable.exc_type is KeyboardInterrupt:
        threading.Timer(0.1, _thread.interrupt_main).start()
    else:
        sys.__unraisablehook__(unraisable)
