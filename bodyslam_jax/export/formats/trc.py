"""Writes TRC: one person's joint centres as markers, as OpenSim reads them."""

from pathlib import Path

from bodyslam_jax.body import JOINT_NAMES
from bodyslam_jax.export.formats.scene import Scene, at_constant_rate
from bodyslam_jax.types import Result


def write_trc(path: Path, result: Result, person: int = 0) -> None:
    """Writes a person's joints as TRC markers, mm; absent frames are empty."""
    num, rate = len(result.timestamps), result.fps
    head = ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units"]
    head += ["OrigDataRate", "OrigDataStartFrame", "OrigNumFrames"]
    facts = [f"{rate:.4f}"] * 2 + [str(num), "24", "mm", f"{rate:.4f}", "1", str(num)]
    axes = [f"{axis}{k + 1}" for k in range(24) for axis in "XYZ"]
    rows = [
        ["PathFileType", "4", "(X/Y/Z)", path.name],
        head,
        facts,
        ["Frame#", "Time"] + [x for name in JOINT_NAMES for x in (name, "", "")],
        ["", "", *axes],
        [],
    ]
    millimetres = 1000.0 * result.joints[person].reshape(num, 72)
    for k in range(num):
        values = [f"{x:.3f}" for x in millimetres[k]]
        if not result.present[person, k]:
            # OpenSim requires a tab after the last empty field of a line.
            values = [""] * 73
        rows.append([str(k + 1), f"{result.timestamps[k]:.6f}", *values])
    path.write_text("\n".join("\t".join(row) for row in rows) + "\n")


def write(path: Path, scene: Scene) -> None:
    """Writes the only person of a scene by `write_trc`."""
    write_trc(path, at_constant_rate(scene).result)
