"""Runs one command and turns its outcome into an exit code.

0: done; 1: bad input, one line; 2: wrong usage; 3: the estimate failed or is doubtful,
as `summary.json` says; 70: an error that nobody expected, with its details in a file;
130: interrupted.
"""

import difflib
import os
import signal
import sys
from typing import NoReturn

import tyro

import bodyslam_jax
from bodyslam_jax.cli import interrupts, progress, unexpected
from bodyslam_jax.cli.commands import COMMANDS, GROUPS
from bodyslam_jax.cli.options import GENERAL, options, suggestions
from bodyslam_jax.cli.reference import command_help, overview
from bodyslam_jax.cli.settings import prepared
from bodyslam_jax.config import removed

_CLOSED_PIPE = 128 + 13
"""128 + SIGPIPE, as shells report a process that SIGPIPE ended."""
_HELP = ("-h", "--help", "--help-all")


class WrongUsage(Exception):
    """A command line that names no command or option that exists; exit code 2."""


def main() -> NoReturn:
    """Runs the command that `sys.argv` names; always raises `SystemExit`."""
    if sys.stdout is None:
        # A closed standard output, as daemons have it: discards what is printed.
        sys.stdout = open(os.devnull, "w")
    argv = sys.argv[1:]
    try:
        with progress.handled(argv) as rest:
            code = _dispatch(rest)
            sys.stdout.flush()
    except BrokenPipeError:
        # The reader of the output has left, as in `bodyslam ... | head`: no error, and
        # nothing for the interpreter to flush at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(_CLOSED_PIPE)
    except KeyboardInterrupt:
        _leave_interrupted()
    except WrongUsage as error:
        print(f"bodyslam: {error}", file=sys.stderr)
        sys.exit(2)
    except Exception as error:
        from bodyslam_jax.config.errors import error_line

        if interrupts.arrived():
            _leave_interrupted()
        if os.environ.get("BODYSLAM_DEBUG"):
            raise
        if unexpected.is_input(error):
            sys.exit(f"bodyslam: {error_line(error)}")
        # Memory, the linear algebra library, a bug: no fault of the input.
        print(f"bodyslam: {unexpected.line(error)}", file=sys.stderr)
        sys.exit(unexpected.EXIT_CODE)
    sys.exit(code or 0)


def program() -> NoReturn:
    """Runs `main` as a process of its own, with its handling of signals."""
    interrupts.install()
    try:
        main()
    except SystemExit as end:
        # The command is done: Ctrl-C from here on must not change its exit code.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        if end.code == interrupts.EXIT_CODE:
            sys.stderr.flush()
            os._exit(interrupts.EXIT_CODE)
        raise
    raise AssertionError("main exits.")


def _dispatch(argv: list[str]) -> int | None:
    if argv and argv[0] == "--version":
        print(f"bodyslam {bodyslam_jax.__version__}")
        return 0
    if not argv or argv[0] in _HELP:
        print(overview())
        return 0 if argv else 2
    name, rest = _command(argv)
    if name in GROUPS:
        print(overview(name))
        return 0 if rest else 2
    if any(arg in _HELP for arg in rest):
        print(command_help(name, "--help-all" in rest))
        return 0
    _check_options(name, rest)
    command = COMMANDS[name]
    return tyro.cli(
        prepared(command.function, rest, command.in_workers),
        prog=f"bodyslam {name}",
        args=rest,
    )


def _command(argv: list[str]) -> tuple[str, list[str]]:
    """Returns the command or group that `argv` names, and its arguments.

    **Raises:** `WrongUsage`, which suggests the closest name, if there is no such
    command.
    """
    first, *rest = argv
    if first in COMMANDS:
        return first, rest
    if first not in GROUPS:
        known = {name.partition(" ")[0] for name in COMMANDS}
        raise WrongUsage(_unknown(first, sorted(known)))
    if not rest or rest[0] in _HELP:
        return first, rest
    if f"{first} {rest[0]}" in COMMANDS:
        return f"{first} {rest[0]}", rest[1:]
    known = {name.partition(" ")[2] for name in COMMANDS if name.startswith(first)}
    raise WrongUsage(f"{first}: {_unknown(rest[0], sorted(known))}")


def _unknown(word: str, known: list[str]) -> str:
    close = difflib.get_close_matches(word, known, n=1)
    hint = f"did you mean {close[0]}?" if close else f"expected {', '.join(known)}."
    return f"no command {word!r}; {hint}"


def _check_options(name: str, argv: list[str]) -> None:
    """Refuses options that the command does not have.

    **Raises:** `WrongUsage`, which suggests the option of the closest name.
    """
    flags = {
        other: [flag for one in options(command.function) for flag in one.flags]
        for other, command in COMMANDS.items()
    }
    known = {*flags[name], *GENERAL}
    for arg in argv:
        flag = arg.partition("=")[0].replace("_", "-")
        if arg.startswith("--") and flag not in known:
            if former := removed(flag):
                raise WrongUsage(f"{name}: {flag} {former}.")
            raise WrongUsage(
                f"{name}: no option {flag}; {suggestions(flag, flags, name)}"
            )


def _leave_interrupted() -> NoReturn:
    print("bodyslam: interrupted; the same command continues it", file=sys.stderr)
    sys.exit(interrupts.EXIT_CODE)
