"""Frames in which a person touches nothing: the pelvis falls as every body does.

Postures do not tell a jump from a stance: a network that reads them alone calls up to
half of the frames of a recorded jump standing. In flight the centre of mass, and nearly
the pelvis, accelerates downwards by 9.8 m/s²; the pelvis of a walker by 3 at most.
"""

import numpy as np
from jaxtyping import Bool, Float

from bodyslam_jax.geometry.runs import runs

_FALLS = 6.0
"""Downwards acceleration from which nothing carries a person, m/s². Of recorded jumps
it finds 41 of 49 frames in flight, and no other (`benchmarks/bench_jumps.py`)."""
_WINDOW = 0.2
"""Length over which the acceleration is measured, s. Places that err by 1 cm give 2
m/s²."""


def in_free_fall(
    pelvis: Float[np.ndarray, "t 3"],
    present: Bool[np.ndarray, " t"],
    up: Float[np.ndarray, " 3"],
    fps: float,
) -> Bool[np.ndarray, " t"]:
    """Frames in which a person falls, or rises without being pushed.

    Args:
        pelvis: in the world, m.
        up: right to some 20 degrees.
    """
    half = max(1, round(_WINDOW * fps / 2))
    k = np.arange(-half, half + 1)
    # Least squares with a parabola: its second derivative in the middle.
    weight = k**2 - np.mean(k**2)
    weight = 2 * weight / (weight @ k**2) * fps**2
    found = np.zeros(len(pelvis), bool)
    for run in runs(present):
        if run.stop - run.start > 2 * half:
            height = pelvis[run] @ up
            middle = np.arange(run.start + half, run.stop - half)
            found[middle] = np.correlate(height, weight, "valid") < -_FALLS
    return found
