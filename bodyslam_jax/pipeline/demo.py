"""The demonstration: a rendered walker, estimated from the rendered images."""

from pathlib import Path

from bodyslam_jax import export, io, simulation
from bodyslam_jax.config import Config
from bodyslam_jax.pipeline.default_body import with_compatible_body
from bodyslam_jax.pipeline.people_stage import with_warnings
from bodyslam_jax.pipeline.progress import Stopwatch
from bodyslam_jax.pipeline.run_folder import run_in_locked_folder, stage_cache_of
from bodyslam_jax.pipeline.stage_cache import Cache
from bodyslam_jax.types import Result

_SCENE = "scene"
"""Subfolder of the run folder that holds the demonstration's input."""


def demo(
    out: Path,
    config: Config = Config(),
    *,
    from_pixels: bool = True,
) -> Result:
    """Renders a walker filmed by a moving camera and runs the pipeline on the images.

    The scene is written to `out/scene`, a sequence folder with its ground truth.

    Args:
        from_pixels: whether people are found in the images, by the networks that
            ship, or else simulated keypoints and bodies are given.

    **Raises:** `ValueError` if `out` cannot be written.
    """
    config, warnings = with_compatible_body(config)
    cache = Cache(out / ".cache", {"name": _SCENE})
    export.check_folder(out, cache.source, cache.owner())
    with export.locked(out):
        folder = out / _SCENE
        with Stopwatch()("rendering"):
            simulation.demo_scene(folder, people=not from_pixels)
            sequence = with_warnings(io.read_sequence(folder), warnings)
        cache = stage_cache_of(sequence, out)
        export.check_folder(out, cache.source, cache.owner())
        return run_in_locked_folder(sequence, out, config, cache)
