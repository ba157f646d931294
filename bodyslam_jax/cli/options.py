"""The options of a command: names, values, defaults and descriptions.

They are read from the command's signature, its docstring and the dataclasses of its
settings. Help, documentation and suggestions are made from them; tyro parses.

Several commands share the types `Input`, `Preset` and `Flat` of arguments.
"""

import ast
import dataclasses
import difflib
import inspect
import textwrap
import types
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from bodyslam_jax.config import Config

GENERAL = {
    "--quiet": "Prints results, warnings and errors only, no progress.",
    "--json-log": "Progress and warnings as one JSON object a line, on standard error.",
    "--help": "The usual options.",
    "--help-all": "All options.",
}
"""Options of every command."""
_VALUES = {
    "height": "[ID=]METRES[±SIGMA] ...",
    "focal": "PX[±SIGMA]",
    "fov": "DEGREES[±SIGMA]",
    "gravity": "X Y Z",
    "fps": "FPS",
    "start": "SECONDS",
    "end": "SECONDS",
    "person": "ID ...",
    "camera_path": "FILE",
}
_KINDS = {int: "N", float: "NUMBER", str: "TEXT", Path: "PATH"}
Input = tyro.conf.Positional[Path]
Preset = Literal["default", "paper"]
Flat = Annotated[Config, tyro.conf.arg(name="")]
"""Settings whose names are options: `--weights.pixel-sigma`."""


@dataclasses.dataclass(frozen=True)
class Option:
    """An argument of a command, or a setting."""

    name: str
    """As in Python and `config.yaml`, with the stage before a dot."""
    value: str | None
    """Placeholder for the option's value; `None` for a switch, which takes no value and
    has a `--no-` form."""
    default: str | None
    """`None` if there is none, or if the description says what happens instead."""
    about: str
    is_positional: bool = False
    is_required: bool = False

    @property
    def flags(self) -> list[str]:
        """Returns the option as it is typed, and for a switch the form that turns it
        off."""
        if self.is_positional:
            return []
        stage, dot, name = self.name.replace("_", "-").rpartition(".")
        flags = [f"--{stage}{dot}{name}"]
        return flags if self.value else [*flags, f"--{stage}{dot}no-{name}"]

    @property
    def usage(self) -> str:
        """Returns the option with its value, as help shows it."""
        if self.is_positional:
            return self.value or ""
        if self.value:
            return f"{self.flags[0]} {self.value}"
        stage, dot, name = self.flags[0].removeprefix("--").rpartition(".")
        return f"--{stage}{dot}[no-]{name}"


def options(function: Callable[..., Any]) -> list[Option]:
    """Returns the options of a command, in the order of its signature."""
    about = _arguments_described(inspect.getdoc(function) or "")
    hints = typing.get_type_hints(function)
    found = []
    for name, argument in inspect.signature(function).parameters.items():
        if dataclasses.is_dataclass(hints[name]):
            found += _settings(argument.default)
            continue
        positional = argument.kind is argument.POSITIONAL_ONLY
        required = argument.default is argument.empty
        default = None if required else argument.default
        one = _option(name, hints[name], default, about[name])
        value = one.value
        if positional and not (value and value.islower()):
            value = name.replace("_", "-").upper()
        found.append(
            dataclasses.replace(
                one, value=value, is_positional=positional, is_required=required
            )
        )
    return found


def suggestions(wrong: str, flags: dict[str, list[str]], command: str) -> str:
    """Returns a hint for a user who typed the unknown option `wrong` after `command`.

    Args:
        flags: the options of every command, by the command's name.
    """
    own = flags[command]
    ends = {flag.rpartition(".")[2].removeprefix("--"): flag for flag in own}
    name = wrong.removeprefix("--")
    close = difflib.get_close_matches(wrong, own, n=1, cutoff=0.7)
    close += [ends[end] for end in difflib.get_close_matches(name, ends, 1, 0.8)]
    if close:
        return f"did you mean {close[0]}?"
    others = [other for other, known in flags.items() if wrong in known]
    if others:
        return f"it is an option of bodyslam {', '.join(others)}."
    return f"`bodyslam {command} --help-all` lists all."


def settings_described(kind: type) -> dict[str, str]:
    """Returns the description of each field of a dataclass, by the field's name.

    A description is the string literal below the field in the source. Inherited fields
    are included.
    """
    found: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        (tree,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        if not isinstance(tree, ast.ClassDef):
            continue
        for field, text in zip(tree.body, tree.body[1:], strict=False):
            if (
                isinstance(field, ast.AnnAssign)
                and isinstance(field.target, ast.Name)
                and isinstance(text, ast.Expr)
                and isinstance(text.value, ast.Constant)
            ):
                found[field.target.id] = " ".join(str(text.value.value).split())
    return found


def _settings(settings: Any, prefix: str = "") -> list[Option]:
    kind = type(settings)
    about, hints = settings_described(kind), typing.get_type_hints(kind)
    found, stages = [], []
    for field in dataclasses.fields(kind):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            stages += _settings(value, f"{field.name}.")
        else:
            one = _option(field.name, hints[field.name], value, about[field.name])
            found.append(dataclasses.replace(one, name=prefix + field.name))
    return found + stages


def _option(name: str, kind: Any, default: Any, about: str) -> Option:
    if kind is bool:
        return Option(name, None, "yes" if default else "no", about)
    shown = None if default in (None, ()) else str(default)
    if isinstance(default, tuple) and default:
        shown = " ".join(map(str, default))
    return Option(name, _VALUES.get(name) or _value(kind), shown, about)


def _value(kind: Any) -> str:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        (kind,) = (one for one in arguments if one is not types.NoneType)
        return _value(kind)
    if origin is typing.Literal:
        return "|".join(arguments)
    if origin is tuple:
        return f"{_value(arguments[0])} ..."
    return _KINDS[kind]


def _arguments_described(docstring: str) -> dict[str, str]:
    """Returns the descriptions in the section `Args:` of a docstring, by argument."""
    found, name = {}, ""
    for line in docstring.partition("Args:\n")[2].splitlines():
        if line.startswith("        "):
            found[name] += f" {line.strip()}"
        elif line.startswith("    "):
            name, _, text = line.strip().partition(": ")
            found[name] = text
        elif line:
            break
    return found
