"""`scene.html`: one file with everything in it, which opens without a network.

`notebook_scene` shows the same page inside a notebook.
"""

import html
import re
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from bodyslam_jax import evaluation
from bodyslam_jax.body import BodyModel
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic, files
from bodyslam_jax.io.markup import json_in_html
from bodyslam_jax.types import Result
from bodyslam_jax.view.scene_data import VideoSamples, scene_data

_SCRIPTS = tuple(
    f"{name}.js"
    for name in ("three", "scene_pieces", "scene_run", "scene_view", "scene_page")
)
_RUN = '<script type="application/json" class="run">{}</script>'
_RUNS = re.compile(_RUN.replace("{}", "(.*?)"), re.DOTALL)


def write_scene(
    path: Path, result: Result, body: BodyModel, samples: VideoSamples | None = None
) -> None:
    """Writes the page of a result: people, camera, map and ground in 3D, over time.

    `samples` are small images and colours that a `VideoSampler` took from the video.
    """
    atomic.write_text(path, scene_page([scene_data(result, body, samples)]))


def scene_page(runs: Sequence[dict[str, Any]]) -> str:
    """Returns the page of one or more runs (`scene_data`); the first sets the
    timeline."""
    parts = {
        "{title}": html.escape(str(runs[0]["name"])),
        "{style}": _asset("scene.css"),
        "{script}": "\n".join(map(_asset, _SCRIPTS)),
        "{runs}": "\n".join(_RUN.format(json_in_html(run)) for run in runs),
    }
    # In one pass: a name may be that of another part.
    place = re.compile("|".join(map(re.escape, parts)))
    return place.sub(lambda found: parts[found[0]], _asset("scene.html"))


def read_runs(path: Path) -> list[dict[str, Any]]:
    """Returns the runs in a page that `write_scene` wrote.

    **Raises:** `InputError` if the file is no such page.
    """
    text = files.read_text(path, "a scene.html of a run")
    found = [files.parse_json(run, path) for run in _RUNS.findall(text)]
    if not found or not all(isinstance(run, dict) and "name" in run for run in found):
        raise InputError(f"{path}: no runs in it, expected a scene.html of a run.")
    return found


def _asset(name: str) -> str:
    folder = resources.files("bodyslam_jax.view").joinpath("assets")
    return folder.joinpath(name).read_text(encoding="utf-8")


class NotebookScene:
    """The page of a result, which Jupyter shows where it is a cell's last value."""

    def __init__(self, page: str, height: int):
        self.page = page
        """HTML, complete."""
        self.height = height
        """px"""

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{html.escape(self.page)}" title="scene in 3D" '
            f'style="width: 100%; height: {self.height}px; border: 0"></iframe>'
        )


def notebook_scene(
    result: Result,
    run: Path | None = None,
    *,
    height: int = 600,
    body: BodyModel | None = None,
) -> NotebookScene:
    """Returns the page of a result for a notebook, with its images and the map's
    colours if the folder of its run is given.

    Args:
        height: Of the page in the notebook, px.
        body: The body model of the result; without it the one that this machine has;
            a file that the result names is not opened.
    """
    if run is not None and (run / "scene.html").exists():
        return NotebookScene(scene_page(read_runs(run / "scene.html")[:1]), height)
    if body is None:
        body = evaluation.body_of_run(result)
    return NotebookScene(scene_page([scene_data(result, body)]), height)
