"""Parses settings from text, such as `--fps 25 --weights.pixel-sigma 0.5`."""

import dataclasses
import difflib
import shlex
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from bodyslam_jax.config.errors import InputError

S = TypeVar("S")
REMOVED = {
    "people_fit.walking_knees": "knees are as measured",
    "weights.orientation_sigma": "it changed nothing",
    "weights.upright_sigma": "it changed nothing",
}
"""Settings of earlier versions, with the stage before a dot, and their replacement."""
_BOOL_BY_WORD = {"true": True, "yes": True, "false": False, "no": False}


def with_options(settings: S, text: str) -> S:
    """Returns the settings changed by options in the syntax of the command line.

    **Raises:** `InputError`, one line, for an option or value that does not exist.
    """
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise InputError(f"options: found {text!r} ({error}).") from None
    return with_values(settings, dict(_grouped(words)))


def with_values(settings: S, values: Mapping[str, Sequence[str]]) -> S:
    """Returns the settings with changed fields, such as `{"weights.pixel_sigma":
    ["0.5"]}`.

    All fields change at once, since some are valid only in combination with others.

    **Raises:** as `with_options`.
    """
    changes: dict[str, Any] = {}
    for name, texts in values.items():
        *stages, field, value = _parsed_field(settings, name, list(texts))
        within = changes
        for stage in stages:
            within = within.setdefault(stage, {})
        within[field] = value
    return _replaced(settings, changes)


def field_names(settings: Any, prefix: str = "") -> list[str]:
    """Returns all fields with the stage before a dot: `fps`, `weights.pixel_sigma`."""
    found = []
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            found += field_names(value, f"{prefix}{field.name}.")
        else:
            found.append(prefix + field.name)
    return found


def removed(name: str) -> str | None:
    """Returns the part of a message that tells what replaces a setting or option of an
    earlier version; `None` for a name that never was one."""
    stage, dot, field = name.removeprefix("--").replace("-", "_").rpartition(".")
    text = REMOVED.get(f"{stage}{dot}{field.removeprefix('no_')}")
    return None if text is None else f"no longer exists: {text}"


def _grouped(words: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Returns the name and values of each option.

    **Raises:** `InputError` for a value before any option.
    """
    found: list[tuple[str, list[str]]] = []
    for word in words:
        if word.startswith("--"):
            name, sign, value = word.removeprefix("--").partition("=")
            found.append((name, [value] if sign else []))
        elif found:
            found[-1][1].append(word)
        else:
            raise InputError(f"options: found {word!r}, expected --OPTION VALUE.")
    return found


def _parsed_field(settings: Any, name: str, texts: list[str]) -> list[Any]:
    """Returns the stages and the field that an option names, and its parsed value.

    **Raises:** `InputError` for an unknown option or an invalid value.
    """
    *stages, field = name.replace("-", "_").split(".")
    within = settings
    for stage in stages:
        within = getattr(within, stage, None)
    known = (
        [one.name for one in dataclasses.fields(within)]
        if dataclasses.is_dataclass(within)
        else []
    )
    if field not in known and field.removeprefix("no_") in known and not texts:
        field, texts = field.removeprefix("no_"), ["no"]
    if field not in known or dataclasses.is_dataclass(getattr(within, field)):
        wrong = ".".join([*stages, field])
        if former := removed(wrong):
            raise InputError(f"--{name} {former}.")
        close = difflib.get_close_matches(wrong, field_names(settings), n=1)
        hint = f"; did you mean --{close[0].replace('_', '-')}?" if close else "."
        raise InputError(f"no option --{name}{hint}")
    kind = typing.get_type_hints(type(within))[field]
    return [*stages, field, _parsed(kind, texts, name)]


def _replaced(settings: Any, changes: Mapping[str, Any]) -> Any:
    """Replaces fields of nested settings."""
    inner = {
        name: _replaced(getattr(settings, name), value)
        if isinstance(value, dict)
        else value
        for name, value in changes.items()
    }
    return dataclasses.replace(settings, **inner)


def _parsed(kind: Any, values: Sequence[str], name: str) -> Any:
    """Converts text to a value of the field's type.

    **Raises:** `InputError` if that is impossible.
    """
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        if list(values) in (["none"], ["None"]):
            return None
        (kind,) = (one for one in arguments if one is not types.NoneType)
        return _parsed(kind, values, name)
    if origin is tuple:
        return tuple(_parsed(arguments[0], [one], name) for one in values)
    if kind is bool and not values:
        return True
    if len(values) != 1:
        raise InputError(f"--{name}: found {' '.join(values)!r}, expected one value.")
    (text,) = values
    if kind is bool:
        if text.lower() not in _BOOL_BY_WORD:
            raise InputError(f"--{name}: found {text!r}, expected yes or no.")
        return _BOOL_BY_WORD[text.lower()]
    if kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            what = "a whole number" if kind is int else "a number"
            raise InputError(f"--{name}: found {text!r}, expected {what}.") from None
    return text
