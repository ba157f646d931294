"""Completion scripts for shells, made from the table of commands."""

import shlex
from collections.abc import Iterator
from typing import Literal

import tyro

from bodyslam_jax.cli.options import GENERAL, options

Shell = Literal["bash", "zsh", "fish"]


def completion(shell: tyro.conf.Positional[Shell], /) -> None:
    """Prints a script that completes commands and options in a shell.

    bash: `eval "$(bodyslam completion bash)"` in ~/.bashrc; zsh: the same with zsh in
    ~/.zshrc, after compinit; fish: `bodyslam completion fish | source` in config.fish.

    Args:
        shell: Shell that reads the script.
    """
    print(script(shell), end="")


def script(shell: Shell) -> str:
    """Returns the completion script of a shell."""
    if shell == "fish":
        return "\n".join(_fish()) + "\n"
    bash = "\n".join(_bash()) + "\n"
    # zsh runs bash's completions through its own emulation.
    return (
        bash
        if shell == "bash"
        else f"autoload -U +X bashcompinit\nbashcompinit\n{bash}"
    )


def _flags() -> dict[str, list[tuple[str, str]]]:
    """Returns flags and their descriptions, by command."""
    from bodyslam_jax.cli.commands import COMMANDS

    return {
        name: [
            (flag, one.about) for one in options(command.function) for flag in one.flags
        ]
        + list(GENERAL.items())
        for name, command in COMMANDS.items()
    }


def _words() -> dict[str, list[str]]:
    """Returns the words that may follow each incomplete command: for a group, its
    commands."""
    found: dict[str, list[str]] = {"": []}
    for name in _flags():
        first, _, second = name.partition(" ")
        if first not in found[""]:
            found[""].append(first)
        if second:
            found.setdefault(first, []).append(second)
    return found


def _bash() -> Iterator[str]:
    yield "_bodyslam() {"
    yield '  local word="${COMP_WORDS[COMP_CWORD]}" command="${COMP_WORDS[1]}" words=""'
    groups = "|".join(first for first in _words() if first)
    yield f'  case "$command" in {groups}) command="$command ${{COMP_WORDS[2]}}";; esac'
    yield '  if [ "$COMP_CWORD" -eq 1 ]; then command=""; fi'
    yield '  if [ "$COMP_CWORD" -eq 2 ]; then command="${command% *}"; fi'
    yield '  case "$command" in'
    for name, words in _words().items():
        yield f'    "{name}") words="{" ".join(words)}";;'
    for name, flags in _flags().items():
        if name not in _words():
            yield f'    "{name}") words="{" ".join(flag for flag, _ in flags)}";;'
    yield "  esac"
    yield '  COMPREPLY=($(compgen -W "$words" -- "$word"))'
    yield "}"
    # Where nothing matches, names of files are completed.
    yield "complete -o default -F _bodyslam bodyslam"


def _fish() -> Iterator[str]:
    words = _words()
    every = " ".join(words[""])
    yield (
        f"complete -c bodyslam -n 'not __fish_seen_subcommand_from {every}' -f "
        f"-a '{every}'"
    )
    for group, names in words.items():
        if group:
            listed, seen = " ".join(names), "__fish_seen_subcommand_from"
            condition = f"{seen} {group}; and not {seen} {listed}"
            yield f"complete -c bodyslam -n '{condition}' -f -a '{listed}'"
    for name, flags in _flags().items():
        condition = "; and ".join(
            f"__fish_seen_subcommand_from {word}" for word in name.split()
        )
        for flag, about in flags:
            first = about.partition(". ")[0].rstrip(".")
            yield (
                f"complete -c bodyslam -n '{condition}' -l {flag.removeprefix('--')} "
                f"-d {shlex.quote(first)}"
            )
