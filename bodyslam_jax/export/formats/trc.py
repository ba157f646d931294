"""TRC: one person's joint centres as markers, as OpenSim reads them."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.body import JOINT_NAMES
from bodyslam_jax.export.formats.scene import Scene, at_constant_rate
from bodyslam_jax.types import Result


def write_trc(path: Path, result: Result, person: int = 0) -> None:
    """Writes a person's joints as TRC markers, mm; absent frames are empty."""
    joints, present = result.joints[person], result.present[person]
    times, rate = result.timestamps, result.fps
    path.write_text(trc_text(path.name, JOINT_NAMES, joints, present, times, rate))


def write(path: Path, scene: Scene) -> None:
    """Writes the joints of the only person of a scene as `write_trc` does."""
    write_trc(path, at_constant_rate(scene).result)


def trc_text(
    file: str,
    names: Sequence[str],
    points: Float[np.ndarray, "t m 3"],
    present: Bool[np.ndarray, " t"],
    times: Float[np.ndarray, " t"],
    rate: float,
) -> str:
    """Returns the text of a TRC file.

    Args:
        file: its name, which its first line repeats.
        names: the markers' names.
        points: their positions, m; written in mm.
        present: frames in which they are known; the others are left empty.
        times: of the frames, s.
        rate: frames per second.
    """
    num, count = points.shape[:2]
    head = ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units"]
    head += ["OrigDataRate", "OrigDataStartFrame", "OrigNumFrames"]
    hertz = f"{rate:.4f}"
    facts = [hertz, hertz, str(num), str(count), "mm", hertz, "1", str(num)]
    axes = [f"{axis}{k + 1}" for k in range(count) for axis in "XYZ"]
    rows = [
        ["PathFileType", "4", "(X/Y/Z)", file],
        head,
        facts,
        ["Frame#", "Time"] + [x for name in names for x in (name, "", "")],
        ["", "", *axes],
        [],
    ]
    millimetres = 1000.0 * points.reshape(num, -1)
    for k in range(num):
        values = [f"{x:.3f}" for x in millimetres[k]]
        if not present[k]:
            # OpenSim takes the end of a line for that of the last field, unless a tab
            # ends that.
            values = [""] * (3 * count + 1)
        rows.append([str(k + 1), f"{times[k]:.6f}", *values])
    return "\n".join("\t".join(row) for row in rows) + "\n"
