"""The table of all commands, and completion scripts for shells made from it.

For commands with many options, the table also lists the few that `--help` shows;
`--help-all` shows all of them.
"""

import dataclasses
import shlex
from collections.abc import Callable, Iterator
from typing import Any, Literal

import tyro

from bodyslam_jax.cli.batch import batch, collect, sweep
from bodyslam_jax.cli.body import body_check, body_convert, body_show
from bodyslam_jax.cli.datasets import emdb, rich, threedpw, tum_amass
from bodyslam_jax.cli.environment import doctor
from bodyslam_jax.cli.estimate import demo, evaluate, run
from bodyslam_jax.cli.export import export
from bodyslam_jax.cli.live import live
from bodyslam_jax.cli.make import experiment, simulate, train_motion
from bodyslam_jax.cli.options import GENERAL, options
from bodyslam_jax.cli.view import view

Shell = Literal["bash", "zsh", "fish"]


@dataclasses.dataclass(frozen=True)
class Command:
    """A function of the command line."""

    function: Callable[..., Any]
    shown: frozenset[str] = frozenset()
    """Arguments and settings that `--help` lists; all if empty."""
    in_workers: bool = False
    """Whether other processes compute, so that this one must leave the GPU to them."""


def _command(
    function: Callable[..., Any], shown: str = "", in_workers: bool = False
) -> Command:
    return Command(function, frozenset(shown.split()), in_workers)


def completion(shell: tyro.conf.Positional[Shell], /) -> None:
    """Prints a script that completes commands and options in a shell.

    bash: `eval "$(bodyslam completion bash)"` in ~/.bashrc; zsh: the same with zsh in
    ~/.zshrc, after compinit; fish: `bodyslam completion fish | source` in config.fish.

    Args:
        shell: Shell that reads the script.
    """
    print(script(shell), end="")


COMMANDS = {
    "run": _command(
        run,
        """input out keypoints bodies camera masks preset settings detect device
        height focal fov camera_path camera_path_metric static_camera gravity fps start
        end person open""",
    ),
    "demo": _command(demo, "out from_pixels preset settings device overlay open"),
    "live": _command(
        live,
        """source out camera page port open preset settings detect device focal fov
        gravity fps""",
    ),
    "batch": _command(
        batch,
        """inputs out shard engine workers retries ray_address slurm_minutes slurm
        preset settings detect device overlay height focal fov static_camera fps start
        end person""",
        in_workers=True,
    ),
    "collect": _command(collect, in_workers=True),
    "sweep": _command(
        sweep,
        """inputs grid out engine workers ray_address slurm_minutes slurm preset
        settings detect device height focal fov static_camera fps start end person""",
        in_workers=True,
    ),
    "evaluate": _command(evaluate),
    "export": _command(export),
    "view": _command(view),
    "simulate": _command(
        simulate,
        "out sequence family length seed motion noise people hiding render",
    ),
    "train-motion": _command(
        train_motion, "data out body_model preset network past seed epochs"
    ),
    "experiment": _command(
        experiment,
        """name out preset settings sequences family frames noise motion seed
        motion_models engine workers ray_address device overlay""",
    ),
    "convert-dataset emdb": _command(emdb),
    "convert-dataset 3dpw": _command(threedpw),
    "convert-dataset rich": _command(rich),
    "convert-dataset tum-amass": _command(tum_amass),
    "body-model show": _command(body_show),
    "body-model convert": _command(body_convert),
    "body-model check": _command(body_check),
    "doctor": _command(doctor),
    "completion": _command(completion),
}
"""All commands by name; commands of one group share the first word."""
GROUPS = {
    "body-model": "Body model files: SMPL and models of its shape, SMPL-H, SMPL-X.",
    "convert-dataset": "Sequence folders with ground truth, made from datasets.",
}


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
