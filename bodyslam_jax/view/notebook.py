"""The 3D page inside a notebook."""

import html
from pathlib import Path

from bodyslam_jax import evaluation
from bodyslam_jax.body import BodyModel
from bodyslam_jax.types import Result
from bodyslam_jax.view.scene_data import scene_data
from bodyslam_jax.view.scene_page import read_runs, scene_page


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
