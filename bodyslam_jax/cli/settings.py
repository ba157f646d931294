"""Presets and settings files, which options override."""

import dataclasses
import difflib
import functools
import inspect
import itertools
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any

from bodyslam_jax.cli import jax_setup
from bodyslam_jax.config import Config, MotionTraining, removed
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import budget
from bodyslam_jax.io.declared import as_number, shown
from bodyslam_jax.io.files import read_yaml


def base_config(argv: list[str]) -> Config:
    """Returns the settings that `--preset` and `--settings` select.

    **Raises:** `InputError` if the file is not a config.yaml.
    """

    config = Config.paper() if _is_paper(argv) else Config()
    path = option(argv, "--settings")
    return config if path is None else read_settings(Path(path), config)


def _is_paper(argv: list[str]) -> bool:
    return option(argv, "--preset") == "paper"


def option(argv: list[str], flag: str) -> str | None:
    """Returns the value of a flag, after it or after its `=`; the last one counts."""
    found = None
    for arg, after in itertools.pairwise([*argv, None]):
        if arg == flag and after is not None:
            found = after
        elif arg is not None and arg.startswith(f"{flag}="):
            found = arg.partition("=")[2]
    return found


def read_settings(path: Path, base: Config) -> Config:
    """Returns `base` changed by a config.yaml.

    **Raises:** `InputError`, naming file and key, if it is not one.
    """
    return _merged(read_yaml(path, "settings (config.yaml)"), base, str(path))


def _merged(found: Any, base: Any, where: str, stage: str = "") -> Any:
    if not isinstance(found, dict):
        raise InputError(f"{where}: found {shown(found)}, expected settings by name.")
    known = {field.name for field in dataclasses.fields(base)}
    hints = typing.get_type_hints(type(base))
    changes = {}
    for name, value in found.items():
        if name not in known:
            if former := removed(f"{stage}{name}"):
                raise InputError(f"{where}: `{name}` {former}.")
            close = difflib.get_close_matches(str(name), known, n=1)
            hint = f"did you mean `{close[0]}`?" if close else ""
            raise InputError(
                f"{where}: no setting `{str(name)[:60]}`; "
                f"{hint or f'expected one of {sorted(known)}.'}"
            )
        old = getattr(base, name)
        kind = hints[name]
        if type(value) is int and float in (kind, *typing.get_args(kind)):
            value = as_number(Path(where), name, value)
        if dataclasses.is_dataclass(old):
            value = _merged(value, old, f"{where}: {name}", f"{name}.")
        elif isinstance(old, tuple) and isinstance(value, list):
            value = tuple(value)
        elif old is not None and value is not None and type(value) is not type(old):
            raise InputError(
                f"{where}: {name}: found {shown(value)}, expected "
                f"{type(old).__name__} as "
                f"in {old!r}."
            )
        changes[name] = value
    try:
        return dataclasses.replace(base, **changes)
    except ValueError as error:
        raise InputError(f"{where}: {error}") from None


def prepared(
    command: Callable[..., Any], argv: list[str], in_workers: bool = False
) -> Callable[..., Any]:
    """Returns the command with JAX set up before it runs, and with the default settings
    that `--preset` and `--settings` select.

    Args:
        in_workers: whether other processes compute, and this one on the CPU only.
    """
    signature = inspect.signature(command)
    argument = signature.parameters.get("config")
    if argument is not None:
        default = argument.default
        if isinstance(default, Config):
            default = base_config(argv)
        elif (
            isinstance(default, MotionTraining) and option(argv, "--preset") == "paper"
        ):
            default = MotionTraining.paper()
        changed = {**signature.parameters, "config": argument.replace(default=default)}
        signature = signature.replace(parameters=list(changed.values()))

    @functools.wraps(command)
    def run(*args: Any, **kwargs: Any) -> Any:
        config = kwargs.get("config")
        elsewhere = in_workers or kwargs.get("engine") is not None
        jax_setup.prepare("cpu" if elsewhere else getattr(config, "device", None))
        with budget.granted(getattr(config, "limits", budget.current())):
            return command(*args, **kwargs)

    # `inspect` reads it; typeshed does not declare it.
    run.__signature__ = signature  # pyright: ignore[reportAttributeAccessIssue]
    return run
