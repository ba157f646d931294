"""`scene.html`: one file with everything in it, which opens without a network."""

import html
import json
import re
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

from bodyslam_jax.body import BodyModel
from bodyslam_jax.config.errors import InputError
from bodyslam_jax.io import atomic
from bodyslam_jax.types import Result
from bodyslam_jax.view.scene_data import scene_data
from bodyslam_jax.view.video_samples import VideoSamples

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
    """The page of one or more runs (`scene_data`), whose first sets the timeline."""
    # "</script>" in a name must not end the element; "<\\/" is "</" in JSON.
    parts = [json.dumps(run, separators=(",", ":")) for run in runs]
    elements = [_RUN.format(part.replace("</", "<\\/")) for part in parts]
    return (
        _asset("scene.html")
        .replace("{title}", html.escape(str(runs[0]["name"])))
        .replace("{style}", _asset("scene.css"))
        .replace("{script}", "\n".join(map(_asset, _SCRIPTS)))
        .replace("{runs}", "\n".join(elements))
    )


def read_runs(path: Path) -> list[dict[str, Any]]:
    """The runs in a page that `write_scene` wrote.

    **Raises:** `FileNotFoundError`, or `ValueError` if the file is no such page.
    """
    found = _RUNS.findall(path.read_text(encoding="utf-8"))
    if not found:
        raise InputError(f"{path}: no runs in it, expected a scene.html of a run.")
    return [json.loads(run) for run in found]


def _asset(name: str) -> str:
    folder = resources.files("bodyslam_jax.view").joinpath("assets")
    return folder.joinpath(name).read_text(encoding="utf-8")
