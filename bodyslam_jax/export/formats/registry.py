"""Lists the formats: what each contains, in which axes and units, and which programs
read it."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Format:
    """One row of the table in `docs/export.md`."""

    name: str
    suffix: str
    """Suffix of the file; empty for a folder."""
    content: str
    axes: str
    unit: str
    rate: str
    skeleton: str
    opens_in: str
    file: str
    """Name of the file in a folder; `{}` is replaced by the person's number."""
    extra: str | None = None
    """Extra of this package that must be installed."""
    turns: bool = True
    """Whether `up` rotates the axes; otherwise the format prescribes them."""

    @property
    def per_person(self) -> bool:
        """Whether each person has a file."""
        return "{}" in self.file

    @property
    def module(self) -> str:
        """Module with the function `write(path, scene)`."""
        return f"bodyslam_jax.export.formats.{self.name}"


_SMPL = "SMPL's 24 joints"
_OWN_TIMES = "the run's timestamps"
_VIDEO_RATE = "the video's, constant"
FORMATS: dict[str, Format] = {
    f.name: f
    for f in (
        Format(
            "glb",
            ".glb",
            "skinned animated bodies, animated camera, map, ground",
            "y up (by specification; importers turn it)",
            "m",
            _OWN_TIMES,
            _SMPL,
            "Blender, game engines, three.js",
            "scene.glb",
            turns=False,
        ),
        Format(
            "bvh",
            ".bvh",
            "one person's motion",
            "y or z up",
            "cm, degrees",
            _VIDEO_RATE,
            f"{_SMPL}, Mixamo's names, T-pose",
            "Blender (scale 0.01), MotionBuilder, retargeting add-ons",
            "person_{}.bvh",
        ),
        Format(
            "amass",
            ".npz",
            "one person's pose parameters",
            "y or z up (AMASS itself: z)",
            "m, rad",
            _VIDEO_RATE + ", in both spellings",
            "SMPL-H's 52 joints, hands at rest",
            "smplx, SMPL add-ons, `bodyslam evaluate`",
            "person_{}.npz",
        ),
        Format(
            "colmap",
            "",
            "camera, poses, map and its observations",
            "y or z up; camera x right, y down, z forward",
            "m, px",
            "frames",
            "-",
            "COLMAP, pycolmap, Gaussian-splatting tools",
            "colmap",
        ),
        Format(
            "nerfstudio",
            "",
            "camera, poses, map",
            "y or z up; camera x right, y up, z back",
            "m, px",
            "frames",
            "-",
            "nerfstudio, gsplat, instant-ngp",
            "nerfstudio",
        ),
        Format(
            "tum",
            ".tum",
            "camera path",
            "y or z up; camera x right, y down, z forward",
            "m, s",
            _OWN_TIMES,
            "-",
            "evo, robotics tools",
            "camera.tum",
        ),
        Format(
            "kitti",
            ".txt",
            "camera path",
            "y or z up; camera x right, y down, z forward",
            "m",
            "frames, without times",
            "-",
            "evo",
            "camera_kitti.txt",
        ),
        Format(
            "trc",
            ".trc",
            "one person's joint centres",
            "y or z up (OpenSim: y)",
            "mm",
            _VIDEO_RATE,
            f"{_SMPL} as markers",
            "OpenSim",
            "person_{}.trc",
        ),
        Format(
            "c3d",
            ".c3d",
            "one person's joint centres",
            "y or z up (in X_SCREEN, Y_SCREEN)",
            "mm",
            _VIDEO_RATE,
            f"{_SMPL} as points",
            "ezc3d, Visual3D, Mokka, OpenSim",
            "person_{}.c3d",
        ),
        Format(
            "opensim",
            "",
            "one person's model, markers, set-up of inverse kinematics",
            "y up",
            "m, mm",
            _VIDEO_RATE,
            "14 segments, Rajagopal's coordinates",
            "OpenSim (`opensim-cmd run-tool inverse_kinematics.xml`)",
            "opensim_{}",
            turns=False,
        ),
        Format(
            "csv",
            ".csv",
            "one person's joints with sigmas, the pelvis' place with sigmas, joint "
            "angles, speeds",
            "y or z up; segments x forward, y up, z right (ISB)",
            "m, degrees, m/s, s",
            _OWN_TIMES,
            _SMPL,
            "spreadsheets, pandas, R, MATLAB",
            "person_{}.csv",
        ),
        Format(
            "usd",
            ".usdc",
            "skinned animated bodies, animated camera, map, ground",
            "y or z up (in upAxis)",
            "m",
            _OWN_TIMES,
            _SMPL,
            "usdview, Omniverse, Houdini, Blender",
            "scene.usdc",
            extra="usd",
        ),
        Format(
            "rerun",
            ".rrd",
            "bodies, skeletons, camera, map",
            "y or z up (in ViewCoordinates)",
            "m",
            _OWN_TIMES,
            _SMPL,
            "rerun's viewer",
            "scene.rrd",
            extra="rerun",
        ),
    )
}


def table() -> str:
    """Returns the table of `docs/export.md` as Markdown."""
    rows = [["`--to`", "suffix", "content", "axes", "unit", "rate", "skeleton"]]
    rows[0] += ["opens in", "extra"]
    for f in FORMATS.values():
        row = [f"`{f.name}`", f"`{f.suffix}`" if f.suffix else "folder", f.content]
        row += [f.axes, f.unit, f.rate, f.skeleton, f.opens_in]
        rows.append([*row, f"`{f.extra}`" if f.extra else ""])
    rows.insert(1, ["---"] * len(rows[0]))
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)
