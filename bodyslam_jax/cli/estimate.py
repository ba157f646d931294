"""From a video to a run folder, and what is said of it."""

import logging
from pathlib import Path
from typing import Any

import tyro

from bodyslam_jax.cli.types import Flat, Input, Preset
from bodyslam_jax.config import Config

log = logging.getLogger(__name__)


def run(
    input: Input,
    /,
    *,
    out: Path,
    keypoints: Path | None = None,
    bodies: Path | None = None,
    camera: Path | None = None,
    tracks: Path | None = None,
    masks: Path | None = None,
    preset: Preset = "default",
    settings: Path | None = None,
    config: Flat = Config(),
) -> int:
    """Estimates cameras, people and map, in metres, from a video or sequence folder.

    Args:
        input: Sequence folder, video file or folder of images.
        out: Run folder to write; an interrupted one is finished.
        keypoints: OpenPose folder, COCO/AlphaPose JSON or .npz, if not in the input.
        bodies: Regressed bodies of any supported tool, if not in the input.
        camera: camera.json, if not in the input.
        tracks: tracks.npz made elsewhere, if not in the input.
        masks: Folder of person masks, if not in the input.
        preset: `paper` has the paper's weights, motion network and first-order steps.
        settings: A config.yaml to start from, which prevails over a preset; options
            beside it prevail over both.
        config: Settings of every stage.
    """
    from bodyslam_jax import io, pipeline

    _announce_compilation()
    sequence = io.read_sequence(
        input,
        keypoints=keypoints,
        bodies=bodies,
        camera=camera,
        tracks=tracks,
        masks=masks,
        config=config.association,
        known=config,
    )
    result = pipeline.run_to_folder(sequence, out, config)
    return _finish(result, out)


def demo(
    *,
    out: Path = Path("bodyslam_demo"),
    from_pixels: bool = False,
    preset: Preset = "default",
    settings: Path | None = None,
    config: Flat = Config(),
) -> int:
    """Renders a walker filmed by a moving camera and runs the whole pipeline on it.

    Args:
        out: Run folder to write.
        from_pixels: Find the walker in the images by the networks that ship, in place
            of the keypoints and bodies that are simulated.
        preset: `paper` has the paper's weights, motion network and first-order steps.
        settings: A config.yaml to start from, which prevails over a preset; options
            beside it prevail over both.
        config: Settings of every stage.
    """
    from bodyslam_jax import pipeline

    _announce_compilation()
    result = pipeline.demo(out, config, from_pixels=from_pixels)
    return _finish(result, out)


def _finish(result: Any, out: Path) -> int:
    for line in result.summary["headline"]:
        print(line)
    for reason in result.summary["reasons"]:
        print(
            f"{reason['status']}: {reason['message']} What to do: {reason['advice']}."
        )
    for warning in result.summary["warnings"]:
        print(f"warning: {warning}")
    print(f"{out / 'report.html'}")
    return 0 if result.summary["status"] == "ok" else 3


def evaluate(
    run: Input,
    groundtruth: tyro.conf.Positional[Path],
    /,
    *,
    body_model: Path | None = None,
    offset: float = 0.0,
    json: bool = False,
) -> None:
    """Errors of a run folder against a ground truth: cameras, people, joints, scale.

    Args:
        run: Run folder.
        groundtruth: Folder with camera.txt (TUM) and body.npz (AMASS style).
        body_model: SMPL, or a folder with it for each gender; makes true joints where
            the ground truth holds none.
        offset: Added to the run's timestamps, s: the ground truth's clock at the
            video's first frame, where that does not start at 0.
        json: Print JSON instead of a table.
    """
    import bodyslam_jax as bs
    from bodyslam_jax import evaluation

    truth = evaluation.read_truth(groundtruth, body_model)
    # Toes and heels slide, where the joints of both sides are this body's.
    body = bs.load_body_model(body_model)
    result = evaluation.read_result(run)
    if not result.present.any():
        log.warning(
            "nobody is in this run, so that it has no metres: its errors after SE(3) "
            "and its scale mean nothing."
        )
    found = evaluation.evaluate(result, truth, body, offset)
    if found.scope is not None:
        for line in evaluation.gaps(found.scope):
            log.warning(line)
    print(evaluation.to_json(found) if json else evaluation.to_table(found))


def _announce_compilation() -> None:
    """Says that programs are compiled first, where none is in JAX's cache yet."""
    import jax

    folder = jax.config.jax_compilation_cache_dir  # pyright: ignore
    if folder and not (Path(folder).is_dir() and any(Path(folder).iterdir())):
        log.info("first run: programs are compiled, which takes minutes, and kept")
