"""Help on the terminal and `docs/cli.md`, from the commands themselves."""

import inspect
import shutil
import textwrap
from collections.abc import Callable, Iterable
from typing import Any

from bodyslam_jax.cli.commands import COMMANDS, GROUPS
from bodyslam_jax.cli.options import GENERAL, Option, options

ABOUT = """\
Recovers camera path, people and a map, in metres, from a video that one moving camera
took of people."""
START = """\
Without any file: `bodyslam demo`. With your own video: `bodyslam run VIDEO.mp4`."""
_MAX_WIDTH = 88
_DESCRIPTION_COLUMN = 26
"""Column in which descriptions start."""


def overview(group: str | None = None) -> str:
    """Returns the commands, or those of a group, one a line."""
    width = _width()
    lines = [GROUPS[group] if group else f"{_fill(ABOUT, width)}\n\n{START}", ""]
    prog = f"bodyslam {group} " if group else "bodyslam "
    lines += [f"usage: {prog}COMMAND [OPTIONS]", ""]
    for name, about in _listed(group):
        lines += _row(name, about, width)
    lines += ["", f"`{prog}COMMAND --help` explains a command"]
    if not group:
        lines[-1] += "; `bodyslam --version` prints the version"
    return "\n".join(lines) + "."


def command_help(name: str, everything: bool) -> str:
    """Returns what `--help` and `--help-all` print of a command."""
    command, width = COMMANDS[name], _width()
    found = options(command.function)
    shown = [
        one
        for one in found
        if everything or not command.shown or one.name in command.shown
    ]
    lines = [
        f"usage: {_usage(name, found)}",
        "",
        _fill(_about(command.function), width),
    ]
    lines.append("")
    stage = ""
    for one in shown:
        if one.name.rpartition(".")[0] != stage:
            stage = one.name.rpartition(".")[0]
            lines += ["", f"{stage}:"]
        lines += _row(one.usage, _described(one), width)
    hidden = len(found) - len(shown)
    lines.append("")
    for flag, about in GENERAL.items():
        if flag == "--help-all":
            if not hidden and not everything:
                continue
            about += f" {hidden} more are not shown here." if hidden else ""
        lines += _row(flag, about, width)
    return "\n".join(lines)


def reference() -> str:
    """Returns `docs/cli.md`: all commands with all options, defaults and units."""
    parts = [
        "# Command line",
        "Made by `python tools/make_cli_docs.py` from the code.",
        ABOUT.replace("\n", " ") + " " + START,
        "`python -m bodyslam_jax` is the same as `bodyslam`. Exit codes: 0 done; 1 bad "
        "input, one line on standard error; 2 wrong usage; 3 the estimate failed or is "
        "doubtful, `status` in `summary.json` says why; 70 an error that nobody "
        "expected, please report it with the file that is named; 130 interrupted, the "
        "same command continues. Settings with a dot are those of one stage, in "
        "`config.yaml` under its name. `--[no-]x` is `--x` or `--no-x`.",
        "Options of every command:",
        "\n".join(f"- `{flag}`: {about}" for flag, about in GENERAL.items()),
    ]
    for name, command in COMMANDS.items():
        found = options(command.function)
        parts += [f"## bodyslam {name}", f"`{_usage(name, found)}`"]
        parts.append(_about(command.function))
        stages = dict.fromkeys(one.name.rpartition(".")[0] for one in found)
        for stage in stages:
            if stage:
                parts.append(f"### bodyslam {name}: `{stage}`")
            parts.append(
                "\n".join(
                    f"- `{one.usage}`: {_described(one)}"
                    for one in found
                    if one.name.rpartition(".")[0] == stage
                )
            )
    return "\n\n".join(part for part in parts if part) + "\n"


def _listed(group: str | None) -> Iterable[tuple[str, str]]:
    """Returns names and first sentences of commands; groups are among the commands."""
    if group:
        for name, command in COMMANDS.items():
            if name.startswith(f"{group} "):
                yield name.removeprefix(f"{group} "), _first_line(command.function)
        return
    seen = set()
    for name, command in COMMANDS.items():
        first, _, second = name.partition(" ")
        if not second:
            yield name, _first_line(command.function)
        elif first not in seen:
            seen.add(first)
            yield first, GROUPS[first]


def _usage(name: str, found: list[Option]) -> str:
    words = [one.usage for one in found if one.is_required]
    words += [
        f"[{one.usage}]"
        for one in found
        if one.is_positional not in (False,) and not one.is_required
    ]
    return " ".join(["bodyslam", name, *words, "[OPTIONS]"])


def _described(one: Option) -> str:
    if one.is_required and not one.is_positional:
        return f"{one.about} Required."
    return one.about if one.default is None else f"{one.about} Default: {one.default}."


def _about(function: Callable[..., Any]) -> str:
    text = (inspect.getdoc(function) or "").partition("Args:")[0]
    return text.strip()


def _first_line(function: Callable[..., Any]) -> str:
    return _about(function).splitlines()[0]


def _width() -> int:
    return min(_MAX_WIDTH, shutil.get_terminal_size((_MAX_WIDTH, 24)).columns)


def _fill(text: str, width: int) -> str:
    return "\n\n".join(textwrap.fill(part, width) for part in text.split("\n\n"))


def _row(left: str, right: str, width: int) -> list[str]:
    """Returns `left` in a column of its own, or on a line of its own where it is
    longer."""
    indent = " " * _DESCRIPTION_COLUMN
    text = textwrap.wrap(right, max(width - _DESCRIPTION_COLUMN, 20))
    if len(left) + 2 < _DESCRIPTION_COLUMN:
        return [
            f"  {left:<{_DESCRIPTION_COLUMN - 2}}{text[0]}",
            *(indent + x for x in text[1:]),
        ]
    return [f"  {left}", *(indent + line for line in text)]
