"""Programs that read what is exported, each in a Python environment of its own.

`BODYSLAM_CLIENTS` lists Python executables, separated as in `PATH`, that have them:
some, as Blender's `bpy`, need other versions of NumPy than this package. Without it
only this Python is looked at; CONTRIBUTING.md tells how to set them up.
"""

import functools
import json
import os
import subprocess
import sys

import pytest


@functools.cache
def python_with(module: str) -> str | None:
    """A Python that can import the module."""
    listed = os.environ.get("BODYSLAM_CLIENTS", "").split(os.pathsep)
    for python in (*filter(None, listed), sys.executable):
        look = f"import importlib.util as u; assert u.find_spec({module!r})"
        done = subprocess.run([python, "-c", look], env=_environment(), check=False)
        if done.returncode == 0:
            return python
    return None


def run(module: str, code: str, *arguments: object):
    """Runs code with `sys.argv[1:]` in a Python that has the module, and returns what
    its last line of output is in JSON; skips the test where no Python has it."""
    python = python_with(module)
    if python is None:
        pytest.skip(f"no Python with {module}; see BODYSLAM_CLIENTS")
    done = subprocess.run(
        [python, "-c", code, *map(str, arguments)],
        capture_output=True,
        text=True,
        env=_environment(),
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


def _environment() -> dict[str, str]:
    """Without this project's own paths."""
    return {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
