"""Trajectories in the format of the TUM RGB-D benchmark (Sturm et al., IROS 2012).

A line is `timestamp tx ty tz qx qy qz qw`: s, m, camera to world; `#` starts a comment.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from bodyslam_jax.config.errors import InputError
from bodyslam_jax.geometry import so3_numpy as so3
from bodyslam_jax.io.declared import MAX_MAGNITUDE
from bodyslam_jax.io.files import read_lines

_MAX_LINE_CHARACTERS = 1000
"""Number of characters of a line that are read: eight numbers have some two hundred."""
_MAX_NUMBER = 1e19
"""Largest number: a time in nanoseconds since 1970 has 19 digits; positions are far
smaller."""


def read_tum(path: Path) -> tuple[Float[np.ndarray, " t"], Float[np.ndarray, "t 4 4"]]:
    """Timestamps (s) and poses (camera to world, m) of a TUM trajectory, sorted.

    **Raises:** `InputError` naming the file, what was found and what was expected.
    """
    rows = []
    lines = read_lines(path, "a TUM trajectory")
    for number, line in enumerate(lines, 1):
        # No more than is needed to see that a line is too long.
        words = line[:_MAX_LINE_CHARACTERS].partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if len(row) != 8 or not all(abs(x) <= _MAX_NUMBER for x in row):
            raise InputError(
                f"{path}, line {number}: {line.strip()[:60]!r}, not eight numbers "
                "`timestamp tx ty tz qx qy qz qw`."
            )
        rows.append(row)
    if not rows:
        raise InputError(f"{path}: no pose in it; expected TUM lines of eight numbers.")
    table = np.array(rows)
    table = table[np.argsort(table[:, 0], kind="stable")]
    if np.any(np.diff(table[:, 0]) <= 0):
        raise InputError(f"{path}: two poses have the same timestamp.")
    length = np.linalg.norm(table[:, 4:], axis=1)
    if np.any(abs(length - 1) > 0.05):
        worst = float(length[np.argmax(abs(length - 1))])
        raise InputError(f"{path}: a quaternion of length {worst:.3g}, not 1.")
    if np.abs(table[:, 1:4]).max() > MAX_MAGNITUDE:
        raise InputError(
            f"{path}: a camera {np.abs(table[:, 1:4]).max():.3g} m away, expected at "
            f"most {MAX_MAGNITUDE:g}."
        )
    T_WC = np.tile(np.eye(4), (len(table), 1, 1))
    T_WC[:, :3, :3] = so3.from_quaternion(table[:, 4:])
    T_WC[:, :3, 3] = table[:, 1:4]
    return table[:, 0], T_WC


def write_tum(
    path: Path, timestamps: Float[np.ndarray, " t"], T_WC: Float[np.ndarray, "t 4 4"]
) -> None:
    """Writes timestamps (s) and poses (camera to world, m) as a TUM trajectory."""
    xyzw = so3.quaternion(so3.log(T_WC[:, :3, :3]))
    np.savetxt(
        path,
        np.column_stack([timestamps, T_WC[:, :3, 3], xyzw]),
        fmt="%.9f",
        header="timestamp tx ty tz qx qy qz qw (camera to world)",
    )
