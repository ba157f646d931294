"""`bodyslam run`, `demo` and `evaluate`."""

import logging
import shlex
import webbrowser
from pathlib import Path
from typing import Any, Literal

import tyro

from bodyslam_jax.cli import unexpected
from bodyslam_jax.cli.options import Flat, Input, Preset
from bodyslam_jax.config import Config

log = logging.getLogger(__name__)

_LONG_FRAMES = 3000
"""Number of frames from which `run` tells what they take."""
_RUN_GB, _LIVE_GB = (1.0, 0.8), (1.5, 0.03)
"""Memory of `run` and of `live --every-frame`, GB, and what 1,000 frames add
(`benchmarks/run.md`, `online.md`)."""


def run(
    input: Input,
    /,
    *,
    out: Path | None = None,
    keypoints: Path | None = None,
    bodies: Path | None = None,
    camera: Path | None = None,
    tracks: Path | None = None,
    masks: Path | None = None,
    windows: Literal["auto", "always", "never"] = "auto",
    preset: Preset = "default",
    settings: Path | None = None,
    open: bool = False,
    config: Flat = Config(),
) -> int:
    """Estimates cameras, people and map, in metres, from a video or sequence folder.

    Args:
        input: Sequence folder, video file or folder of images.
        out: Run folder to write; an interrupted run in it is continued. Without it
            runs/NAME, NAME from the input, numbered if an earlier run is there.
        keypoints: OpenPose folder, COCO/AlphaPose JSON or .npz, if not in the input.
        bodies: Regressed bodies, the result file of a supported tool, if not in the
            input.
        camera: Calibration, if not in the input: camera.json, `fx fy cx cy [k1 k2 p1
            p2]` or a 3 x 3 matrix (text, .npy), OpenCV, ROS, ORB-SLAM, Pose2Sim,
            Qualisys, COLMAP, nerfstudio, Stray Scanner, Record3D. FILE:NAME for one of
            several cameras.
        tracks: Point tracks (tracks.npz), if not in the input.
        masks: Person masks, non-zero is a person: folder of .png, or .npz with `masks`
            (frames, height, width), if not in the input.
        windows: Whether a video alone is estimated in overlapping windows, in memory
            that does not grow with its length, as by `live --every-frame`: one person,
            less exactly. `auto`: if all frames at once need more memory than there is.
        preset: `paper` selects the paper's weights, motion network and solver.
        settings: Settings file (config.yaml); it overrides the preset, and options
            override both.
        open: Open the report in a browser at the end.
        config: Settings of every stage.
    """
    from bodyslam_jax import io, pipeline
    from bodyslam_jax.cli.folders import default_folder

    given = keypoints, bodies, tracks, masks
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
    alone = input.is_file() and all(file is None for file in given)
    if _in_windows(windows, alone, sequence.num_frames, config):
        from bodyslam_jax.cli.live import live

        shared: dict[str, Any] = {"out": out, "camera": camera, "config": config}
        return live(str(input), page=False, every_frame=True, **shared)
    out = out or default_folder(sequence)
    _announce(f"run: {input}, {sequence.num_frames} frames", out)
    if sequence.num_frames >= _LONG_FRAMES:
        log.warning(_about_length(input, sequence.num_frames))
    with unexpected.noted_in(out):
        return finish(pipeline.run_to_folder(sequence, out, config), out, open)


def demo(
    *,
    out: Path = Path("bodyslam_demo"),
    from_pixels: bool = True,
    preset: Preset = "default",
    settings: Path | None = None,
    open: bool = False,
    config: Flat = Config(),
) -> int:
    """Renders a walker filmed by a moving camera and runs the whole pipeline on it.

    Args:
        out: Run folder to write.
        from_pixels: Find the walker in the images by the networks that ship; otherwise
            simulated keypoints and bodies are given, as of a regressor.
        preset: `paper` selects the paper's weights, motion network and solver.
        settings: Settings file (config.yaml); it overrides the preset, and options
            override both.
        open: Open the report in a browser at the end.
        config: Settings of every stage.
    """
    from bodyslam_jax import pipeline

    _announce("demo: a rendered walker", out)
    with unexpected.noted_in(out):
        return finish(pipeline.demo(out, config, from_pixels=from_pixels), out, open)


def finish(result: Any, out: Path, is_opened: bool = False) -> int:
    """Prints what was found, why it may be doubtful, what was written and the command
    to look at it, and opens the report if `is_opened`; returns the exit code."""
    from bodyslam_jax.cli.folders import look_at

    for line in result.summary["headline"]:
        print(line)
    for reason in result.summary["reasons"]:
        print(
            f"{reason['status']}: {reason['message']} What to do: {reason['advice']}."
        )
    for warning in result.summary["warnings"]:
        print(f"warning: {warning}")
    files = sorted(file.name for file in out.glob("[!.]*") if file.is_file())
    print(f"written to {out}: {', '.join(files)}")
    print(f"look at it: {look_at(out)}")
    if is_opened and not webbrowser.open((out / "report.html").resolve().as_uri()):
        log.warning("--open: no browser was found.")
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
        body_model: SMPL, or a folder with it for each gender; it gives the true joints
            where the ground truth has none.
        offset: Time of the video's first frame on the ground truth's clock, s.
        json: Print JSON instead of a table.
    """
    import bodyslam_jax as bs
    from bodyslam_jax import evaluation

    truth = evaluation.read_truth(groundtruth, body_model)
    # Foot sliding needs toes and heels, known for joints of this body only.
    body = bs.load_body_model(body_model)
    result = evaluation.read_result(run)
    if not result.present.any():
        log.warning(
            "this run has no people and so no metric scale: ignore its errors after "
            "SE(3) alignment and its scale."
        )
    found = evaluation.evaluate(result, truth, body, offset)
    if found.scope is not None:
        for line in evaluation.gaps(found.scope):
            log.warning(line)
    print(evaluation.to_json(found) if json else evaluation.to_table(found))


def _in_windows(windows: str, alone: bool, frames: int, config: Config) -> bool:
    """Returns whether a video is estimated in overlapping windows, and says why.

    **Raises:** `InputError` if that is asked for and not possible.
    """
    from bodyslam_jax.cli.live import refused
    from bodyslam_jax.config.errors import InputError
    from bodyslam_jax.graph.validation import memory

    if windows == "always":
        if not alone:
            raise InputError(
                "--windows always: found a folder or further files, expected a video "
                "file alone."
            )
        return True
    need, have = _RUN_GB[0] + _RUN_GB[1] * frames / 1000, memory() / 1e9
    if windows == "never" or not alone or need < have or refused(config):
        return False
    log.warning(
        "%d frames take about %.0f GB of memory at once, found %.0f GB: they are "
        "estimated in overlapping windows, one person, less exactly (docs/live.md); "
        "`--windows never` does without",
        *(frames, need, have),
    )
    return True


def _about_length(input: Path, frames: int) -> str:
    """Returns what a long input takes, and what there is instead."""
    of_run, of_live = (a + b * frames / 1000 for a, b in (_RUN_GB, _LIVE_GB))
    text = (
        f"{frames} frames take about {of_run:.0f} GB of memory (at 640x480, one "
        "person), and time in proportion; --start and --end choose some of them"
    )
    if not input.is_file():
        return text
    return (
        f"{text}. `bodyslam live {shlex.quote(str(input))} --every-frame` needs "
        f"{of_live:.0f} GB, and goes on after an interruption; it estimates one "
        "person, less exactly (docs/live.md)"
    )


def _announce(what: str, out: Path) -> None:
    """Logs what is run and where the result goes."""
    log.info("%s -> %s", what, out)
