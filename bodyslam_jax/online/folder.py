"""The run folder of a live estimate, as `run` writes it."""

from pathlib import Path

from bodyslam_jax import export
from bodyslam_jax.config import Config
from bodyslam_jax.online.online import Online
from bodyslam_jax.pipeline.pictures import check_overlay, write_pictures
from bodyslam_jax.pipeline.progress import Stopwatch
from bodyslam_jax.types import Result


def write_folder(online: Online, result: Result, out: Path) -> None:
    """Writes what `online.finish` returned; with an overlay where the frames are those
    of a file (`Online.video`), as no image is kept.

    **Raises:** `InputError` if `out` cannot be written or holds something else.
    """
    config: Config = online.config
    check_overlay(config)
    measured, cameras = online.inputs
    watch = Stopwatch()
    with export.locked(out), export.run_folder(out) as partial:
        given = measured, cameras, result, online.body, config, watch
        still = write_pictures(partial, *given)
        result.summary["durations_s"] |= watch.seconds
        export.write_files(partial, result, config)
        export.write_report(partial / "report.html", result, online.body, still)
