"""`bodyslam export`: a run folder as other programs read it."""

from pathlib import Path
from typing import Literal

from bodyslam_jax.cli.options import Input

Formats = Literal[
    "glb",
    "bvh",
    "amass",
    "colmap",
    "nerfstudio",
    "tum",
    "kitti",
    "trc",
    "c3d",
    "opensim",
    "csv",
    "usd",
    "rerun",
]


def export(
    run: Input,
    /,
    *,
    to: tuple[Formats, ...] = (),
    out: Path | None = None,
    up: Literal["y", "z"] = "y",
    person: tuple[int, ...] = (),
    video: Path | None = None,
    body_model: Path | None = None,
) -> None:
    """Writes a run for Blender, game engines, OpenSim, COLMAP, nerfstudio, robots, ...

    Args:
        run: Run folder.
        to: One or more formats; without it what the suffix of `--out` says, else glb.
            glb: bodies, camera, map and ground, animated (Blender, engines). bvh:
            skeleton for retargeting. amass: SMPL poses. colmap, nerfstudio: cameras and
            map. tum, kitti: camera path. trc, c3d: joints as markers. csv: joints,
            angles, speeds. usd, rerun: need extras of the same name. docs/export.md has
            axes, units and skeletons.
        out: File, or folder for several formats; without it the run's `export` folder.
        up: Axis that points up; the run's own is y. GLB is y up in any case.
        person: Numbers of the people to write; without it everybody.
        video: Video or folder of images of the run, whose frames colmap and nerfstudio
            then write beside their files.
        body_model: The body model of the run; without it the one that `bodyslam doctor`
            shows. What a run folder names is not opened.
    """
    import bodyslam_jax as bs
    from bodyslam_jax import evaluation
    from bodyslam_jax.export import formats

    result = evaluation.read_result(run)
    folder = run if run.is_dir() else run.parent
    names = to or (() if out is not None and out.suffix else ("glb",))
    if out is None:
        out = folder / "export"
        if len(names) == 1:
            out = out / formats.FORMATS[names[0]].file
    written = formats.export(
        result,
        out,
        names or None,
        up,
        person or None,
        body=bs.load_body_model(body_model) if body_model else None,
        observations=formats.read_observations(folder, result),
        video=video,
    )
    for path in written:
        print(path)
